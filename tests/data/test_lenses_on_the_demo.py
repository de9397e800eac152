"""The demo's table through lenses of every kind: masks of bent images teach as much as those of a pinhole."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from lens_cases import COEFFICIENTS

from gsseg_core.data.camera_files import read_cameras
from gsseg_core.data.dataset import Dataset
from gsseg_core.data.label_images import UNKNOWN, write_mask
from gsseg_core.demo.furniture import CLASS_NAMES, Part, furnish
from gsseg_core.demo.table_scene import _cast_view
from gsseg_core.files.json_files import write_json
from gsseg_core.learn.vote_learner import VoteLearner
from gsseg_core.metrics import Evaluation
from gsseg_core.raster.backends import make_operator
from gsseg_core.refine.settings import UNREFINED
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.lens import MODELS_BY_NAME, Lens, Projection
from gsseg_core.segmentation import Segmentation

WIDTH, HEIGHT, FOCAL = 160, 120, 140.0
TRAIN, TEST = slice(0, 36, 6), slice(1, 36, 9)


def cast(parts: list[Part], lens: Lens, camera: Camera) -> np.ndarray:
    """Labels (H, W) that a lens sees at the place of a camera: of the first solid on each pixel's own ray."""
    columns, rows = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    rays = lens.rays(np.stack([columns, rows], axis=-1))
    labels = np.where(np.isnan(rays).any(axis=-1), UNKNOWN, np.int32(0))
    ahead = rays[..., 2] > 0.5 * np.linalg.norm(rays, axis=-1)  # All objects are within 60 degrees of where it looks.
    seen = rays[ahead] @ camera.world_to_camera[:3, :3]
    nearest, found = np.full(len(seen), np.inf), np.zeros(len(seen), np.int32)
    for part in parts:
        if part.label:
            distance = part.hit(camera.center, seen)
            found[distance < nearest] = part.label
            nearest = np.fmin(nearest, distance)
    labels[ahead] = found
    return labels


def lens_of_demo(name: str) -> Lens:
    if MODELS_BY_NAME[name].projection is Projection.PANORAMA:
        return Lens(MODELS_BY_NAME[name], 768, 384)
    middle = (WIDTH / 2, HEIGHT / 2)
    return Lens(MODELS_BY_NAME[name], WIDTH, HEIGHT, (FOCAL, FOCAL), middle, COEFFICIENTS.get(name, ()))


def write_dataset(root: Path, lens: Lens, cameras: list[Camera], parts: list[Part]) -> None:
    """Write a nerfstudio dataset of images that a lens took."""
    frames = []
    for camera in cameras:
        pose = np.linalg.inv(camera.world_to_camera) @ np.diag([1, -1, -1, 1])
        frames.append({"file_path": camera.name, "transform_matrix": pose.tolist()})
        write_mask(root / "labels" / f"{camera.name}.png", cast(parts, lens, camera), 8)
    coefficients = dict(zip(lens.model.coefficients, lens.coefficients, strict=False))
    intrinsics = {"fl_x": lens.focal[0], "fl_y": lens.focal[1], "cx": lens.principal[0], "cy": lens.principal[1]}
    content = {"camera_model": lens.model.name, "w": lens.width, "h": lens.height, **intrinsics, **coefficients}
    write_json(root / "transforms.json", {**content, "frames": frames})
    write_json(root / "classes.json", dict(enumerate(CLASS_NAMES)))


def score(scene: GaussianScene, dataset: Dataset, cameras: list[Camera], truths: list[np.ndarray]) -> float:
    """MIoU of what is learnt from all masks of a dataset, over views of a pinhole."""
    learner = VoteLearner(scene, len(CLASS_NAMES))
    learner.observe_all(dataset.views())
    result = Segmentation.from_codes(scene, learner.fit().codes_, dict(enumerate(CLASS_NAMES)), UNREFINED)
    evaluation = Evaluation()
    for camera, truth in zip(cameras, truths, strict=True):
        evaluation.add(truth, result.render(make_operator(scene, camera)).labels)
    return evaluation.mean_iou


@pytest.fixture(scope="module")
def table(demo_run: Path) -> tuple[GaussianScene, list[Camera], list[Part], list[np.ndarray]]:
    """The demo's scene, its cameras and solids, true labels of the test views, and what a pinhole's masks teach."""
    folder = next(demo_run.rglob("scene.ply")).parent
    scene, cameras, parts = GaussianScene.load(folder / "scene.ply"), read_cameras(folder), furnish()
    truths = [_cast_view(parts, camera) for camera in cameras[TEST]]
    return scene, cameras, parts, truths


@pytest.fixture(scope="module")
def pinhole(table: tuple, tmp_path_factory: pytest.TempPathFactory) -> float:
    scene, cameras, parts, truths = table
    root = tmp_path_factory.mktemp("pinhole")
    write_dataset(root, lens_of_demo("PINHOLE"), cameras[TRAIN], parts)
    return score(scene, Dataset(root), cameras[TEST], truths)


# One for each way of bending; that the equations of all are COLMAP's is tested in tests/scene/test_lens.py.
@pytest.mark.parametrize("name", ["OPENCV", "FISHEYE", "THIN_PRISM_FISHEYE", "EQUIRECTANGULAR"])
def test_masks_of_bent_images_teach_as_much_as_those_of_a_pinhole(
    table: tuple, pinhole: float, tmp_path: Path, name: str
) -> None:
    scene, cameras, parts, truths = table
    write_dataset(tmp_path, lens_of_demo(name), cameras[TRAIN], parts)
    bent = score(scene, Dataset(tmp_path), cameras[TEST], truths)
    assert pinhole > 0.8 and bent > pinhole - 0.015
