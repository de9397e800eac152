"""The 3D preview of the report page holds the scene, smaller."""

from __future__ import annotations

import base64
import json
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from parts_of_balls import tree_of_balls
from small_scenes import NUM_CLASSES, balls_on_a_table, look_at

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.object_tree import ObjectTree
from gsseg_core.report.preview import RECORD, Preview, look_from, make_preview, up_of
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import REMOVED, UNOBSERVED, Segmentation

SCENE, TRUTH = balls_on_a_table()


def result_of(labels: np.ndarray, scene: GaussianScene = SCENE) -> Segmentation:
    codes = np.eye(NUM_CLASSES, dtype=np.float32)[np.maximum(labels, 0)] * 0.75
    names = {k: str(k) for k in range(NUM_CLASSES)}
    none = np.zeros(len(labels), bool)
    rows = CSRRows.from_dense(codes)
    return Segmentation(labels.astype(np.int32), rows, names, scene.digest, none, CSRRows.empty(0))


def labels_of(preview: Preview) -> np.ndarray:
    return preview.labels[preview.records["label"]]


def test_preview_reads_back_to_half_a_step_and_marks_what_has_no_class() -> None:
    labels = TRUTH.copy()
    labels[:3], labels[3:5] = UNOBSERVED, REMOVED
    preview = make_preview(SCENE, result_of(labels))
    assert RECORD.itemsize == 20 and len(base64.b64decode(preview.as_text())) == 20 * len(preview.records)
    assert preview.left_out == 0 and preview.records["position"].max() == 65535
    kept = slice(0, len(SCENE) - 5)  # the others hang far above
    step = (preview.high - preview.low) / 65535
    means = preview.low + preview.records["position"] * step
    assert (np.abs(means - SCENE.means)[kept] <= 0.51 * step + 1e-6).all()
    np.testing.assert_array_equal(labels_of(preview)[5:], labels[5:])
    assert (labels_of(preview)[:3] == NUM_CLASSES).all() and (labels_of(preview)[3:5] == NUM_CLASSES + 1).all()
    low, high = preview.log_scales
    scales = np.exp(low + preview.records["scale"] / 255 * (high - low))
    np.testing.assert_allclose(scales[kept], SCENE.scales[kept], rtol=0.51 * (high - low) / 255 + 1e-6)
    np.testing.assert_allclose(preview.records["color"] / 255, SCENE.colors(), atol=0.51 / 255)
    np.testing.assert_allclose(preview.records["quat"] / 127, SCENE.quats, atol=0.51 / 127)
    assert (preview.records["confidence"] == 191).all()
    json.dumps(preview.header(), allow_nan=False)


def test_a_preview_tells_what_was_taken_out_of_each_of_as_many_classes_as_masks_can_name() -> None:
    classes = np.array([0, 1, 40_000, 65_534])
    column = np.resize(classes, len(SCENE)).astype(np.uint32)
    shares = CSRRows(np.arange(len(SCENE) + 1), column, np.ones(len(SCENE), np.float32))
    names, none = {k: str(k) for k in range(65_535)}, np.zeros(len(SCENE), bool)
    labels = np.where(np.arange(len(SCENE)) < 4, np.int32(REMOVED), column.astype(np.int32))
    result = Segmentation(labels, shares, names, SCENE.digest, none, CSRRows.empty(0))
    found = labels_of(make_preview(SCENE, result))
    assert found[:4].tolist() == (65_536 + classes).tolist()
    np.testing.assert_array_equal(found[4:], labels[4:])


