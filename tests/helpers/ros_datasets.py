"""Datasets for the tests of the ROS node: one from which to learn takes long, and copies to be broken."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
from small_scenes import NAMES, balls_on_a_table, look_at, write_dataset

from gsseg_core.data.camera_formats.gaussian_splatting import write_3dgs


def write_long_dataset(folder: Path, count: int = 3000) -> Path:
    """A dataset of the balls on their table from which to learn takes many seconds: many views of a few masks."""
    scene, truth = balls_on_a_table()
    angles = np.linspace(0, 2 * np.pi, 6, endpoint=False)
    cameras = [
        look_at(f"view{i}", np.array([3 * np.cos(a), 3 * np.sin(a), 3.0]), 320, 240, 275.0)
        for i, a in enumerate(angles)
    ]
    write_dataset(folder, scene, truth, cameras, NAMES)
    (folder / "split.json").unlink()
    views = [replace(cameras[i % len(cameras)], name=f"{i:05d}") for i in range(count)]
    write_3dgs(folder / "cameras.json", views)
    for i, view in enumerate(views):
        (folder / "labels" / f"{view.name}.png").symlink_to(f"{cameras[i % len(cameras)].name}.png")
    return folder


def copied(folder: Path, target: Path) -> Path:
    """A copy of a dataset, to be broken."""
    shutil.copytree(folder, target)
    return target
