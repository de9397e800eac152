"""The scenes that results are measured on: the demo's, a garden, and those of the shared data."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from workloads import RoomSize, write_room

from gsseg_core.data.dataset import Dataset
from gsseg_core.data.view import View
from gsseg_core.demo.table_scene import build_demo
from gsseg_core.scene.gaussian_scene import GaussianScene

DEMO, GARDEN, APARTMENT = "demo", "garden", "replica_apartment"
MADE_UP = ("shelf", "kitchen_table", "workbench")
REAL = (APARTMENT, *MADE_UP)
"""Of the shared data; those that are absent are not measured."""

NO_BACKGROUND = (APARTMENT, "workbench")

OUTDOORS = RoomSize(120_000, 40, 16, 480, 360, tests=8, outdoors=True)
"""The garden: outlines of its objects are soft, and so its edges lie beside them in all views alike."""


class Opened(NamedTuple):
    """A scene, and its views with true masks and with wrong ones."""

    name: str
    scene: GaussianScene
    true: Dataset
    wrong: Dataset


def open_scene(name: str, folder: Path, data: Path) -> Opened:
    """Open a scene of the shared data, or build the demo's or the garden in a folder."""
    if name == DEMO:
        return Opened(name, build_demo(folder).scene, Dataset(folder, "labels_true"), Dataset(folder))
    place = write_room(folder, OUTDOORS, wrong=True, seed=13) if name == GARDEN else data / name
    return Opened(name, GaussianScene.load(place / "scene.ply"), Dataset(place), Dataset(place, "labels_noisy"))


def open_scenes(folder: Path, data: Path, names: Sequence[str] = REAL) -> Iterator[Opened]:
    """Build the demo's scene in a folder, and open those of the shared data that are there."""
    yield open_scene(DEMO, folder, data)
    for name in names:
        if (data / name).is_dir():
            yield open_scene(name, folder, data)
        else:
            print(f"{data / name}: not there, and so not measured; GSSEG_DATA or --data names the folder with it")


def held_out(views: Sequence[View]) -> tuple[list[View], list[View]]:
    """Tell train views to learn from and every seventh, which is held out from learning, to score on."""
    return [view for i, view in enumerate(views) if i % 7 != 3], list(views[3::7])
