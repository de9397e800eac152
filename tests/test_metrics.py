"""Metrics: the same figures as scikit-learn's, and boundary IoU as its definition reads."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from gsseg_core.data.label_images import UNKNOWN, write_mask
from gsseg_core.errors import MaskFormatError, MaskSizeError, NoUsableViewsError
from gsseg_core.metrics import BOUNDARY_SHARE, Evaluation, evaluate_folders
from gsseg_core.scene.camera import Camera


def test_large_labels_are_paired_as_they_are() -> None:
    evaluation, labels = Evaluation(), np.full((4, 4), 60000, np.int32)
    evaluation.add(labels, labels)  # 60000^2 is no int32, which NumPy 1 would make of it.
    assert evaluation._pairs == {(60000, 60000): 16}


def test_ids_that_differ_from_the_true_ones_are_found_where_most_do() -> None:
    truth = np.repeat([0, 1, 2, 3], 10).reshape(4, 10)
    for found, others in (
        ((0, 3, 1, 2), {1: 3, 2: 1, 3: 2}),
        ((0, 3, 2, 1), {1: 3, 3: 1}),
        ((0, 1, 3, 2), {2: 3, 3: 2}),
    ):
        evaluation = Evaluation()
        evaluation.add(truth, np.array(found)[truth])
        assert evaluation.other_ids == others
    for found in ((0, 1, 2, 3), (0, 1, 2, 2), (0, 0, 0, 0), (2, 0, 2, 3)):  # Right, one swallowed, nothing found.
        evaluation = Evaluation()
        evaluation.add(truth, np.array(found)[truth])
        assert evaluation.other_ids == {}


def make_views(seed: int, num_views: int = 3, num_classes: int = 7) -> list[tuple[np.ndarray, np.ndarray]]:
    """Patchy label maps of several sizes; the prediction is the truth, moved, with some pixels wrong."""
    rng = np.random.default_rng(seed)
    views = []
    for _ in range(num_views):
        height, width = rng.integers(60, 110, 2)
        patches = rng.integers(0, num_classes, (height // 12 + 1, width // 12 + 1))
        truth = np.kron(patches, np.ones((12, 12), int))[:height, :width]
        prediction = np.roll(truth, rng.integers(-3, 4, 2), axis=(0, 1))
        wrong = rng.random(truth.shape) < 0.02
        prediction = np.where(wrong, rng.integers(0, num_classes, truth.shape), prediction)
        views.append((truth, prediction))
    return views


def evaluate(views: list[tuple[np.ndarray, np.ndarray]]) -> Evaluation:
    evaluation = Evaluation()
    for truth, prediction in views:
        evaluation.add(truth, prediction)
    return evaluation


def slow_boundary_iou(views: list[tuple[np.ndarray, np.ndarray]], label: int) -> float:
    """The definition: a class's mask without its erosion, per view; the ratio over all views."""

    def band(mask: np.ndarray, width: int) -> np.ndarray:
        return mask & ~ndimage.binary_erosion(mask, np.ones((3, 3)), iterations=width, border_value=0)

    both = either = 0
    for truth, prediction in views:
        width = max(1, round(BOUNDARY_SHARE * float(np.hypot(*truth.shape))))
        a, b = band(truth == label, width), band(prediction == label, width)
        both += np.sum(a & b)
        either += np.sum(a | b)
    return both / either


