"""A table with three balls on it, seen by a ring of small cameras: the label of every Gaussian is known."""

from __future__ import annotations

import functools
import json
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from gsseg_core.data.camera_formats.gaussian_splatting import write_3dgs
from gsseg_core.data.label_images import write_mask
from gsseg_core.data.view import View
from gsseg_core.export.pictures import palette
from gsseg_core.learn.learner import Learner
from gsseg_core.live.session import LiveSession
from gsseg_core.metrics import Evaluation
from gsseg_core.raster.backends import make_operator
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.spherical_harmonics import C0
from gsseg_core.segmentation import Segmentation

WIDTH, HEIGHT = 64, 48
NAMES = {0: "background", 1: "red ball", 2: "cup/mug", 3: "box"}
NUM_CLASSES = len(NAMES)
OUT_OF_SIGHT = 5
"""The last Gaussians of the scene hang far above, behind every camera."""


def build(truth: np.ndarray, means: np.ndarray, scales: np.ndarray) -> GaussianScene:
    colors = palette(int(truth.max()) + 1)[truth] / 255
    quats = np.tile([1.0, 0, 0, 0], (len(truth), 1))
    return GaussianScene.from_arrays(means, quats, scales, np.full(len(truth), 0.95), ((colors - 0.5) / C0)[:, None])


def balls_on_a_table(seed: int = 0) -> tuple[GaussianScene, np.ndarray]:
    """The scene, and the label of every Gaussian."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.linspace(-2, 2, 21), np.linspace(-2, 2, 21))
    table = np.stack([x.ravel(), y.ravel(), rng.uniform(-0.01, 0.01, x.size)], axis=1)
    directions = rng.normal(size=(3, 60, 3))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    angles = np.arange(3) * 2 * np.pi / 3
    centres = np.stack([np.cos(angles), np.sin(angles), np.full(3, 0.45)], axis=1)
    balls = (centres[:, None] + 0.4 * directions).reshape(-1, 3)
    lost = np.array([0, 0, 100]) + rng.uniform(-1, 1, (OUT_OF_SIGHT, 3))
    truth = np.repeat([0, 1, 2, 3, 0], [len(table), 60, 60, 60, OUT_OF_SIGHT])
    scales = np.repeat([[0.12, 0.12, 0.01], [0.09, 0.09, 0.09]], [len(table), 180 + OUT_OF_SIGHT], axis=0)
    return build(truth, np.concatenate([table, balls, lost]), scales), truth


def many_classes(count: int = 300) -> tuple[GaussianScene, np.ndarray]:
    """One Gaussian for each of many classes, on a grid."""
    truth = np.arange(count)
    means = np.stack([truth % 20 - 9.5, truth // 20 - 7.0, 0 * truth], axis=1) * 0.15
    return build(truth, means, np.full((count, 3), 0.04)), truth


def look_at(name: str, position: np.ndarray, width: int = WIDTH, height: int = HEIGHT, focal: float = 55.0) -> Camera:
    """A camera that looks at the origin, the world's z being up."""
    forward = -position / np.linalg.norm(position)
    right = np.cross(forward, [0, 1, 0] if abs(forward[2]) > 0.99 else [0, 0, 1])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    pose = np.block([[rotation, -rotation @ position[:, None]], [np.zeros(3), 1.0]])
    return Camera(name, width, height, K, pose)


def ring(count: int, prefix: str = "view", turn: float = 0.0) -> list[Camera]:
    angles = 2 * np.pi * (np.arange(count) + turn) / count
    return [look_at(f"{prefix}{i}", np.array([3 * np.cos(a), 3 * np.sin(a), 3.0])) for i, a in enumerate(angles)]


def true_labels(scene: GaussianScene, truth: np.ndarray, camera: Camera) -> np.ndarray:
    operator = make_operator(scene, camera)
    image = operator.render(np.eye(truth.max() + 1, dtype=np.float32)[truth])
    image[..., 0] += operator.transmittance()
    return image.argmax(axis=2).astype(np.int32)


