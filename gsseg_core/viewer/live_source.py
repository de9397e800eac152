"""Sources of class probabilities that change while a viewer runs, which other packages provide.

A source is named by an entry point of the group `gsseg.live_sources`, so that the core knows none of them. It is called
with the scene, and returns a `LiveSource`. `gsseg view --ros` looks for the name "ros".
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import entry_points
from typing import NamedTuple, Protocol

from gsseg_core.errors import SettingsError
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.viewer.model import Labelling

GROUP = "gsseg.live_sources"


class LiveUpdate(NamedTuple):
    """Labels and class probabilities of a source at one time, and the number of views that they come from."""

    labelling: Labelling
    num_views: int


class LiveSource(Protocol):
    """Hands out class probabilities as they change."""

    def wait(self, timeout: float) -> LiveUpdate | None:
        """Wait for the next class probabilities, `timeout` seconds at most; return None where nothing has changed.

        Raises `GssegError` where the source cannot be asked now, and why; it may be asked again.
        """

    def close(self) -> None:
        """Let go of what it holds; a `wait` in another thread that lasts, as for a node that is gone, then raises."""


def open_source(name: str, scene: GaussianScene) -> LiveSource:
    """Make the source of a name.

    Raises `SettingsError` where there is none of this name, or what it needs is not installed; another `GssegError`
    where it cannot be used with this scene.
    """
    found = next(iter(entry_points(group=GROUP, name=name)), None)
    if found is None:
        raise SettingsError(f"live source {name!r}: none is installed; expected an entry point in the group {GROUP}")
    try:
        make: Callable[[GaussianScene], LiveSource] = found.load()
    except ModuleNotFoundError as missing:
        raise SettingsError(
            f"live source {name!r}: the Python package {missing.name!r} is missing; expected ROS 2 Jazzy, from apt "
            "with its setup.sh sourced, or as wheels: pip install ./msg_defs '.[ros]'"
        ) from missing
    return make(scene)
