"""A cache of values that are computed once for a scene, and kept as long as it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Generic, TypeVar
from weakref import WeakKeyDictionary

from gsseg_core.scene.gaussian_scene import GaussianScene

T = TypeVar("T")


class PerScene(Generic[T]):
    """Cache of one value per scene; a thread that asks while another one computes it waits."""

    def __init__(self) -> None:
        self._known: WeakKeyDictionary[GaussianScene, T] = WeakKeyDictionary()
        self._making = threading.Lock()

    def of(self, scene: GaussianScene, make: Callable[[], T], fits: Callable[[T], bool] = lambda _: True) -> T:
        """Return the value of a scene; `make` computes it where none is cached that fits."""
        with self._making:
            known = self._known.get(scene)
            if known is None or not fits(known):
                known = self._known[scene] = make()
            return known