@functools.cache
def _masks_of_the_table(count: int, turn: float) -> tuple[np.ndarray, ...]:
    scene, truth = balls_on_a_table()
    return tuple(true_labels(scene, truth, camera) for camera in ring(count, turn=turn))


def clean_views(count: int = 5, prefix: str = "view", turn: float = 0.0) -> list[View]:
    masks = _masks_of_the_table(count, turn)
    return [
        View.from_arrays(camera, labels.copy()) for camera, labels in zip(ring(count, prefix, turn), masks, strict=True)
    ]


def wrong_views(count: int = 8, *, seed: int = 0, missed: float = 0.2, swapped: float = 0.2) -> list[View]:
    """Views in which some objects were missed, and some taken for another one."""
    rng, views = np.random.default_rng(seed), []
    for view in clean_views(count):
        truth = view.read_labels()
        labels = truth.copy()
        for k in range(1, NUM_CLASSES):
            draw = rng.random()
            if draw < missed:
                labels[truth == k] = 0
            elif draw < missed + swapped:
                labels[truth == k] = k % 3 + 1
        views.append(View.from_arrays(view.camera, labels))
    return views


def lost_half_way(views: Sequence[View]) -> list[View]:
    """In the later half, each object has another id, as where a tracker lost it and named it anew."""
    labels = [view.read_labels() + NUM_CLASSES * (view.read_labels() > 0) for view in views[len(views) // 2 :]]
    later = [View.from_arrays(view.camera, one) for view, one in zip(views[len(views) // 2 :], labels, strict=True)]
    return [*views[: len(views) // 2], *later]


def with_clutter(view: View, label: int = 3) -> View:
    """Put a blob into a corner, where the table is."""
    labels = view.read_labels()
    labels[-16:, :12] = label
    return View.from_arrays(view.camera, labels)


def taught(learner: Learner, views: list[View]) -> Learner:
    for view in views:
        assert learner.observe(view)
    return learner


def fed(session: LiveSession, views: list[View] | None = None) -> LiveSession:
    """A session with views fused, six clean ones unless others are given."""
    for view in clean_views(6) if views is None else views:
        assert session.fuse(view) is None
    return session


def mean_iou(learner: Learner) -> float:
    """Score of what was learnt, in views that were not learnt from."""
    scene, evaluation = learner.scene, Evaluation()
    result = Segmentation.from_codes(scene, learner.codes_, NAMES)
    for view in clean_views(4, "test", 0.3):
        evaluation.add(view.read_labels(), result.render(make_operator(scene, view.camera)).labels)
    return evaluation.mean_iou


def write_dataset(
    folder: Path,
    scene: GaussianScene | None = None,
    truth: np.ndarray | None = None,
    cameras: list[Camera] | None = None,
    names: dict[int, str] | None = None,
    bits: int = 8,
) -> Path:
    """A dataset on disk, the scene beside its cameras; every third view is for testing."""
    masks: Iterable[np.ndarray] | None = None
    if scene is None or truth is None:
        (scene, truth), names = balls_on_a_table(), NAMES
        masks = None if cameras else _masks_of_the_table(6, 0.0)
    cameras = cameras or ring(6)
    folder.mkdir(parents=True, exist_ok=True)
    scene.save(folder / "scene.ply")
    write_3dgs(folder / "cameras.json", cameras)
    if names:
        (folder / "classes.json").write_text(json.dumps({str(k): name for k, name in names.items() if k}))
    stems = [camera.name for camera in cameras]
    split = {"train": [s for i, s in enumerate(stems) if i % 3 != 2], "test": stems[2::3]}
    (folder / "split.json").write_text(json.dumps(split))
    for camera, labels in zip(cameras, masks or (true_labels(scene, truth, camera) for camera in cameras), strict=True):
        write_mask(folder / "labels" / f"{camera.name}.png", labels, bits)
    return folder


def make_grid(rows: int = 5, columns: int = 6, size: int = 16, gap: int = 8) -> np.ndarray:
    """Square objects 1, 2, 3, ... on background."""
    ids = np.arange(1, rows * columns + 1, dtype=np.int32).reshape(rows, columns)
    cell = np.pad(np.ones((size, size), np.int32), gap)
    return np.kron(ids, cell)
