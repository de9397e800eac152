"""The demo scene: a dataset like any other, whose masks and Gaussians tell the same story."""

from __future__ import annotations

import pickle
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

from gsseg_core.data.dataset import Dataset
from gsseg_core.data.label_images import read_mask
from gsseg_core.demo import table_scene
from gsseg_core.demo.furniture import CLASS_NAMES
from gsseg_core.demo.solids import WALL, Box, Cone, Ellipsoid, Solid
from gsseg_core.demo.table_scene import FLOATER, DemoScene, build_demo
from gsseg_core.scene.gaussian_scene import GaussianScene


@pytest.fixture(scope="module")
def demo(demo_run: Path) -> DemoScene:
    built: DemoScene = pickle.loads((demo_run / "built.pickle").read_bytes())
    return built


def test_the_folder_is_a_dataset_with_train_and_test_views(demo: DemoScene) -> None:
    dataset = Dataset(demo.root)
    assert dataset.class_names == demo.class_names == dict(enumerate(CLASS_NAMES))
    train, test = dataset.views("train"), dataset.views("test")
    assert [view.name for view in train] == demo.train and len(train) == 30
    assert [view.name for view in test] == demo.test and len(test) == 6
    for view in train:
        assert view.read_labels().shape == (300, 400)
    assert all(view.mask_path is None for view in test)
    assert len(Dataset(demo.root, labels="labels_true").views("test")) == 6


def test_the_scene_on_disk_is_the_one_returned_with_a_true_label_each(demo: DemoScene) -> None:
    scene = GaussianScene.load(demo.root / "scene.ply")
    assert scene.digest == demo.scene.digest
    assert scene.sh_degree == 1
    assert 35_000 < len(scene) < 50_000
    truth = np.load(demo.root / "truth.npz")["labels"]
    np.testing.assert_array_equal(truth, demo.truth)
    assert truth.dtype == np.int32 and truth.shape == (len(scene),)
    counts = np.bincount(truth - FLOATER)
    assert len(counts) == len(CLASS_NAMES) + 1 and counts.min() >= 500


def test_every_object_is_seen_and_some_hide_others(demo: DemoScene) -> None:
    views = [read_mask(path).labels for path in sorted((demo.root / "labels_true").iterdir())]
    pixels = np.array([np.bincount(labels.ravel(), minlength=len(CLASS_NAMES)) for labels in views])
    assert len(views) == 36
    assert ((pixels > 200).sum(axis=0) >= 12).all()
    assert (pixels.min(axis=0)[1:9] < 0.5 * np.median(pixels, axis=0)[1:9]).sum() >= 4


def test_gaussians_project_into_the_true_masks_of_their_class(demo: DemoScene) -> None:
    dataset = Dataset(demo.root, labels="labels_true")
    seen_own = np.zeros(len(demo.scene), bool)
    for view in dataset.views("all"):
        uv, depth = view.camera.project(demo.scene.means)
        inside = (depth > 0) & (uv >= 0).all(axis=1) & (uv < [view.camera.width, view.camera.height]).all(axis=1)
        columns, rows = uv[inside].astype(int).T
        seen_own[inside] |= view.read_labels()[rows, columns] == demo.truth[inside]
    assert seen_own[demo.truth > 0].mean() > 0.99


def test_train_masks_have_errors_and_test_masks_stay_hidden(demo: DemoScene) -> None:
    assert sorted(path.stem for path in (demo.root / "labels").iterdir()) == demo.train
    wrong = []
    for name in demo.train:
        truth, seen = (read_mask(demo.root / folder / f"{name}.png").labels for folder in ("labels_true", "labels"))
        objects = (truth > 0) & (truth < 9)
        wrong.append((truth != seen)[objects].mean())
    assert 0.15 < np.mean(wrong) < 0.45


@pytest.fixture(scope="module")
def small_demos(tmp_path_factory: pytest.TempPathFactory) -> list[DemoScene]:
    """Demos of seeds 0, 0 and 1 with few views and few Gaussians."""
    sizes = {"NUM_VIEWS": 4, "_SPACING": {"background": 0.3, "table": 0.04}, "_OBJECT_SPACING": 0.016}
    with mock.patch.multiple(table_scene, **sizes):
        return [build_demo(tmp_path_factory.mktemp("demo"), seed) for seed in (0, 0, 1)]


def test_the_same_seed_gives_the_same_files(small_demos: list[DemoScene]) -> None:
    first, again, _ = (
        {path.relative_to(demo.root): path.read_bytes() for path in demo.root.glob("**/[!.]*.*")}
        for demo in small_demos
    )
    assert len(first) == 5 + 3 + 4 and first == again


def test_another_seed_gives_other_gaussians_and_wrong_masks_but_the_same_solids(small_demos: list[DemoScene]) -> None:
    one, _, other = small_demos
    assert one.scene.digest != other.scene.digest
    for name in one.train:
        for folder, same in (("labels", False), ("labels_true", True)):
            masks = [(demo.root / folder / f"{name}.png").read_bytes() for demo in (one, other)]
            assert (masks[0] == masks[1]) == same


@pytest.mark.parametrize(
    "solid",
    [
        Ellipsoid((0.3, 0.32, 0.28)),
        Box((0.4, 0.2, 0.6)),
        Cone(0.3, 0.3, 0.5),
        Cone(0.3, 0.1, 0.4),
        Cone(0.2, 0.0, 0.4),
        Cone(0.2, 0.3, 0.3, hollow=True),
    ],
    ids=str,
)
def test_rays_from_outside_hit_a_solid_where_its_surface_was_sampled(solid: Solid) -> None:
    rng = np.random.default_rng(0)
    points, normals = solid.sample(rng.random((2000, 3)), inset=0.0)
    low, high = solid.corners
    assert (points >= low - 1e-9).all() and (points <= high + 1e-9).all()
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        distances = solid.hit(points + 1e-4 * normals, -normals)
        misses = solid.hit(points + (high - low).max() * 4, np.ones_like(points))
    # Rays meet a cup's outer side, which from the inside is a wall further away.
    assert (distances < 2e-4 + (WALL if getattr(solid, "hollow", False) else 0)).mean() > 0.99
    assert np.isinf(misses).all()


@pytest.mark.parametrize("solid", [Ellipsoid((0.3, 0.32, 0.28)), Box((0.4, 0.2, 0.6)), Cone(0.3, 0.1, 0.4)], ids=str)
def test_a_solid_contains_what_lies_under_its_surface_and_nothing_above_it(solid: Solid) -> None:
    points, normals = solid.sample(np.random.default_rng(0).random((2000, 3)), inset=0.0)
    assert solid.contains(points - 1e-6 * normals).mean() > 0.999
    assert not solid.contains(points + 1e-6 * normals).any()
