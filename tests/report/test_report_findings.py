"""Figures and warnings of the report page are those of the masks."""

from __future__ import annotations

import numpy as np
import pytest
from report_cases import minimal_report

from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.learn.mask_reliability import ViewCheck, ranked_examples
from gsseg_core.report.findings import (
    MaskChecks,
    class_ious,
    largest_confusions,
    most_confused,
    warnings_of,
)


def check(name: str, classes: list[int], counts: list[list[int]]) -> ViewCheck:
    pixels = np.array(counts, np.int64)
    return ViewCheck(name, int(pixels.sum()), np.array(classes, np.int32), pixels)


def test_confusion_is_the_sum_over_views_and_ignores_what_is_no_class() -> None:
    one = check("one", [0, 2], [[50, 3], [10, 0], [7, 30]])
    other = check("other", [1, UNKNOWN], [[4, 1], [5, 1], [0, 1]])
    classes, confusion = MaskChecks([one, other], {}, True).confusion()
    assert classes.tolist() == [0, 1, 2]
    np.testing.assert_array_equal(confusion, [[50, 4, 3], [10, 5, 0], [7, 0, 30]])
    np.testing.assert_allclose(class_ious(confusion), [50 / 74, 5 / 19, 30 / 40])
    assert largest_confusions(confusion, 3) == [(1, 0, 10), (2, 0, 7), (0, 1, 4)]
    assert most_confused(confusion, 2) == [0, 1]


def test_confusion_is_of_the_classes_that_occur_however_many_names_there_are() -> None:
    pixels = np.zeros((65_535, 2), np.int64)
    pixels[[7, 7, 60_000], [0, 1, 1]] = 5, 2, 9
    classes, confusion = MaskChecks([ViewCheck("one", 16, np.array([3, 60_000]), pixels)], {}, True).confusion()
    assert classes.tolist() == [3, 7, 60_000]
    np.testing.assert_array_equal(confusion, [[0, 0, 0], [5, 0, 2], [0, 0, 9]])
    assert [check.tolist() for check in MaskChecks([check("blank", [0], [[0]])], {}, True).confusion()] == [[], []]


def test_iou_of_a_class_that_is_nowhere_is_not_a_number() -> None:
    ious = class_ious(np.diag([3, 0, 2]))
    assert ious[0] == ious[2] == 1 and np.isnan(ious[1])
    assert most_confused(np.diag([3, 0, 2]), 5) == [0, 2]


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
            "1 of 2 objects that were found got no Gaussian, as other views give what their masks show to others: cup",
        ),
        ({"classes": []}, 0.9, "No Gaussian is part of an object"),
        ({}, 0.3, "overlap by less than half (IoU below 0.5): cup"),
        ({"gaussians": {"unobserved": 40}}, 0.9, "40 % of the Gaussians were seen by no mask"),
    ],
)
def test_each_fault_gets_its_warning(changes: dict[str, object], iou: float, said: str) -> None:
    (warning,) = warnings_of(minimal_report(**changes), np.array([np.nan, iou]))
    assert said in warning


def test_many_names_are_cut_short() -> None:
    views = [{"name": f"v{i}", "reliability": 0.1} for i in range(9)]
    (warning,) = warnings_of(minimal_report(views={"used": 9, "rejected": {}, "reliability": views}), None)
    assert "v0, v1, v2, v3, v4 and 4 more" in warning