def test_a_thinned_preview_keeps_small_classes_covers_as_much_and_is_always_the_same() -> None:
    rng = np.random.default_rng(1)
    labels = np.repeat([1, 2, 3], [4900, 60, 40])
    scene = GaussianScene.from_arrays(
        rng.uniform(-1, 1, (5000, 3)), np.tile([1.0, 0, 0, 0], (5000, 1)), np.full((5000, 3), 0.01),
        np.full(5000, 0.9), np.zeros((5000, 1, 3)),
    )  # fmt: skip
    preview, again = (make_preview(scene, result_of(labels, scene), 1000) for _ in range(2))
    np.testing.assert_array_equal(preview.records, again.records)
    assert len(preview.records) == 1000 and preview.left_out == 4000
    assert np.bincount(labels_of(preview)).tolist() == [0, 900, 60, 40]
    low, high = preview.log_scales
    areas = np.exp(2 * (low + preview.records["scale"][:, 0] / 255 * (high - low)))
    np.testing.assert_allclose(np.bincount(labels_of(preview), areas)[1:] / 1e-4, [4900, 60, 40], rtol=0.1)


def test_a_preview_by_part_is_that_of_the_finest_level() -> None:
    rng = np.random.default_rng(0)
    codes = rng.dirichlet(np.ones(NUM_CLASSES), len(SCENE)).astype(np.float32)
    labels = TRUTH.copy()
    labels[::50], labels[1::50] = UNOBSERVED, REMOVED
    result = replace(result_of(labels), shares=CSRRows.from_dense(codes), tree=tree_of_balls()).calibrated(0.6)
    fine = result.at(1.0)
    for most in (500, len(SCENE)):
        found, expected = make_preview(SCENE, result, most, parts=True), make_preview(SCENE, fine, most)
        expected.labels[expected.labels >= fine.num_classes] += len(tree_of_balls()) - fine.num_classes
        np.testing.assert_array_equal(found.labels, expected.labels)
        np.testing.assert_array_equal(found.records, expected.records)


