"""The result: what labels mean, and a file that is whole and belongs to one scene."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from parts_of_balls import tree_of_balls
from small_scenes import NAMES, NUM_CLASSES, OUT_OF_SIGHT, balls_on_a_table, clean_views, ring, taught

from gsseg_core.errors import SettingsError, StateFileError, StateMismatchError, WriteError
from gsseg_core.export.class_files import export_classes
from gsseg_core.learn.temperature import tempered
from gsseg_core.learn.vote_learner import VoteLearner
from gsseg_core.live.session import LiveSession
from gsseg_core.objects.oriented_boxes import object_boxes
from gsseg_core.objects.removal import left_without, without_objects
from gsseg_core.raster.backends import make_operator
from gsseg_core.refine.settings import PAPER, UNREFINED, RefineSettings
from gsseg_core.segmentation import REMOVED, UNOBSERVED, Segmentation

SCENE, TRUTH = balls_on_a_table()
CODES = np.eye(NUM_CLASSES, dtype=np.float32)[TRUTH]


@pytest.mark.parametrize("temperature", [0.0, -1.0, float("nan"), float("inf"), 1e-300, 1e300])
def test_a_temperature_that_is_none_is_refused(temperature: float) -> None:
    codes = np.eye(NUM_CLASSES, dtype=np.float32)[TRUTH]
    with pytest.raises(SettingsError, match=r"temperature is .*; expected a number from 0.001 to 1000"):
        Segmentation.from_codes(SCENE, codes, NAMES).calibrated(temperature)
    with pytest.raises(SettingsError, match=r"temperature is .*; expected a number above 0"):
        tempered(codes, temperature)


def test_a_result_calibrated_by_a_number_of_numpy_is_saved_and_loaded(tmp_path: Path) -> None:
    result = Segmentation.from_codes(SCENE, CODES, NAMES).calibrated(np.float32(0.5))
    result.save(tmp_path / "it.npz")
    assert Segmentation.load(tmp_path / "it.npz", SCENE).temperature == 0.5


def test_names_given_anew_by_the_class_ids_of_a_result_are_saved_and_loaded(tmp_path: Path) -> None:
    result = Segmentation.from_codes(SCENE, CODES, NAMES)
    renamed = replace(result, class_names={k: f"thing {k}" for k in result.class_ids})  # keys are NumPy's
    renamed.save(tmp_path / "it.npz")
    assert Segmentation.load(tmp_path / "it.npz", SCENE).class_names == {k: f"thing {k}" for k in NAMES}


@pytest.mark.parametrize("name", ["two\nlines", "\x1b[31mred", "\ud800", " ", "x" * 201, 7, None])
def test_a_name_of_a_class_that_is_not_one_line_of_text_is_refused(name: str) -> None:
    for use in (
        lambda: Segmentation.from_codes(SCENE, CODES, {1: name}), lambda: LiveSession(SCENE, class_names={1: name}),
    ):  # fmt: skip
        with pytest.raises(SettingsError, match=r"class names: id 1 has the name .*; expected ") as caught:
            use()
        assert str(caught.value).isprintable()


def test_labels_are_the_largest_probability_and_minus_one_where_nothing_is_known() -> None:
    codes = CODES.copy()
    codes[[3, 500]] = 0
    result = Segmentation.from_codes(SCENE, codes, NAMES, UNREFINED)
    expected = TRUTH.copy()
    expected[[3, 500]] = UNOBSERVED
    np.testing.assert_array_equal(result.labels, expected)
    assert result.labels.dtype == np.int32 and UNOBSERVED == -1
    np.testing.assert_array_equal(result.confidence, expected >= 0)
    np.testing.assert_array_equal(result.counts(), np.bincount(expected[expected >= 0]))
    assert not result.clustered.any() and result.num_classes == NUM_CLASSES


def test_the_filter_marks_far_gaussians_of_an_object_as_removed_and_keeps_their_probabilities() -> None:
    codes = CODES.copy()
    codes[-1] = np.eye(NUM_CLASSES)[1]
    result = Segmentation.from_codes(SCENE, codes, NAMES, replace(PAPER, cluster=False, k=10))
    assert result.labels[-1] == REMOVED == -2
    assert result.probabilities[-1, 1] == 1
    assert result.counts().sum() == (result.labels >= 0).sum() < len(SCENE)
    assert (result.labels[TRUTH == 0][:-1] >= 0).all()


def test_neighbours_fill_in_what_was_unobserved_and_rows_sum_to_one() -> None:
    codes = CODES.copy()
    codes[TRUTH == 2] *= np.arange(60)[:, None] % 2
    result = Segmentation.from_codes(SCENE, codes, NAMES, RefineSettings(k=5))
    np.testing.assert_array_equal(result.clustered, ~codes.any(axis=1))
    np.testing.assert_allclose(result.probabilities.sum(axis=1), 1, atol=1e-5)
    assert (result.labels[TRUTH == 2] == 2).mean() > 0.8
    np.testing.assert_array_equal(result.learnt.dense(NUM_CLASSES), codes[result.clustered])


def test_what_is_hardly_seen_tells_its_neighbours_little_unless_all_are_to_weigh_the_same() -> None:
    """Of a ball, all that is known, a fifth is seen well; three times as many have a wrong code of 0.01 px."""
    codes, evidence, ball = np.zeros_like(CODES), np.full(len(SCENE), 0.01, np.float32), np.flatnonzero(TRUTH == 2)
    seen, unobserved, hardly = ball[ball % 5 == 0], ball[ball % 5 == 1], ball[ball % 5 > 1]
    codes[seen], codes[hardly], evidence[seen] = np.eye(NUM_CLASSES)[2], np.eye(NUM_CLASSES)[3], 100
    few, paper = RefineSettings(k=40), replace(PAPER, filter=False, k=40)
    by_all = Segmentation.from_codes(SCENE, codes, NAMES, few).labels[unobserved]
    by_evidence = Segmentation.from_codes(SCENE, codes, NAMES, few, evidence).labels[unobserved]
    as_in_the_paper = Segmentation.from_codes(SCENE, codes, NAMES, paper, evidence)
    assert (by_all == 3).mean() > 0.8 and (by_evidence == 2).mean() > 0.9
    np.testing.assert_array_equal(as_in_the_paper.labels[unobserved], by_all)


def test_a_code_that_nothing_was_seen_of_counts_where_there_is_no_better_one() -> None:
    codes = CODES.copy()
    codes[::2] = 0
    without = Segmentation.from_codes(SCENE, codes, NAMES, evidence=np.zeros(len(SCENE), np.float32))
    np.testing.assert_array_equal(without.labels, Segmentation.from_codes(SCENE, codes, NAMES).labels)


def test_nothing_observed_at_all_is_all_unobserved() -> None:
    result = Segmentation.from_codes(SCENE, np.zeros_like(CODES), NAMES)
    assert (result.labels == UNOBSERVED).all() and not result.counts().any() and not result.confidence.any()
    assert result.render(make_operator(SCENE, ring(1)[0])).labels.shape == (48, 64)


def test_classes_without_a_name_get_one() -> None:
    assert Segmentation.from_codes(SCENE, CODES, {1: "cup"}, UNREFINED).class_names == {
        0: "class_00", 1: "cup", 2: "class_02", 3: "class_03",
    }  # fmt: skip


def test_label_maps_of_true_codes_are_the_true_masks() -> None:
    result = Segmentation.from_codes(SCENE, CODES, NAMES, UNREFINED)
    for view in clean_views(2):
        labels = result.render(make_operator(SCENE, view.camera)).labels
        assert labels.dtype == np.int32
        np.testing.assert_array_equal(labels, view.read_labels())


def refined() -> Segmentation:
    learner = taught(VoteLearner(SCENE, NUM_CLASSES), clean_views(3)).fit()
    return Segmentation.from_codes(SCENE, learner.codes_, NAMES)


def test_a_saved_segmentation_comes_back_exactly(tmp_path: Path) -> None:
    result = refined()
    assert result.clustered.sum() > OUT_OF_SIGHT
    result.save(tmp_path / "segmentation.npz")
    again = Segmentation.load(tmp_path / "segmentation.npz", SCENE)
    arrays = [(getattr(result, name), getattr(again, name)) for name in ("labels", "probabilities", "confidence")]
    for one, two in [*arrays, (result.clustered, again.clustered), *zip(result.learnt, again.learnt, strict=True)]:
        assert one.dtype == two.dtype
        np.testing.assert_array_equal(one, two)
    assert again.class_names == NAMES and again.scene_digest == SCENE.digest
    operator = make_operator(SCENE, ring(1)[0])
    np.testing.assert_array_equal(again.render(operator).labels, result.render(operator).labels)


def test_a_segmentation_of_another_scene_is_refused(tmp_path: Path) -> None:
    refined().save(tmp_path / "segmentation.npz")
    with pytest.raises(StateMismatchError, match=r"segmentation\.npz: belongs to the scene .* expected"):
        Segmentation.load(tmp_path / "segmentation.npz", balls_on_a_table(seed=1)[0])


def test_a_segmentation_is_neither_made_nor_used_with_another_scene(tmp_path: Path) -> None:
    other, view, result = balls_on_a_table(seed=1)[0], clean_views(1)[0], refined()
    assert len(other) == len(SCENE)  # So that no index tells.
    for use in (
        lambda: export_classes(other, result, tmp_path / "classes"),
        lambda: object_boxes(other, result),
        lambda: without_objects(other, result, [1]),
        lambda: result.carved(other, [view.camera]),
        lambda: result.carved_by(other, [view], lambda _: None),
        lambda: result.filtered(other, PAPER),
        lambda: result.render(make_operator(other, view.camera)),
        lambda: result.label_map(make_operator(other, view.camera).without(np.zeros(len(other), bool))),
    ):
        with pytest.raises(StateMismatchError, match=r"segmentation: belongs to the scene .* expected"):
            use()
    assert not (tmp_path / "classes").exists()
    for codes in (CODES[:-1], CODES[:, 0]):
        with pytest.raises(StateMismatchError, match=rf"codes are \(\d+,.*\), .*; expected \({len(SCENE)}, K\)"):
            Segmentation.from_codes(SCENE, codes, NAMES)
    with pytest.raises(StateMismatchError, match=rf"evidence \(7,\); expected .* \({len(SCENE)},\)"):
        Segmentation.from_codes(SCENE, CODES, NAMES, evidence=np.ones(7, np.float32))


@pytest.mark.parametrize("value", [np.nan, np.inf, -0.5, 3.0])
def test_codes_that_are_no_probabilities_are_refused_and_not_taken_for_unobserved(value: float) -> None:
    codes = CODES.copy()
    codes[7, 1] = value
    with pytest.raises(SettingsError, match=r"array codes .* in row 7 \(1 of .* rows are unusable\); expected"):
        Segmentation.from_codes(SCENE, codes, NAMES)


@pytest.mark.parametrize("value", [np.nan, np.inf, -0.5, -3.0, -4.0])
def test_evidence_that_is_no_number_of_pixels_is_refused_and_codes_stay_as_they_are(value: float) -> None:
    codes, evidence = CODES.copy(), np.ones(len(SCENE), np.float32)
    evidence[7] = value
    with pytest.raises(SettingsError, match=r"array evidence holds .* in row 7 \(1 of .* unusable\); expected"):
        Segmentation.from_codes(SCENE, codes, NAMES, evidence=evidence)
    np.testing.assert_array_equal(codes, CODES)
    codes.setflags(write=False)
    Segmentation.from_codes(SCENE, codes, NAMES)
    np.testing.assert_array_equal(codes, CODES)
    listed = Segmentation.from_codes(SCENE, CODES, NAMES, evidence=[1.0] * len(SCENE))
    np.testing.assert_array_equal(listed.labels, Segmentation.from_codes(SCENE, CODES, NAMES).labels)


def test_a_missing_truncated_or_foreign_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "segmentation.npz"
    for impossible in ("x" * 300, "nul\0"):
        with pytest.raises(StateFileError, match="is not a segmentation"):
            Segmentation.load(impossible, SCENE)
    with pytest.raises(StateFileError, match="does not exist"):
        Segmentation.load(path, SCENE)
    refined().save(path)
    content = path.read_bytes()
    damaged = bytearray(content)
    damaged[len(content) // 2] ^= 0xFF
    for broken in (b"", b"text", content[:50], content[: len(content) // 2], content[:-9], bytes(damaged)):
        path.write_bytes(broken)
        with pytest.raises(StateFileError, match=r"segmentation\.npz: is not a segmentation\.npz, or is damaged"):
            Segmentation.load(path, SCENE)
    np.savez(path, labels=np.zeros(3))
    with pytest.raises(StateFileError):
        Segmentation.load(path, SCENE)


def test_a_failed_save_leaves_the_earlier_file_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "segmentation.npz"
    refined().save(path)
    before = path.read_bytes()

    def disk_full(file: object, *arguments: object, **settings: object) -> None:
        file.write(b"half of ")  # type: ignore[attr-defined]
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr(np.lib.format, "write_array", disk_full)
    with pytest.raises(WriteError, match="No space left"):
        refined().save(path)
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


def with_parts() -> Segmentation:
    """Class 1 has two parts, 4 and 5; 2 and 3 make a whole, 6."""
    return replace(Segmentation.from_codes(SCENE, CODES, NAMES, UNREFINED), tree=tree_of_balls())


def test_a_result_in_the_order_of_another_scene_says_the_same_of_each_gaussian() -> None:
    codes = CODES.copy()
    codes[::7] = 0
    result = Segmentation.from_codes(SCENE, codes, NAMES)
    tree = replace(tree_of_balls(), leaves=np.where(result.labels >= 0, result.labels, -1).astype(np.int32))
    result = replace(result, tree=tree)
    places = np.random.default_rng(0).permutation(len(SCENE))
    other = SCENE.subset(places)
    moved = result.in_order_of(other.digest, places)
    assert result.clustered.any() and moved.scene_digest == other.digest
    for name in ("labels", "probabilities", "clustered", "confidence"):
        np.testing.assert_array_equal(getattr(moved, name), getattr(result, name)[places])
    operators = [make_operator(scene, clean_views()[0].camera) for scene in (SCENE, other)]
    np.testing.assert_array_equal(result.blend(operators[0]), moved.blend(operators[1]))
    assert moved.tree is not None
    np.testing.assert_array_equal(moved.tree.leaves, tree.leaves[places])
    back = moved.in_order_of(SCENE.digest, np.argsort(places))
    np.testing.assert_array_equal(back.learnt.dense(NUM_CLASSES), result.learnt.dense(NUM_CLASSES))


def test_levels_are_segmentations_whose_classes_are_the_nodes_there() -> None:
    objects = with_parts()
    assert objects.at(None) is objects
    same, fine, coarse = objects.at(0.5), objects.at(0.9), objects.at(0.2)
    np.testing.assert_array_equal(same.labels, objects.labels)
    assert same.class_names == objects.class_names
    assert list(fine.class_names.values()) == ["background", NAMES[2], NAMES[3], f"{NAMES[1]}.1", f"{NAMES[1]}.2"]
    assert list(coarse.class_names) == [0, 1, 6] and coarse.class_names[6] == "whole_001"
    for level in (same, fine, coarse):
        np.testing.assert_array_equal(level.class_ids[level.probabilities.argmax(axis=1)], level.labels)
        seen = level.render(make_operator(SCENE, ring(1)[0])).labels
        assert set(np.unique(seen).tolist()) <= set(level.class_names)
    assert (objects.counts()[2] + objects.counts()[3]) == coarse.counts()[6]


def test_a_level_is_the_same_before_and_after_calibration_and_its_label_maps_do_not_depend_on_it() -> None:
    codes = np.random.default_rng(0).dirichlet(np.full(NUM_CLASSES, 0.7), len(SCENE)).astype(np.float32)
    objects = replace(Segmentation.from_codes(SCENE, codes, NAMES), tree=tree_of_balls())
    operator = make_operator(SCENE, ring(1)[0])
    for granularity in (0.2, 0.5, 0.9):
        level, calibrated = objects.at(granularity), objects.calibrated(2.5).at(granularity)
        np.testing.assert_allclose(calibrated.blend(operator), level.blend(operator), atol=1e-5)
        np.testing.assert_allclose(calibrated.probabilities, level.calibrated(2.5).probabilities, atol=1e-5)
        assert calibrated.temperature == 2.5


@pytest.mark.parametrize(
    "ids",
    [
        [0, 5, 9],
        [0, 5, 5, 9],
        [5, 0, 7, 9],
        [0, 1, 2, 65535],
        [0, 1, 2, 2**40],
        [0, 1, 2, 3.5],
        [0, -1, 7, 9],
        [1, 5, 7, 9],
    ],
)
def test_ids_that_are_not_one_for_each_class_with_0_the_background_are_refused(ids: list[int]) -> None:
    result = Segmentation.from_codes(SCENE, CODES, NAMES)
    with pytest.raises(SettingsError, match=r"ids are .*; expected 4 different ones, 0 first"):
        result.with_ids(ids)


def test_names_of_classes_that_codes_do_not_have_are_refused() -> None:
    for names in ({NUM_CLASSES: "chair"}, {-1: "chair"}, {"1": "chair"}):
        with pytest.raises(
            SettingsError, match=rf"class names have ids .*; expected some of range\(0, {NUM_CLASSES}\)"
        ):
            Segmentation.from_codes(SCENE, CODES, names)


def test_classes_with_ids_of_their_own_or_a_tree_get_no_other_ids() -> None:
    result = Segmentation.from_codes(SCENE, CODES, NAMES).with_ids([0, 9, 5, 7])
    assert result.class_names == {0: NAMES[0], 5: NAMES[2], 7: NAMES[3], 9: NAMES[1]}
    np.testing.assert_array_equal(result.class_ids[result.probabilities.argmax(axis=1)], result.labels)
    for taken in (result, with_parts()):
        with pytest.raises(SettingsError, match="neither gaps nor a tree"):
            taken.with_ids([0, 9, 5, 7])


def test_parts_and_wholes_can_be_asked_for_and_removed_by_name() -> None:
    objects = with_parts()
    assert objects.node_names == {**NAMES, 4: f"{NAMES[1]}.1", 5: f"{NAMES[1]}.2", 6: "whole_001"}
    np.testing.assert_array_equal(objects.members(4) | objects.members(5), TRUTH == 1)
    np.testing.assert_array_equal(objects.members(6), np.isin(TRUTH, [2, 3]))
    np.testing.assert_array_equal(left_without(SCENE, objects, [4, 6]), ~(objects.members(4) | (TRUTH >= 2)))
    with pytest.raises(SettingsError, match="asked to remove class 9, which has no Gaussians"):
        left_without(SCENE, objects, [9])


def test_levels_need_a_tree() -> None:
    with pytest.raises(SettingsError, match="no tree"):
        replace(with_parts(), tree=None).at(0.5)
    with pytest.raises(SettingsError, match="granularity"):
        with_parts().at(1.5)


def test_the_tree_is_saved_with_the_segmentation(tmp_path: Path) -> None:
    objects = with_parts()
    objects.save(tmp_path / "s.npz")
    loaded = Segmentation.load(tmp_path / "s.npz", SCENE).tree
    assert loaded is not None and objects.tree is not None and loaded.level == 0.5
    for name in ("parents", "agreement", "leaves"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(objects.tree, name))


@pytest.mark.parametrize(
    ("array", "value", "message"),
    [
        ("parents", np.array([-1, 4, -1, -1, 1, 1, -1], np.int32), "circle"),
        ("agreement", np.ones(3, np.float32), "tree_agreement"),
        ("leaves", np.full(len(TRUTH), 9, np.int32), "leaves"),
        ("leaves", np.zeros(3, np.int32), "tree_leaves"),
    ],
)
def test_a_damaged_tree_is_told(tmp_path: Path, array: str, value: np.ndarray, message: str) -> None:
    objects = with_parts()
    object.__setattr__(objects.tree, array, value)
    objects.save(tmp_path / "s.npz")
    with pytest.raises(StateFileError, match=message):
        Segmentation.load(tmp_path / "s.npz", SCENE)
