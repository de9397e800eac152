"""A small scene with known truth: eight objects on a table, as Gaussians, posed views, wrong masks and true ones.

The world has its origin on the floor under the middle of the table, z up, metres. Everything is made of ellipsoids,
boxes and truncated cones. The true masks are ray-cast from these solids and never see a Gaussian, so they are
independent of any rasteriser; the Gaussians are discs on the surfaces, with the defects that a trainer leaves: uneven
sizes and opacities, some inside the solids, some floating in the air.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from gsseg_core.data.label_images import write_mask
from gsseg_core.demo.mask_errors import corrupt
from gsseg_core.demo.solids import Box, Cone, Ellipsoid, Solid, dot
from gsseg_core.files.atomic import write_atomically
from gsseg_core.files.json_files import write_json
from gsseg_core.files.run_folder import staged_run
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.spherical_harmonics import C0, basis

CLASS_NAMES = ("background", "mug", "bowl", "book", "ball", "can", "box", "bottle", "apple", "table")
FLOATER = -1
"""True label of a Gaussian that belongs to nothing."""

TABLE_HEIGHT = 0.72
WIDTH, HEIGHT, FOCAL = 400, 300, 350.0  # px
NUM_VIEWS = 36
TEST_EVERY = 6

_SPACING = {"background": 0.065, "table": 0.009}  # between neighbouring Gaussians, m
_OBJECT_SPACING = 0.0038
_INTERIOR_SHARE = 0.05
_NUM_FLOATERS = 500
_LIGHT = np.array([-0.9, -1.1, 2.9])

Color = tuple[float, float, float]
"""Red, green and blue from 0 to 1."""


@dataclass(frozen=True)
class DemoScene:
    """A demo scene on disk and its truth.

    Attributes
    ----------
    root : pathlib.Path
        The dataset folder: scene.ply, cameras.json, classes.json, split.json, labels/, labels_true/ and truth.npz.
    scene : GaussianScene
        The N Gaussians in scene.ply.
    truth : ndarray (N,) int32
        True label of each Gaussian, `FLOATER` for those that belong to nothing; also `labels` in truth.npz.
    class_names : dict from id to name
        Background included.
    train, test : list of str
        Names of the views; labels/ has the train views only, labels_true/ all.
    """

    root: Path
    scene: GaussianScene
    truth: np.ndarray
    class_names: dict[int, str]
    train: list[str]
    test: list[str]


def build_demo(folder: str | os.PathLike[str], seed: int = 0) -> DemoScene:
    """Write the demo scene to a folder as a dataset like any other.

    The seed is that of the Gaussians' defects and of the errors in the masks; all else is always the same.

    Raises
    ------
    PathTakenError
        The folder holds other files of these names.
    WriteError
        The folder cannot be written to.
    """
    root = Path(folder)
    scene_rng, mask_rng = np.random.default_rng(seed).spawn(2)
    parts, cameras = furnish(), _make_cameras()
    viewpoints = np.array([camera.center for camera in cameras])
    pieces = [_float(scene_rng), *(_cover(part, parts, viewpoints, scene_rng) for part in parts)]
    *properties, truth = (np.concatenate(arrays) for arrays in zip(*pieces, strict=True))
    scene, truth = GaussianScene.from_arrays(*properties), truth.astype(np.int32)
    test = [camera.name for camera in cameras[TEST_EVERY // 2 :: TEST_EVERY]]
    train = [camera.name for camera in cameras if camera.name not in test]

    with staged_run(root, "demo") as run:
        scene.save(run.folder / "scene.ply")
        with write_atomically(run.folder / "truth.npz") as temporary:
            np.savez_compressed(temporary, labels=truth)
        write_json(run.folder / "cameras.json", [_as_3dgs(camera) for camera in cameras])
        write_json(run.folder / "classes.json", dict(enumerate(CLASS_NAMES)))
        write_json(run.folder / "split.json", {"train": train, "test": test})
        for camera in cameras:
            labels = _cast_view(parts, camera)
            write_mask(run.folder / "labels_true" / f"{camera.name}.png", labels, bits=8)
            if camera.name in train:
                write_mask(run.folder / "labels" / f"{camera.name}.png", corrupt(labels, mask_rng), bits=8)
    return DemoScene(root, scene, truth, dict(enumerate(CLASS_NAMES)), train, test)


# The room


@dataclass(frozen=True)
class Part:
    """A solid in its place: turned about its z axis, then moved."""

    label: int
    solid: Solid
    color: Color
    position: tuple[float, float, float]
    yaw: float = 0.0  # degrees

    @cached_property
    def rotation(self) -> np.ndarray:
        """(3, 3), from the solid's frame to the world."""
        c, s = np.cos(np.radians(self.yaw)), np.sin(np.radians(self.yaw))
        return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])

    @cached_property
    def corners(self) -> np.ndarray:
        """Corners (8, 3) of the bounding box in the world."""
        grid = np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, 8).T
        low, high = self.solid.corners
        corners: np.ndarray = (low + grid * (high - low)) @ self.rotation.T + self.position
        return corners

    def hit(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Distances along world rays."""
        with np.errstate(divide="ignore", invalid="ignore"):  # rays beside or along a surface
            return self.solid.hit((origins - self.position) @ self.rotation, directions @ self.rotation)

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Which world points (M, 3) are in it, (M,) bool."""
        return self.solid.contains((points - self.position) @ self.rotation)

    def sample(self, u: np.ndarray, inset: float) -> tuple[np.ndarray, np.ndarray]:
        """Surface points and normals in the world."""
        points, normals = self.solid.sample(u, inset)
        return points @ self.rotation.T + self.position, normals @ self.rotation.T


def furnish() -> list[Part]:
    """All parts: floor, table, and the eight objects resting on the table or on each other."""
    parts: list[Part] = []

    def add(name: str, solid: Solid, color: Color, x: float, y: float, z: float = 0.0, yaw: float = 0.0) -> None:
        """Add a part whose z is that above the table top."""
        parts.append(Part(CLASS_NAMES.index(name), solid, color, (x, y, TABLE_HEIGHT + z), yaw))

    wood, floor = (0.66, 0.46, 0.29), (0.60, 0.60, 0.58)
    add("background", Box((4.4, 4.0, 0.02)), floor, 0, 0, -TABLE_HEIGHT - 0.02)
    for x, y, yaw in ((2.2, 0, 90), (-2.2, 0, 90), (0, 2.0, 0), (0, -2.0, 0)):
        add("background", Box((4.4 if y else 4.0, 0.02, 1.7)), (0.78, 0.76, 0.70), x, y, -TABLE_HEIGHT, yaw)
    add("table", Box((1.0, 0.7, 0.03)), wood, 0, 0, -0.03)
    for x, y in ((-0.45, -0.3), (0.45, -0.3), (-0.45, 0.3), (0.45, 0.3)):
        add("table", Cone(0.018, 0.025, TABLE_HEIGHT - 0.03), wood, x, y, -TABLE_HEIGHT)

    add("book", Box((0.24, 0.17, 0.006)), (0.10, 0.38, 0.36), -0.15, 0.10, yaw=20)
    add("book", Box((0.23, 0.16, 0.026)), (0.93, 0.90, 0.82), -0.15, 0.10, 0.006, yaw=20)
    add("book", Box((0.24, 0.17, 0.006)), (0.10, 0.38, 0.36), -0.15, 0.10, 0.032, yaw=20)
    add("apple", Ellipsoid((0.038, 0.038, 0.034)), (0.74, 0.12, 0.14), -0.12, 0.09, 0.072)
    add("apple", Cone(0.003, 0.003, 0.016), (0.32, 0.22, 0.14), -0.12, 0.09, 0.102)

    add("box", Box((0.15, 0.065, 0.20)), (0.90, 0.55, 0.18), 0.05, 0.20, yaw=-14)
    bottle, x, y = (0.14, 0.45, 0.26), 0.19, 0.12
    add("bottle", Cone(0.037, 0.037, 0.15), bottle, x, y)
    add("bottle", Cone(0.037, 0.014, 0.05), bottle, x, y, 0.15)
    add("bottle", Cone(0.014, 0.014, 0.04), bottle, x, y, 0.20)
    add("bottle", Cone(0.016, 0.016, 0.016), (0.90, 0.88, 0.84), x, y, 0.24)

    metal, x, y = (0.74, 0.75, 0.78), 0.09, 0.03
    add("can", Cone(0.031, 0.033, 0.012), metal, x, y)
    add("can", Cone(0.033, 0.033, 0.091), (0.75, 0.16, 0.45), x, y, 0.012)
    add("can", Cone(0.033, 0.029, 0.012), metal, x, y, 0.103)

    mug, x, y = (0.90, 0.86, 0.76), -0.03, -0.05
    add("mug", Cone(0.040, 0.042, 0.095, hollow=True), mug, x, y)
    for z, size in ((0.020, (0.034, 0.012, 0.011)), (0.068, (0.034, 0.012, 0.011)), (0.020, (0.011, 0.012, 0.059))):
        out = 0.053 if size[2] < 0.02 else 0.070  # two arms and the grip between them
        turn = np.radians(-150)
        add("mug", Box(size), mug, x + out * np.cos(turn), y + out * np.sin(turn), z, yaw=-150)
    add("bowl", Cone(0.040, 0.080, 0.060, hollow=True), (0.24, 0.42, 0.75), 0.14, -0.13)
    add("ball", Ellipsoid((0.055, 0.055, 0.055)), (0.95, 0.78, 0.18), -0.19, -0.12, 0.055)
    return parts


# Views


def _make_cameras() -> list[Camera]:
    """Two rings around the table, the lower one looking along it, the upper one down on it."""
    target = np.array([0.0, 0.01, TABLE_HEIGHT + 0.05])
    cameras = []
    for i in range(NUM_VIEWS):
        upper, step = divmod(i, NUM_VIEWS // 2)
        angle = 2 * np.pi * (step + upper / 2) / (NUM_VIEWS // 2)
        radius, height = ((0.82, 0.30), (0.60, 0.72))[upper]
        position = target + np.array([radius * np.cos(angle), radius * np.sin(angle), height])
        forward = (target - position) / np.linalg.norm(target - position)
        right = np.cross(forward, (0, 0, 1))
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = right, np.cross(forward, right), forward
        pose[:3, 3] = -pose[:3, :3] @ position
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


def _as_3dgs(camera: Camera) -> dict[str, object]:
    """One entry of cameras.json."""
    return {
        "id": int(camera.name),
        "img_name": camera.name,
        "width": camera.width,
        "height": camera.height,
        "position": camera.center.tolist(),
        "rotation": camera.world_to_camera[:3, :3].T.tolist(),
        "fx": camera.fx,
        "fy": camera.fy,
    }


# Gaussians


def _cover(part: Part, parts: list[Part], viewpoints: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Gaussians of one part seen from viewpoints (V, 3): means, quats, scales, opacities, sh, labels."""
    spacing = _SPACING.get(CLASS_NAMES[part.label], _OBJECT_SPACING)
    # A disc reaches beyond the edge of its face, and pixels blur it; training draws discs back from outlines.
    drawn_back = 0.9 * spacing if part.label else 0.0
    points, normals = part.sample(rng.random((round(4 * part.solid.area / spacing**2), 3)), inset=drawn_back)

    # A trainer has no reason to put anything where solids touch, or on a surface that no camera faces.
    faced = (dot(normals[:, None], viewpoints - points[:, None]) > 0).any(axis=1)
    touching = np.any([other.contains(points + 0.002 * normals) for other in parts if other is not part], axis=0)
    points, normals = points[faced & ~touching], normals[faced & ~touching]
    # Off the surface, so that the two sides of a thin wall do not count as near.
    kept = _thin(points + spacing * normals, 0.8 * spacing)
    points, normals = points[kept], normals[kept]
    n = len(points)

    tangents = np.cross(normals, rng.normal(size=(n, 3)))
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    frames = np.stack([tangents, np.cross(normals, tangents), normals], axis=-1)
    quats = np.roll(Rotation.from_matrix(frames).as_quat(), 1, axis=1)
    scales = spacing * np.array([0.78, 0.78, 0.07]) * rng.lognormal(0, [0.3, 0.3, 0.5], (n, 3))
    means = points - normals * (0.55 * drawn_back + 0.06 * spacing * rng.normal(size=(n, 1)))
    opacities = np.where(rng.random(n) < 0.9, rng.beta(12, 1, n), rng.uniform(0.05, 0.6, n))
    sh = _shade(part, parts, points, normals, rng)
    if not (isinstance(part.solid, Cone) and part.solid.hollow):  # inside a cup one can see
        inside = rng.random(n) < _INTERIOR_SHARE
        middle = part.corners.mean(axis=0)
        means[inside] = middle + (means[inside] - middle) * rng.uniform(0.3, 0.95, (int(inside.sum()), 1))
    return means, quats, scales, opacities, sh, np.full(n, part.label)


def _thin(points: np.ndarray, distance: float) -> np.ndarray:
    """Choose points (M, 3), (M,) bool, none of which are nearer to each other; the earlier of two goes first."""
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


def _float(rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Pale Gaussians in the air around the table."""
    n = _NUM_FLOATERS
    means = rng.uniform((-0.9, -0.8, 0.2), (0.9, 0.8, 1.4), (n, 3))
    scales = rng.lognormal(np.log(0.008), 0.5, (n, 3))
    sh = np.zeros((n, 4, 3))
    sh[:, 0] = (rng.uniform(0.35, 0.75, (n, 1)) - 0.5) / C0
    return means, rng.normal(size=(n, 4)), scales, rng.uniform(0.02, 0.2, n), sh, np.full(n, FLOATER)


def _shade(
    part: Part, parts: list[Part], points: np.ndarray, normals: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """SH coefficients (M, 4, 3) at points (M, 3), lit by the sky and a lamp that casts soft shadows, with a sheen."""
    start = points + 1e-3 * normals
    lamp = np.zeros(len(points))
    for offset in rng.normal(0, 0.12, (3, 3)):
        towards = _LIGHT + offset - start
        blocked = np.any([other.hit(start, towards) < 1 for other in parts if other.label], axis=0)
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        lamp += np.maximum(dot(towards, normals), 0) * ~blocked / 3
    light = 0.46 + 0.10 * normals[:, 2] + 0.52 * lamp
    grain = rng.normal(1, 0.03, len(points))
    if CLASS_NAMES[part.label] == "table":
        x, y, _ = points.T
        grain += 0.07 * np.sin(130 * y + 5 * np.sin(4 * x) + 9 * np.sin(11 * y))
    elif part.label == 0:  # tiles
        grain -= 0.1 * ((np.floor(points[:, 0] / 0.3) + np.floor(points[:, 1] / 0.3)) % 2) * (normals[:, 2] > 0.5)
    color = np.array(part.color) * (light * grain)[:, None]

    towards = (_LIGHT - points) / np.linalg.norm(_LIGHT - points, axis=1, keepdims=True)
    mirrored = 2 * dot(towards, normals)[:, None] * normals - towards
    sheen = 0.0 if part.label == 0 else 0.06 * lamp
    sh = np.zeros((len(points), 4, 3))
    sh[:, 0] = (color - 0.5) / C0
    # Of degree 1 a colour varies with the cosine to one direction; the viewer looks along -mirrored at the highlight.
    sh[:, 1:] = (-sheen * basis(mirrored, 1)[:, 1:].T / (3 * C0 * C0)).T[..., None]
    return sh