def test_a_preview_by_part_takes_no_memory_for_the_parts_of_all_gaussians() -> None:
    count, classes = 20_000, 200
    scene = GaussianScene.from_arrays(
        np.random.default_rng(0).uniform(-1, 1, (count, 3)), np.tile([1.0, 0, 0, 0], (count, 1)),
        np.full((count, 3), 0.01), np.full(count, 0.9), np.zeros((count, 1, 3)),
    )  # fmt: skip
    labels, halves = np.arange(count, dtype=np.int32) % classes, np.arange(classes, 3 * classes)
    parents = np.concatenate([np.full(classes, -1), (halves - classes) // 2]).astype(np.int32)
    agreement = np.where(parents < 0, 0.7, 1).astype(np.float32)
    leaves = (classes + 2 * labels + np.arange(count) // classes % 2).astype(np.int32)
    codes, none = np.eye(classes, dtype=np.float32)[labels], np.zeros(count, bool)
    names = {k: str(k) for k in range(classes)}
    tree = ObjectTree(parents, agreement, leaves, classes, 0.5)
    rows = CSRRows.from_dense(codes)
    result = Segmentation(labels, rows, names, scene.digest, none, CSRRows.empty(0), 0.6, tree=tree)
    tracemalloc.start()
    preview = make_preview(scene, result, 500, parts=True)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(preview.records) == 500 and peak < codes.nbytes


def test_a_thinned_preview_makes_small_gaussians_larger_and_leaves_large_ones_as_they_are() -> None:
    rng = np.random.default_rng(1)
    scales = np.repeat([0.001, 0.1], [4000, 400])
    scene = GaussianScene.from_arrays(
        rng.uniform(-1, 1, (4400, 3)), np.tile([1.0, 0, 0, 0], (4400, 1)), np.repeat(scales[:, None], 3, axis=1),
        np.full(4400, 0.9), np.zeros((4400, 1, 3)),
    )  # fmt: skip
    preview = make_preview(scene, result_of(np.ones(4400, int), scene), 1000)
    low, high = preview.log_scales
    sizes = np.exp(low + preview.records["scale"][:, 0] / 255 * (high - low))
    assert (sizes > 0.09).sum() == 400 and sizes.max() == pytest.approx(0.1, rel=0.03)
    assert (sizes[sizes < 0.09] ** 2).sum() == pytest.approx(4000 * 0.001**2, rel=0.1)


def test_what_is_far_around_the_scene_is_shown_where_and_as_large_as_from_its_middle() -> None:
    rng = np.random.default_rng(2)
    ball, directions = rng.normal(size=(4000, 3)), rng.normal(size=(40, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    distances = np.geomspace(8, 1e4, 40)
    scene = GaussianScene.from_arrays(
        np.concatenate([ball, directions * distances[:, None]]), np.tile([1.0, 0, 0, 0], (4040, 1)),
        np.repeat(np.concatenate([np.full(4000, 0.01), distances / 20])[:, None], 3, axis=1),
        np.full(4040, 0.9), np.zeros((4040, 1, 3)),
    )  # fmt: skip
    preview = make_preview(scene, result_of(np.ones(4040, int), scene))
    assert preview.left_out == 0
    middle, step = preview.core.mean(axis=0), (preview.high - preview.low) / 65535
    assert (preview.core[0] < -2).all() and (preview.core[1] > 2).all()
    offsets = (preview.low + preview.records["position"] * step - middle)[4000:]
    true_offsets = scene.means[4000:] - middle
    shown, true = (np.linalg.norm(each, axis=1) for each in (offsets, true_offsets))
    np.testing.assert_allclose(offsets / shown[:, None], true_offsets / true[:, None], atol=1e-3)
    low, high = preview.log_scales
    sizes = np.exp(low + preview.records["scale"][4000:, 0] / 255 * (high - low))
    np.testing.assert_allclose(sizes / shown, scene.scales[4000:, 0] / true, rtol=0.05)
    # What was farther stays farther, and the infinite has an end, so that what is near keeps its precision.
    assert (np.diff(shown) > -step.max()).all() and (preview.high - preview.low).max() < 50


def test_one_gaussian_alone_is_shown_as_large_as_it_is() -> None:
    alone = SCENE.subset(np.arange(len(SCENE)) == 0)
    preview = make_preview(alone, result_of(TRUTH[:1], alone))
    low, high = preview.log_scales
    np.testing.assert_allclose(np.exp(low + preview.records["scale"] / 255 * (high - low)), alone.scales, rtol=0.05)


@given(st.integers(1, 40), st.integers(1, 50), st.integers(0, 1000))
def test_no_scene_is_too_small_or_too_flat_for_a_preview(count: int, most: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    means = rng.normal(size=(count, 3)) * rng.choice([0.0, 1e-6, 1e6], 3)
    scene = GaussianScene.from_arrays(
        means, rng.normal(size=(count, 4)), rng.uniform(1e-8, 10, (count, 3)), rng.uniform(0.01, 0.99, count),
        rng.normal(size=(count, 1, 3)) * 5,
    )  # fmt: skip
    preview = make_preview(scene, result_of(rng.integers(-2, NUM_CLASSES, count), scene), most)
    assert len(preview.records) + preview.left_out == count and len(preview.records) <= most
    assert json.loads(json.dumps(preview.header(), allow_nan=False))["count"] == len(preview.records)


def test_a_camera_looks_at_what_it_sees_and_up_is_where_people_hold_it() -> None:
    preview = make_preview(SCENE, result_of(TRUTH))
    (place,) = look_from([look_at("a", np.array([3.0, 0, 3]))], preview)
    np.testing.assert_allclose(place["eye"], [3, 0, 3], atol=1e-6)
    assert np.linalg.norm(place["target"]) < 1.5  # the table lies around the origin
    assert place["fov"] == pytest.approx(2 * np.arctan(24 / 55))
    assert up_of([look_at("a", np.array([3.0, 0, 3])), look_at("b", np.array([-3.0, 0, 3]))])[2] > 0.99
    assert up_of([]) == [0, -1, 0]
