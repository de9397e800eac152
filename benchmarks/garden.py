"""An outdoor scene of any size for benchmarks, as people capture them: objects in the middle, and all the world around.

A walk around some objects on the ground gives a scene most of whose Gaussians are near, small and dense; farther out
they are larger, as the cameras saw little of it, and the horizon is a shell of huge ones. Trees and sky leave floaters.
Shapes and opacities have the statistics of `benchmarks/room.py`, which says where they come from.
"""

from __future__ import annotations

import numpy as np
from room import DEPTH, SCALE, SHAPES, SIZES, THIN, Room

from gsseg_core.scene.camera import Camera, pose_looking
from gsseg_core.scene.gaussian_scene import GaussianScene

OBJECTS, GROUND, HORIZON = 0.4, 0.38, 0.2  # shares of the Gaussians; the others float
NEAR, EDGE, FAR = 2.0, 15.0, 80.0  # m from the middle: of the objects, where the ground ends, of the farthest hills
TURNS = (0.9, 1.6, 2.6)  # m above the ground at which the camera goes around
DISTANCE = 4.5  # m from there to the middle


def build_garden(
    count: int, *, num_classes: int, num_views: int, width: int, height: int, sh_degree: int, seed: int
) -> Room:
    """Build a garden with `num_classes` - 1 objects in its middle; all else is background."""
    rng = np.random.default_rng(seed)
    parts = np.bincount(rng.choice(4, count, p=[OBJECTS, GROUND, HORIZON, 1 - OBJECTS - GROUND - HORIZON]), minlength=4)
    truth = np.zeros(count, np.int64)
    means, normals, spacing = (np.concatenate(pieces) for pieces in zip(
        _objects(rng, truth[: parts[0]], num_classes), _ground(rng, parts[1]), _horizon(rng, parts[2]),
        _floaters(rng, parts[3]), strict=True,
    ))  # fmt: skip
    means += normals * (rng.normal(0, DEPTH, count) * spacing)[:, None]
    logs = rng.normal(np.log(SCALE), SIZES, (count, 1)) + rng.normal(0, SHAPES, (count, 3))
    scales = spacing[:, None] * np.exp(logs) * [1, 1, THIN]
    opacities = rng.beta(0.9, 0.7, count)
    opacities[-parts[3] :] *= 0.3
    # The turn that takes z to the normal, and a little beside.
    quats = np.stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], np.zeros(count)], axis=1)
    quats[normals[:, 2] < -0.999] = [0.0, 1.0, 0.0, 0.0]
    quats = quats / np.linalg.norm(quats, axis=1, keepdims=True) + rng.normal(0, 0.05, (count, 4))
    sh = 0.5 * rng.standard_normal((count, (sh_degree + 1) ** 2, 3), np.float32)
    scene = GaussianScene.from_arrays(means, quats, scales, np.clip(opacities, 0.006, 0.995), sh)
    return Room(scene, truth, [_camera(i, num_views, width, height) for i in range(num_views)])


Piece = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Points on surfaces, their normals, (M, 3) both, and the distance to the next one, (M,)."""


def _objects(rng: np.random.Generator, truth: np.ndarray, num_classes: int) -> Piece:
    """Ellipsoids on the ground; `truth` (M,) is written."""
    radii = rng.uniform(0.15, 0.45, (num_classes - 1, 3))
    angle, away = rng.uniform(0, 2 * np.pi, len(radii)), NEAR * np.sqrt(rng.random(len(radii)))
    middles = np.stack([away * np.cos(angle), away * np.sin(angle), radii[:, 2]], axis=1)
    area = 4 * np.pi * (radii.prod(axis=1) ** (2 / 3))
    truth[:] = 1 + rng.choice(len(radii), len(truth), p=area / area.sum())
    directions, own = _directions(rng, len(truth)), radii[truth - 1]
    normals = directions / own
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return middles[truth - 1] + directions * own, normals, np.full(len(truth), np.sqrt(area.sum() / len(truth)))


def _ground(rng: np.random.Generator, count: int) -> Piece:
    """Lay out a disc, densest in the middle: as many Gaussians in each ring, however wide."""
    away, angle = EDGE * rng.random(count), rng.uniform(0, 2 * np.pi, count)
    bumps = 0.02 * np.sin(3 * away) * np.cos(5 * angle)
    means = np.stack([away * np.cos(angle), away * np.sin(angle), bumps], axis=1)
    return means, np.tile([0.0, 0.0, 1.0], (count, 1)), np.sqrt(2 * np.pi * np.maximum(away, 0.1) * EDGE / count)


def _horizon(rng: np.random.Generator, count: int) -> Piece:
    """Hills and sky: shells from where the ground ends to far away, their Gaussians as large as they are far."""
    directions, away = _directions(rng, count), EDGE * (FAR / EDGE) ** rng.random(count)
    directions[:, 2] = np.abs(directions[:, 2])
    return directions * away[:, None], directions, away * np.sqrt(2 * np.pi / count)


def _floaters(rng: np.random.Generator, count: int) -> Piece:
    """Hang some in the air, anywhere the cameras go."""
    means = rng.uniform([-EDGE / 2, -EDGE / 2, 0], [EDGE / 2, EDGE / 2, 4], (count, 3))
    return means, _directions(rng, count), np.full(count, 0.05)


def _directions(rng: np.random.Generator, count: int) -> np.ndarray:
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions


def _camera(i: int, count: int, width: int, height: int) -> Camera:
    """On circles around the middle, one above the other, looking at it."""
    angle = 2 * np.pi * len(TURNS) * i / count
    position = np.array([DISTANCE * np.cos(angle), DISTANCE * np.sin(angle), TURNS[i * len(TURNS) // count]])
    forward = np.array([0.0, 0.0, 0.3]) - position
    forward /= np.linalg.norm(forward)
    pose = pose_looking(forward, np.array([0.0, 0, 1]), position)
    K = np.array([[0.75 * width, 0, width / 2], [0, 0.75 * width, height / 2], [0, 0, 1]])
    return Camera(f"view{i:03d}", width, height, K, pose)
