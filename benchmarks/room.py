"""A room of any size for benchmarks: Gaussians with the statistics of trained scenes, cameras, and true labels.

Trained scenes lie on surfaces, more densely on objects than on walls; scales are log-normal, one axis being thin;
most opacities are near 1 with a tail of faint ones; a few floaters hang in the air.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsseg_core.cameras import Camera
from gsseg_core.scene import GaussianScene

SIZE = np.array([8.0, 6.0, 2.8])  # m
DETAIL = 4.0  # Gaussians per area on objects, in multiples of those on walls
FLOATERS = 0.02  # share


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
    means[rows, axis] = np.where(upper, high[truth, axis], low[truth, axis]) + rng.normal(0, 0.003, count)
    floating = rng.random(count) < FLOATERS
    means[floating] = rng.random((int(floating.sum()), 3)) * SIZE
    truth[floating] = 0
    spacing = np.sqrt(weight.sum() / count / np.where(truth > 0, DETAIL, 1.0))
    scales = spacing[:, None] * np.exp(rng.normal(0.35, 0.6, (count, 3)))
    scales[rows, axis] *= 0.15
    opacities = np.where(rng.random(count) < 0.6, rng.beta(12, 1, count), rng.beta(1, 2, count))
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
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ position
    focal = 0.8 * width
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Camera(f"view{i:03d}", width, height, K, pose)