@pytest.mark.parametrize("seed", range(5))
def test_figures_are_those_of_scikit_learn(seed: int) -> None:
    from sklearn import metrics  # Here, since it takes long, and all workers collect all tests.

    views = make_views(seed)
    rng = np.random.default_rng(seed + 100)
    for truth, _ in views:
        truth[rng.random(truth.shape) < 0.1] = UNKNOWN
    evaluation = evaluate(views)

    truth = np.concatenate([t[t != UNKNOWN] for t, _ in views])
    prediction = np.concatenate([p[t != UNKNOWN] for t, p in views])
    labels = np.arange(evaluation.num_classes)
    iou = metrics.jaccard_score(truth, prediction, labels=labels, average=None)
    accuracy = metrics.recall_score(truth, prediction, labels=labels, average=None)
    np.testing.assert_array_equal(evaluation.confusion, metrics.confusion_matrix(truth, prediction, labels=labels))
    np.testing.assert_allclose(evaluation.iou, iou)
    np.testing.assert_allclose(evaluation.accuracy, accuracy)
    assert evaluation.mean_iou == pytest.approx(metrics.jaccard_score(truth, prediction, average="macro"))
    assert evaluation.mean_accuracy == pytest.approx(accuracy.mean())


@pytest.mark.parametrize("seed", range(5))
def test_boundary_iou_is_that_of_its_definition(seed: int) -> None:
    views = make_views(seed)
    evaluation = evaluate(views)
    expected = [slow_boundary_iou(views, k) for k in range(evaluation.num_classes)]
    np.testing.assert_allclose(evaluation.boundary_iou, expected)
    assert evaluation.mean_boundary_iou == pytest.approx(np.mean(expected))


def test_classes_that_do_not_occur_count_nowhere() -> None:
    evaluation = Evaluation()
    evaluation.add(np.array([[0, 0, 5, 5]]), np.array([[0, 7, 5, 5]]))
    assert evaluation.num_classes == 8
    assert np.flatnonzero(~np.isnan(evaluation.iou)).tolist() == [0, 5, 7]
    assert evaluation.mean_iou == pytest.approx((0.5 + 1 + 0) / 3)
    assert evaluation.mean_accuracy == pytest.approx((0.5 + 1) / 2)


def test_what_is_predicted_where_the_truth_is_unknown_never_counts() -> None:
    truth = np.ones((60, 80), int)
    truth[20:40, 30:50] = UNKNOWN
    for guess in (0, 1, 2, UNKNOWN):
        prediction = np.where(truth == UNKNOWN, guess, truth)
        evaluation = evaluate([(truth, prediction)])
        assert evaluation.confusion.sum() == np.sum(truth == 1)
        assert evaluation.mean_iou == evaluation.mean_boundary_iou == 1


def test_what_is_no_label_is_refused_and_not_counted_as_another_one() -> None:
    labels = np.ones((6, 8), np.int64)
    for wrong in (labels + 0.5, labels - 3, labels + 2**32, labels.astype(np.uint64) + 2**63, labels.astype(str)):
        for pair in ((labels, wrong), (wrong, labels)):
            with pytest.raises(MaskFormatError, match=r"view: found .*; expected integers -1 to 65534"):
                evaluate([pair])
    with pytest.raises(MaskFormatError, match="view: found int64 -2 to 70000; expected"):
        evaluate([(labels, np.linspace(-2, 70000, 48).astype(np.int64).reshape(6, 8))])


def test_an_unknown_prediction_is_a_miss_and_no_find() -> None:
    evaluation = evaluate([(np.array([[1, 1, 2, 2]]), np.array([[1, UNKNOWN, 2, 2]]))])
    assert evaluation.iou[1:].tolist() == [0.5, 1]
    assert evaluation.accuracy[1:].tolist() == [0.5, 1]


def test_labels_of_sixteen_bits_and_of_unsigned_arrays_work() -> None:
    evaluation = evaluate([(np.array([[0, 65534]], np.uint16), np.array([[0, 65534]], np.uint16))])
    assert evaluation.mean_iou == evaluation.mean_boundary_iou == 1
    evaluation.add(np.array([[3, 3]], np.uint8), np.array([[3, 4]], np.uint8))
    assert evaluation.iou[3] == 0.5


def test_no_view_gives_no_figure_and_valid_json() -> None:
    figures = Evaluation().as_dict()
    assert figures == {
        "views": 0, "mean_iou": None, "mean_accuracy": None, "mean_boundary_iou": None, "classes": [],
    }  # fmt: skip
    json.dumps(figures, allow_nan=False)


