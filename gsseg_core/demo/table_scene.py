"""A small scene with known truth: eight objects on a table, as Gaussians, posed views, wrong masks and true ones.

The world has its origin on the floor under the middle of the table, z up, metres. Everything is made of ellipsoids,
boxes and truncated cones. The true masks are ray-cast from these solids and never see a Gaussian, so they are
independent of any rasteriser; the Gaussians are discs on the surfaces, with the defects that a trainer leaves: uneven
sizes and opacities, some inside the solids, some floating in the air.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from gsseg_core.data.camera_formats.gaussian_splatting import write_3dgs
from gsseg_core.data.label_images import write_mask
from gsseg_core.demo.furniture import CLASS_NAMES, TABLE_HEIGHT, Part, furnish
from gsseg_core.demo.lighting import shade
from gsseg_core.demo.mask_errors import corrupt
from gsseg_core.demo.solids import Cone, dot
from gsseg_core.files.atomic import write_atomically
from gsseg_core.files.json_files import write_json
from gsseg_core.files.run_folder import staged_run
from gsseg_core.scene.camera import Camera, pose_looking
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.spherical_harmonics import C0

FLOATER = -1  # true label of a Gaussian that belongs to nothing
WIDTH, HEIGHT, FOCAL = 400, 300, 350.0  # px
NUM_VIEWS = 36
TEST_EVERY = 6

_SPACING = {"background": 0.048, "table": 0.0085}  # between neighbouring Gaussians, m
_OBJECT_SPACING = 0.0036
_INTERIOR_SHARE = 0.05
_NUM_FLOATERS = 500


@dataclass(frozen=True)
class DemoScene:
    """A demo scene on disk and its truth."""

    root: Path  # the dataset folder, with the truth in labels_true/ and truth.npz
    scene: GaussianScene  # N Gaussians
    truth: np.ndarray  # (N,) int32: true label of each Gaussian, `FLOATER` for those that belong to nothing
    class_names: dict[int, str]  # background included
    train: list[str]  # names of the views, which labels/ has
    test: list[str]  # names of the views that labels_true/ alone has


def build_demo(folder: str | os.PathLike[str], seed: int = 0) -> DemoScene:
    """Write the demo scene to a folder as a dataset like any other.

    The seed is that of the Gaussians' defects and of the errors in the masks; all else is always the same. Raises
    `PathTakenError` where the folder holds other files of these names, `WriteError` where it cannot be written to.
    """
    root = Path(folder)
    scene_rng, mask_rng = np.random.default_rng(seed).spawn(2)
    parts, cameras = furnish(), _make_cameras()
    viewpoints = np.array([camera.center for camera in cameras])
    pieces = [_floaters(scene_rng), *(_cover(part, parts, viewpoints, scene_rng) for part in parts)]
    *properties, truth = (np.concatenate(arrays) for arrays in zip(*pieces, strict=True))
    scene, truth = GaussianScene.from_arrays(*properties), truth.astype(np.int32)
    test = [camera.name for camera in cameras[TEST_EVERY // 2 :: TEST_EVERY]]
    train = [camera.name for camera in cameras if camera.name not in test]

    with staged_run(root, "demo") as run:
        scene.save(run.folder / "scene.ply")
        with write_atomically(run.folder / "truth.npz") as temporary:
            np.savez_compressed(temporary, labels=truth)
        write_3dgs(run.folder / "cameras.json", cameras)
        write_json(run.folder / "classes.json", dict(enumerate(CLASS_NAMES)))
        write_json(run.folder / "split.json", {"train": train, "test": test})
        for camera in cameras:
            labels = _cast_view(parts, camera)
            write_mask(run.folder / "labels_true" / f"{camera.name}.png", labels, bits=8)
            if camera.name in train:
                write_mask(run.folder / "labels" / f"{camera.name}.png", corrupt(labels, mask_rng), bits=8)
    return DemoScene(root, scene, truth, dict(enumerate(CLASS_NAMES)), train, test)


# Views


def _make_cameras() -> list[Camera]:
    """Two rings around the table, the lower one looking along it, the upper one down on it."""
    target = np.array([-0.01, 0.03, TABLE_HEIGHT + 0.05])
    cameras = []
    for i in range(NUM_VIEWS):
        upper, step = divmod(i, NUM_VIEWS // 2)
        angle = 2 * np.pi * (step + upper / 2) / (NUM_VIEWS // 2)
        radius, height = ((0.70, 0.28), (0.52, 0.62))[upper]
        position = target + np.array([radius * np.cos(angle), radius * np.sin(angle), height])
        forward = (target - position) / np.linalg.norm(target - position)
        pose = pose_looking(forward, np.array([0.0, 0, 1]), position)
        K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
        cameras.append(Camera(f"{i:04d}", WIDTH, HEIGHT, K, pose))
    return cameras


def _cast_view(parts: list[Part], camera: Camera) -> np.ndarray:
    """(H, W) int32, label of the first solid that the ray through each pixel's centre meets."""
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    local = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones_like(rows)], axis=-1)
    directions = local @ camera.world_to_camera[:3, :3]
    labels = np.zeros(columns.shape, np.int32)
    nearest = np.full(columns.shape, np.inf)
    for part in parts:
        if part.label == 0:  # the floor hides nothing
            continue
        uv, _ = camera.project(part.corners)
        if np.isnan(uv).any():  # partly behind the camera: the corners do not bound it
            uv = np.array([[0, 0], [camera.width, camera.height]])
        (left, top), (right, bottom) = np.floor(np.maximum(uv.min(axis=0), 0)), np.ceil(np.maximum(uv.max(axis=0), 0))
        window = slice(int(top), int(bottom)), slice(int(left), int(right))
        distance = part.hit(camera.center, directions[window])
        nearer = distance < nearest[window]
        nearest[window][nearer] = distance[nearer]
        labels[window][nearer] = part.label
    return labels


