"""A room of any size for benchmarks: Gaussians with the statistics of trained scenes, cameras, and true labels.

Trained scenes lie along surfaces, more densely on objects than on walls, and a little in front of them and behind;
scales are log-normal, less along the normal; opacities are anything from 0 to 1; a few floaters hang in the air.

The settings below were chosen to meet what `python benchmarks/scene_statistics.py` finds with gsseg's own operator in
two trained scenes, over about twenty of the cameras of each. *Spacing* is the mean distance of a Gaussian to its three
nearest others (the initial scale in 3DGS); pairs are the non-zero weights of W.

|                                         | apartment, 127 k  | fern, 65 k        | room, 1 M         |
| --------------------------------------- | ----------------- | ----------------- | ----------------- |
| pairs per pixel                         | 42.9              | 39.9              | 41.6              |
| Gaussians seen by a view                | 27 %              | 98 %              | 32 %              |
| tiles per Gaussian seen                 | 3.1               | 2.2               | 2.1               |
| opacity, 5, 50 and 95 %                 | 0.14, 0.73, 0.99  | 0.04, 0.41, 0.99  | 0.05, 0.58, 0.98  |
| middle scale / mean nearest distance    | 0.24, 1.05, 1.96  | 0.05, 0.25, 1.91  | 0.17, 0.53, 1.65  |
| log (middle scale / spacing), mean, sd  | -0.32, 0.61       | -1.06, 0.91       | -0.70, 0.73       |
| log (largest / middle scale), mean, sd  | 0.53, 0.56        | 0.87, 0.81        | 0.59, 0.47        |
| log (smallest / middle scale), mean, sd | -0.58, 0.58       | -0.76, 0.74       | -0.62, 0.49       |
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsseg_core.scene.camera import Camera, pose_looking
from gsseg_core.scene.gaussian_scene import GaussianScene

SIZE = np.array([8.0, 6.0, 2.8])  # m
DETAIL = 4.0  # Gaussians per area on objects, in multiples of those on walls
FLOATERS = 0.02  # share
DEPTH = 0.6  # sd of the distance to the surface, in multiples of the spacing on a square grid
SCALE = 0.58  # median scale, in the same unit
SIZES, SHAPES = 0.4, 0.65  # sd of the log of all three scales together, and of each alone
THIN = 0.6  # scale along the normal, relative to the others


@dataclass(frozen=True, eq=False)
class Room:
    """A scene, the class of each of its Gaussians, and cameras that look around in it."""

    scene: GaussianScene
    truth: np.ndarray  # (N,)
    cameras: list[Camera]


def build_room(
    count: int = 1_000_000,
    *,
    num_classes: int = 10,
    num_views: int = 60,
    width: int = 640,
    height: int = 480,
    sh_degree: int = 0,
    seed: int = 0,
) -> Room:
    """Build a room with `num_classes` - 1 boxes in it; all else is background."""
    rng = np.random.default_rng(seed)
    low, high = [np.zeros(3)], [SIZE]
    for _ in range(num_classes - 1):
        size = rng.uniform([0.3, 0.3, 0.3], [1.2, 1.2, 1.6])
        corner = np.append(rng.uniform(0.1, SIZE[:2] - size[:2] - 0.1), rng.choice([0.0, 0.4]))
        low.append(corner)
        high.append(corner + size)
    low, high = np.array(low), np.array(high)
    sides = high - low
    area = np.stack([sides[:, 1] * sides[:, 2], sides[:, 0] * sides[:, 2], sides[:, 0] * sides[:, 1]], axis=1)
    weight = np.repeat(area, 2, axis=1) * np.where(np.arange(len(low)) > 0, DETAIL, 1.0)[:, None]
    faces = rng.choice(weight.size, count, p=(weight / weight.sum()).ravel())
    truth, face = faces // 6, faces % 6
    axis, upper = face // 2, face % 2
    means = low[truth] + rng.random((count, 3)) * sides[truth]
    rows = np.arange(count)
    spacing = np.sqrt(weight.sum() / count / np.where(truth > 0, DETAIL, 1.0))
    means[rows, axis] = np.where(upper, high[truth, axis], low[truth, axis]) + rng.normal(0, DEPTH * spacing)
    floating = rng.random(count) < FLOATERS
    means[floating] = rng.random((int(floating.sum()), 3)) * SIZE
    truth[floating] = 0
    logs = rng.normal(np.log(SCALE), SIZES, (count, 1)) + rng.normal(0, SHAPES, (count, 3))
    scales = spacing[:, None] * np.exp(logs)
    scales[rows, axis] *= THIN
    opacities = rng.beta(0.9, 0.7, count)
    opacities = np.clip(np.where(floating, 0.3 * opacities, opacities), 0.006, 0.995)
    quats = np.tile([1.0, 0, 0, 0], (count, 1)) + rng.normal(0, 0.1, (count, 4))
    sh = rng.normal(0, 0.5, (count, (sh_degree + 1) ** 2, 3))
    scene = GaussianScene.from_arrays(means, quats, scales, opacities, sh)
    return Room(scene, truth, [_camera(i, num_views, width, height) for i in range(num_views)])


def _camera(i: int, count: int, width: int, height: int) -> Camera:
    """On an ellipse through the room at eye level, looking across its middle and a little down."""
    angle = 2 * np.pi * i / count
    position = SIZE / 2 + np.array([2.8 * np.cos(angle), 1.9 * np.sin(angle), 0.3])
    target = SIZE / 2 - 0.4 * (position - SIZE / 2) - [0, 0, 0.6]
    forward = (target - position) / np.linalg.norm(target - position)
    pose = pose_looking(forward, np.array([0.0, 0, 1]), position)
    focal = 0.8 * width
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Camera(f"view{i:03d}", width, height, K, pose)
