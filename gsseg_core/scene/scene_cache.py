"""What is made of a scene once, and kept for as long as the scene is."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Generic, TypeVar
from weakref import WeakKeyDictionary

from gsseg_core.scene.gaussian_scene import GaussianScene

T = TypeVar("T")


class PerScene(Generic[T]):
    """One value for each scene; whoever asks while another thread makes it waits for that one."""

    def __init__(self) -> None:
        self._known: WeakKeyDictionary[GaussianScene, T] = WeakKeyDictionary()
        self._making = threading.Lock()

    def of(
        self,
        scene: GaussianScene,
        make: Callable[[], T],
        fits: Callable[[T], bool] = lambda _: True,
    ) -> T:
        """Return the value of a scene, made anew where there is none that fits."""
        with self._making:
            known = self._known.get(scene)
            if known is None or not fits(known):
                known = self._known[scene] = make()
            return known