# Gaussians


def _cover(part: Part, parts: list[Part], viewpoints: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Gaussians of one part seen from viewpoints (V, 3): means, quats, scales, opacities, sh, labels."""
    spacing = _SPACING.get(CLASS_NAMES[part.label], _OBJECT_SPACING)
    # A disc reaches beyond the edge of its face, and pixels blur it; training draws discs back from outlines.
    drawn_back = spacing if part.label else 0.0
    points, normals = part.sample(rng.random((round(4 * part.solid.area / spacing**2), 3)), inset=0.75 * drawn_back)

    # A trainer has no reason to put anything where solids touch, or on a surface that no camera faces.
    faced = (dot(normals[:, None], viewpoints - points[:, None]) > 0).any(axis=1)
    touching = np.any([other.contains(points + 0.002 * normals) for other in parts if other is not part], axis=0)
    points, normals = points[faced & ~touching], normals[faced & ~touching]
    # Off the surface, so that the two sides of a thin wall do not count as near.
    kept = _thin(points + spacing * normals, 0.8 * spacing)
    points, normals = points[kept], normals[kept]
    n = len(points)

    frames, to_edge = _lay(part, points, normals, 2 * spacing)
    quats = np.roll(Rotation.from_matrix(frames).as_quat(), 1, axis=1)
    wide = 0.78 if part.label else 1.0  # the few discs of a wall leave no gaps
    scales = spacing * np.array([wide, wide, 0.07]) * rng.lognormal(0, [0.3, 0.3, 0.5], (n, 3))
    scales[:, :2] = np.minimum(scales[:, :2], to_edge / 1.4)
    means = points - normals * (0.5 * drawn_back + 0.06 * spacing * rng.normal(size=(n, 1)))
    opacities = np.where(rng.random(n) < 0.9, rng.beta(12, 1, n), rng.uniform(0.05, 0.6, n))
    sh = shade(part, parts, points, normals, rng)
    if not (isinstance(part.solid, Cone) and part.solid.hollow):  # inside a cup one can see
        inside = rng.random(n) < _INTERIOR_SHARE
        middle = part.corners.mean(axis=0)
        means[inside] = middle + (means[inside] - middle) * rng.uniform(0.3, 0.95, (int(inside.sum()), 1))
    return means, quats, scales, opacities, sh, np.full(n, part.label)


def _lay(part: Part, points: np.ndarray, normals: np.ndarray, most: float) -> tuple[np.ndarray, np.ndarray]:
    """Lay discs on a surface along its edges, as training does: frames (M, 3, 3), and distances (M, 2) to the edges.

    The columns of a frame are two tangents and the normal. A distance is how far the surface goes on both ways along
    a tangent, `most` metres at most.
    """
    level = np.cross(part.rotation[:, 2], normals)
    level[np.abs(normals @ part.rotation[:, 2]) > 0.99] = part.rotation[:, 0]
    level /= np.linalg.norm(level, axis=1, keepdims=True)
    frames = np.stack([level, np.cross(normals, level), normals], axis=-1)
    to_edge = np.full((len(points), 2), 0.2 * most)
    for axis in (0, 1):
        goes_on = np.ones(len(points), bool)
        for step in (0.4 * most, 0.7 * most, most):
            for way in (step, -step):
                goes_on &= part.contains(points + way * frames[..., axis] - 0.002 * normals)
            to_edge[goes_on, axis] = step
    return frames, to_edge


def _thin(points: np.ndarray, distance: float) -> np.ndarray:
    """Choose points (M, 3), no two of them nearer than a distance, (M,) bool; of two that are, the earlier stays."""
    first, second = cKDTree(points).query_pairs(distance, output_type="ndarray").T
    undecided, chosen = np.ones(len(points), bool), np.zeros(len(points), bool)
    while undecided.any():
        sure = undecided.copy()
        sure[second] = False
        chosen |= sure
        undecided &= ~sure
        undecided[second[sure[first]]] = False
        open_pairs = undecided[first] & undecided[second]
        first, second = first[open_pairs], second[open_pairs]
    return chosen


def _floaters(rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Pale Gaussians in the air around the table."""
    n = _NUM_FLOATERS
    means = rng.uniform((-0.9, -0.8, 0.2), (0.9, 0.8, 1.4), (n, 3))
    scales = rng.lognormal(np.log(0.008), 0.5, (n, 3))
    sh = np.zeros((n, 4, 3))
    sh[:, 0] = (rng.uniform(0.35, 0.75, (n, 1)) - 0.5) / C0
    return means, rng.normal(size=(n, 4)), scales, rng.uniform(0.02, 0.2, n), sh, np.full(n, FLOATER)