def test_the_figures_of_a_class_carry_its_name() -> None:
    figures = evaluate([(np.array([[0, 1]]), np.array([[0, 2]]))]).as_dict({1: "mug"})
    assert [(row["id"], row["name"], row["pixels"]) for row in figures["classes"]] == [
        (0, "class_00", 1), (1, "mug", 1), (2, "class_02", 0),
    ]  # fmt: skip
    assert figures["classes"][2]["accuracy"] is None
    json.dumps(figures, allow_nan=False)


def test_label_maps_of_different_sizes_are_refused() -> None:
    with pytest.raises(MaskSizeError, match=r"view 7: .*\(2, 3\).*\(3, 2\)"):
        Evaluation().add(np.zeros((3, 2), int), np.zeros((2, 3), int), name="view 7")


def test_folders_are_paired_by_name_and_more_truth_is_ignored(tmp_path: Path) -> None:
    views = make_views(0)
    for i, (truth, prediction) in enumerate(views):
        write_mask(tmp_path / "truth" / f"{i}.png", truth, bits=8)
        if i:
            write_mask(tmp_path / "pred" / f"{i}.png", prediction, bits=16)
    evaluation = evaluate_folders(tmp_path / "pred", tmp_path / "truth")
    assert evaluation.num_views == 2
    np.testing.assert_array_equal(evaluation.confusion, evaluate(views[1:]).confusion)


@pytest.mark.parametrize("name", ["a.png", "a.JPG.png", "a_mask.png", "left/a.png"])
def test_truth_is_found_and_scaled_as_masks_to_learn_from_are(tmp_path: Path, name: str) -> None:
    labels = np.arange(24).reshape(4, 6)
    write_mask(tmp_path / "pred/a.png", labels, bits=8)
    (tmp_path / "truth" / name).parent.mkdir(parents=True)
    write_mask(tmp_path / "truth" / name, labels.repeat(2, 0).repeat(2, 1), bits=8)
    camera = Camera("a", 6, 4, np.array([[5.0, 0, 3], [0, 5, 2], [0, 0, 1]]), np.eye(4))
    found = evaluate_folders(tmp_path / "pred", tmp_path / "truth", [camera])
    np.testing.assert_array_equal(found.confusion, np.eye(24))


def test_a_prediction_of_the_size_of_its_truth_is_scored_as_it_is_whatever_the_size_of_the_camera(
    tmp_path: Path,
) -> None:
    labels = np.arange(24).reshape(4, 6)
    for folder in ("pred", "truth"):
        write_mask(tmp_path / folder / "a.png", labels, bits=8)
    camera = Camera("a", 12, 8, np.array([[9.0, 0, 6], [0, 9, 4], [0, 0, 1]]), np.eye(4))
    found = evaluate_folders(tmp_path / "pred", tmp_path / "truth", [camera])
    np.testing.assert_array_equal(found.confusion, np.eye(24))


def test_folders_that_cannot_be_compared_are_refused_with_one_clear_error(tmp_path: Path) -> None:
    pred, truth = tmp_path / "pred", tmp_path / "truth"
    with pytest.raises(NoUsableViewsError, match="pred: found no predictions"):
        evaluate_folders(pred, truth)
    with pytest.raises(NoUsableViewsError, match=r"ppp: cannot be read \(File name too long"):
        evaluate_folders(tmp_path / ("p" * 300), truth)
    write_mask(pred / "a.png", np.zeros((2, 2), int), bits=8)
    with pytest.raises(MaskFormatError, match=r"truth: found no a\.png \(1 of 1 are missing\)"):
        evaluate_folders(pred, truth)
    write_mask(truth / "a.png", np.zeros((2, 3), int), bits=8)
    with pytest.raises(MaskSizeError, match=r"a\.png"):
        evaluate_folders(pred, truth)
