"""What is measured on, and how large: rooms written as datasets, the real scenes, the points of the growth curves."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from automatic_masks import AutomaticMasks
from garden import build_garden
from room import Room, build_room

from gsseg_core.data.camera_formats.gaussian_splatting import write_3dgs
from gsseg_core.data.label_images import write_mask
from gsseg_core.demo.mask_errors import corrupt
from gsseg_core.raster.backends import make_operator
from gsseg_core.scene.camera import Camera

REAL = ("replica_apartment", "fern")
MASKS = {"labels": "true masks", "labels_noisy": "wrong masks"}


@dataclass(frozen=True)
class RoomSize:
    """A room, and the cameras in it."""

    gaussians: int
    views: int
    classes: int
    width: int
    height: int
    tests: int = 0
    sh_degree: int = 0
    outdoors: bool = False

    def __str__(self) -> str:
        """Describe for the report."""
        return (
            f"{self.gaussians:,} Gaussians, {self.views} views of {self.width} x {self.height}, {self.classes} classes"
        )


@dataclass(frozen=True)
class Sizes:
    """How much a run does.

    Attributes
    ----------
    name : str
        Runs of one name can be compared.
    room : RoomSize
        Workload (a).
    runs, whole_runs : int
        Of each stage, and of whole commands.
    sampled : int
        Views over which stages of one view are averaged.
    growth : RoomSize
        Where each growth curve stays while one size grows; `views` is what the two other curves use.
    gaussians, views, classes : tuple of int
        The points of the curves.
    steps : int
        Steps of EM at each point.
    small : RoomSize
        Of the loop in PyTorch, and of what else cannot take more.
    epochs : int
        Of that loop.
    tiny : RoomSize
        Of the rasterisers of others.
    others : bool
        Whether to install those.
    cold : bool
        Whether to compile all kernels anew.
    """

    name: str
    room: RoomSize
    runs: int
    whole_runs: int
    sampled: int
    growth: RoomSize
    gaussians: tuple[int, ...]
    views: tuple[int, ...]
    classes: tuple[int, ...]
    steps: int
    small: RoomSize
    epochs: int
    tiny: RoomSize
    others: bool = True
    cold: bool = True


SIZES = {
    "full": Sizes(
        name="full",
        room=RoomSize(1_000_000, 60, 10, 640, 480, tests=6, sh_degree=3),
        runs=5,
        whole_runs=3,
        sampled=12,
        growth=RoomSize(500_000, 20, 10, 640, 480),
        gaussians=(250_000, 500_000, 1_000_000, 2_000_000, 5_000_000),
        views=(10, 30, 60, 120, 240),
        classes=(2, 10, 40, 100, 200),
        steps=3,
        small=RoomSize(30_000, 10, 10, 160, 120, tests=5),
        epochs=10,
        tiny=RoomSize(2_000, 1, 3, 160, 120),
    ),
    "quick": Sizes(
        name="quick",
        room=RoomSize(200_000, 12, 10, 320, 240, tests=3, sh_degree=3),
        runs=3,
        whole_runs=1,
        sampled=4,
        growth=RoomSize(50_000, 5, 10, 320, 240),
        gaussians=(25_000, 50_000, 100_000, 200_000),
        views=(5, 10, 20),
        classes=(2, 10, 40),
        steps=2,
        small=RoomSize(10_000, 6, 5, 80, 60, tests=3),
        epochs=3,
        tiny=RoomSize(500, 1, 3, 64, 48),
        others=False,
        cold=False,
    ),
    "tiny": Sizes(
        name="tiny",
        room=RoomSize(2_000, 3, 3, 64, 48, tests=2, sh_degree=1),
        runs=1,
        whole_runs=1,
        sampled=1,
        growth=RoomSize(1_000, 2, 3, 32, 24),
        gaussians=(500, 1_000),
        views=(1, 2),
        classes=(2, 3),
        steps=1,
        small=RoomSize(1_000, 2, 3, 32, 24, tests=1),
        epochs=1,
        tiny=RoomSize(200, 1, 3, 32, 24),
        others=False,
        cold=False,
    ),
}


WHOLE = {
    "a": SIZES["full"].room,
    "c": RoomSize(3_000_000, 200, 20, 1600, 1064, sh_degree=3, outdoors=True),
    "d": RoomSize(6_000_000, 300, 20, 1600, 1064, sh_degree=3, outdoors=True),
    "e": RoomSize(3_000_000, 60, 20, 1600, 1064, sh_degree=1),
}
"""Workloads of the whole command: (c) is what people capture outdoors, (d) the largest of it, (e) a large room."""


def write_room(
    folder: Path, size: RoomSize, *, wrong: bool = False, automatic: bool = False, seed: int = 0
) -> Path:  # fmt: skip
    """Write a room as a dataset: scene, cameras, split and true masks, and wrong or automatic ones if asked for."""
    room = make_room(size, seed)
    folder.mkdir(parents=True, exist_ok=True)
    room.scene.save(folder / "scene.ply")
    write_3dgs(folder / "cameras.json", room.cameras)
    names = {str(k): f"box {k}" for k in range(1, size.classes)}
    (folder / "classes.json").write_text(json.dumps(names))
    train, test = split(room.cameras, size.tests)
    stems = {"train": [camera.name for camera in train], "test": [camera.name for camera in test]}
    (folder / "split.json").write_text(json.dumps(stems))
    rng = np.random.default_rng(seed)
    for camera in room.cameras:
        labels = true_labels(room, camera, size.classes)
        write_mask(folder / "labels" / f"{camera.name}.png", labels, 8)
        if wrong:
            write_mask(folder / "labels_noisy" / f"{camera.name}.png", corrupt(labels, rng), 8)
    if automatic:
        masks = AutomaticMasks(room, seed)
        for camera in room.cameras:
            masks.write(folder / "labels_automatic", camera)
    return folder


def make_room(size: RoomSize, seed: int = 0) -> Room:
    """Build a room, or a garden, with cameras for learning and for tests."""
    return (build_garden if size.outdoors else build_room)(
        size.gaussians,
        num_classes=size.classes,
        num_views=size.views + size.tests,
        width=size.width,
        height=size.height,
        sh_degree=size.sh_degree,
        seed=seed,
    )


def split(cameras: list[Camera], tests: int) -> tuple[list[Camera], list[Camera]]:
    """Cameras to learn from, and test cameras spread evenly between them."""
    chosen = {(2 * i + 1) * len(cameras) // (2 * tests) for i in range(tests)}
    train = [camera for i, camera in enumerate(cameras) if i not in chosen]
    return train, [cameras[i] for i in sorted(chosen)]


def true_labels(room: Room, camera: Camera, num_classes: int) -> np.ndarray:
    """Strongest class of each pixel, (H, W) int32."""
    onehot = np.eye(num_classes, dtype=np.float32)[room.truth]
    image, left_over = make_operator(room.scene, camera).blend(onehot)
    image[..., 0] += left_over
    labels: np.ndarray = image.argmax(axis=2).astype(np.int32)
    return labels
