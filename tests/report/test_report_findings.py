"""Figures and warnings of the report page are those of the masks."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from report_cases import minimal_report

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.learn.mask_reliability import ViewCheck, ranked_examples
from gsseg_core.report.findings import Confusion, MaskChecks, warnings_of


def check(name: str, classes: list[int], counts: list[list[int]]) -> ViewCheck:
    pixels = np.array(counts, np.int64)
    return ViewCheck(name, int(pixels.sum()), np.array(classes, np.int32), CSRRows.from_dense(pixels))


def written_out(confusion: Confusion) -> tuple[list[int], np.ndarray]:
    """The classes that occur, and pixels by class predicted (row) and label of the mask (column)."""
    classes = np.union1d(confusion.predicted, confusion.labels)
    table = np.zeros((len(classes), len(classes)), np.int64)
    table[np.searchsorted(classes, confusion.predicted), np.searchsorted(classes, confusion.labels)] = confusion.pixels
    return classes.tolist(), table


def test_confusion_is_the_sum_over_views_and_ignores_what_is_no_class() -> None:
    one = check("one", [0, 2], [[50, 3], [10, 0], [7, 30]])
    other = check("other", [1, UNKNOWN], [[4, 1], [5, 1], [0, 1]])
    confusion = MaskChecks([one, other], {}, True).confusion()
    classes, table = written_out(confusion)
    assert classes == [0, 1, 2]
    np.testing.assert_array_equal(table, [[50, 4, 3], [10, 5, 0], [7, 0, 30]])
    np.testing.assert_allclose(confusion.ious(3), [50 / 74, 5 / 19, 30 / 40])
    assert confusion.largest(3) == [(1, 0, 10), (2, 0, 7), (0, 1, 4)]
    assert confusion.most_confused(2).tolist() == [0, 1]
    np.testing.assert_allclose(confusion.shares(np.array([0, 2])), [[50 / 57, 3 / 57], [7 / 37, 30 / 37]])


def test_confusion_is_of_the_classes_that_occur_however_many_names_there_are() -> None:
    pixels = np.zeros((65_535, 2), np.int64)
    pixels[[7, 7, 60_000], [0, 1, 1]] = 5, 2, 9
    one = ViewCheck("one", 16, np.array([3, 60_000]), CSRRows.from_dense(pixels))
    confusion = MaskChecks([one], {}, True).confusion()
    classes, table = written_out(confusion)
    assert classes == [3, 7, 60_000]
    np.testing.assert_array_equal(table, [[0, 0, 0], [5, 0, 2], [0, 0, 9]])
    blank = MaskChecks([check("blank", [0], [[0]])], {}, True).confusion()
    assert [column.tolist() for column in blank] == [[], [], []]
    assert blank.largest(3) == blank.shares(blank.most_confused(3)).tolist() == [] and np.isnan(blank.ious(1)).all()


def test_confusion_of_thousands_of_classes_takes_memory_by_those_that_are_confused() -> None:
    classes = np.arange(many := 20_000)
    tracemalloc.start()
    try:
        confusion = Confusion(np.append(classes, 7), np.append(classes, 9), np.full(many + 1, 5))
        assert confusion.largest(2) == [(7, 9, 5)] and confusion.most_confused(2).tolist() == [7, 9]
        assert confusion.shares(np.array([7, 9])).tolist() == [[0.5, 0.5], [0, 1]]
        assert confusion.ious(many)[[0, 7, 9]].tolist() == [1, 0.5, 0.5]
        assert tracemalloc.get_traced_memory()[1] < many**2
    finally:
        tracemalloc.stop()


def test_iou_of_a_class_that_is_nowhere_is_not_a_number() -> None:
    confusion = Confusion(np.array([0, 2]), np.array([0, 2]), np.array([3, 2]))
    ious = confusion.ious(3)
    assert ious[0] == ious[2] == 1 and np.isnan(ious[1])
    assert confusion.most_confused(5).tolist() == [0, 2]


def test_a_view_shows_what_fills_more_than_a_few_of_its_pixels() -> None:
    checks = [check("a", [0], [[9_998], [2], [0]]), check("b", [0], [[9_000], [1_000], [0]])]
    assert MaskChecks(checks, {}, True).views_showing(3).tolist() == [2, 1, 0]


def test_examples_are_the_worst_the_median_and_the_best_view() -> None:
    checks = [check(f"v{right}", [0, 1], [[right, 100 - right], [0, 0]]) for right in (70, 95, 20, 80, 99)]
    blank = check("blank", [0], [[0], [0]])
    chosen = [(what, entry.name) for what, entry in ranked_examples([*checks, blank])]
    assert chosen == [("worst", "v20"), ("median", "v80"), ("best", "v99")]
    assert len(ranked_examples(checks[:2])) == 2
    assert ranked_examples([blank]) == ranked_examples([]) == []


def test_a_run_without_fault_gets_no_warning() -> None:
    assert warnings_of(minimal_report(), np.array([np.nan, 0.9])) == []


CUP = {"id": 1, "name": "cup", "gaussians": 0}
BOX = {"id": 2, "name": "box", "gaussians": 9}
DOUBTFUL = [{"name": "v7", "reliability": 0.5}, {"name": "v8", "reliability": None}]


@pytest.mark.parametrize(
    ("changes", "iou", "said"),
    [
        ({"views": {"used": 2, "rejected": {}}}, 0.9, "from 2 views only"),
        (
            {"views": {"used": 9, "rejected": {"no mask": 2, "too far": 1}}},
            0.9,
            "3 views could not be used: 2 no mask, 1 too far",
        ),
        (
            {"views": {"used": 9, "rejected": {}, "reliability": DOUBTFUL}},
            0.9,
            "1 of 2 masks disagrees with the other views in more than 30 % of its pixels: v7",
        ),
        ({"classes": [CUP, BOX]}, 0.9, "1 class got no Gaussian: cup"),
        (
            {"classes": [CUP, BOX], "ids": {"objects": 2}},
            0.9,
            "1 of 2 objects that were found got no Gaussian, since other views give what their masks show to other "
            "objects: cup",
        ),
        ({"classes": []}, 0.9, "No Gaussian is part of an object"),
        ({}, 0.3, "overlap by less than half (IoU below 0.5): cup"),
        ({"gaussians": {"unobserved": 40}}, 0.9, "40 % of the Gaussians are covered by no mask"),
    ],
)
def test_each_fault_gets_its_warning(changes: dict[str, object], iou: float, said: str) -> None:
    (warning,) = warnings_of(minimal_report(**changes), np.array([np.nan, iou]))
    assert said in warning


def test_of_a_class_without_gaussians_it_is_not_said_again_that_masks_do_not_overlap_it() -> None:
    background = {"id": 0, "name": "background", "gaussians": 0}
    warnings = warnings_of(minimal_report(classes=[background, CUP, BOX]), np.array([0, 0, 0.3]))
    assert "1 class got no Gaussian: cup." in warnings and len(warnings) == 2
    assert warnings[1].endswith("(IoU below 0.5): background, box.")


def test_many_names_are_cut_short() -> None:
    views = [{"name": f"v{i}", "reliability": 0.1} for i in range(9)]
    (warning,) = warnings_of(minimal_report(views={"used": 9, "rejected": {}, "reliability": views}), None)
    assert "v0, v1, v2, v3, v4 and 4 more" in warning
