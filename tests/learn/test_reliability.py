"""How far views can be trusted: bad frames come first, shares are close to the truth, and reports say what is wrong."""

from __future__ import annotations

import json
import math
import tracemalloc
from functools import cache

import numpy as np
import pytest
from small_scenes import HEIGHT, NAMES, NUM_CLASSES, WIDTH, balls_on_a_table, clean_views, ring, taught, wrong_views
from view_errors import corrupt_views
from wrong_masks import WrongMasks

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.data.view import View
from gsseg_core.errors import MaskFormatError
from gsseg_core.export.view_pictures import draw_worst_views
from gsseg_core.learn import mask_reliability
from gsseg_core.learn.em.em_learner import EMLearner
from gsseg_core.learn.mask_reliability import MaskChecker, ViewCheck, compare_mask, reliability_report, worst_views
from gsseg_core.learn.temperature import grid_of
from gsseg_core.report.pictures import ViewImages
from gsseg_core.text import percent

SCENE, _ = balls_on_a_table()
CLEAN = clean_views(12)
BAD = {"view3", "view7"}


@cache
def learner_with_bad_frames() -> EMLearner:
    spoilt = corrupt_views(CLEAN, 0, WrongMasks(missed=0, swapped=0, edge_px=0, bad_frame=1.0))
    views = [bad if bad.name in BAD else clean for bad, clean in zip(spoilt, CLEAN, strict=True)]
    learner = EMLearner(SCENE, NUM_CLASSES)
    taught(learner, views).fit()
    return learner


@cache
def checks() -> dict[str, ViewCheck]:
    return {check.name: check for check in MaskChecker(learner_with_bad_frames()).check_all()}


def test_bad_frames_come_first() -> None:
    assert {check.name for check in worst_views(checks().values(), len(BAD))} == BAD
    assert (
        max(checks()[name].reliability for name in BAD)
        < 0.9
        < min(check.reliability for name, check in checks().items() if name not in BAD)
    )


def test_reliability_is_about_the_share_of_right_pixels() -> None:
    for clean in CLEAN:
        mask = learner_with_bad_frames().views[clean.name].read_labels()
        assert checks()[clean.name].reliability == pytest.approx((mask == clean.read_labels()).mean(), abs=0.05)


def test_agreement_of_a_class_that_was_taken_for_another_is_low_and_of_the_background_high() -> None:
    for name in BAD:
        check = checks()[name]
        right = np.zeros(NUM_CLASSES)
        counts = check.counts.dense(len(check.classes))
        right[check.classes] = counts[check.classes, np.arange(len(check.classes))]
        agreement = right / counts.sum(axis=1)
        assert agreement[0] > 0.95 and (agreement[1:] < 0.2).all()


def test_confusions_name_what_was_taken_for_what_largest_first() -> None:
    check = ViewCheck("a", 110, np.array([0, 2]), CSRRows.from_dense(np.array([[50, 3], [10, 0], [7, 30]])))
    assert check.checked == 100 and check.reliability == pytest.approx(0.8)
    assert check.confusions(2) == [(1, 0, 0.1), (2, 0, 0.07)]


def test_report_is_sorted_worst_first_and_plain_json() -> None:
    report = reliability_report(checks().values(), NAMES)
    assert json.loads(json.dumps(report)) == report
    assert {entry["name"] for entry in report[: len(BAD)]} == BAD
    assert [entry["reliability"] for entry in report] == sorted(entry["reliability"] for entry in report)
    rejected = [entry["rejected_share"] for entry in report]
    assert max(rejected[len(BAD) :]) == 0 < min(rejected[: len(BAD)])
    for entry in report[: len(BAD)]:
        assert entry["num_pixels"] == 64 * 48
        shares = [confusion["share"] for confusion in entry["confusions"]]
        assert shares == sorted(shares, reverse=True) and 0 < sum(shares) <= 1 - entry["reliability"] + 1e-3
        assert all({confusion["true"], confusion["seen"]} <= set(NAMES.values()) for confusion in entry["confusions"])


def test_a_share_of_a_few_pixels_is_not_said_to_be_nothing() -> None:
    check = ViewCheck("a", 400_000, np.array([0, 1]), CSRRows.from_dense(np.array([[399_990, 10], [0, 0]])))
    (confusion,) = reliability_report([check], NAMES)[0]["confusions"]
    assert confusion["share"] > 0 and percent(confusion["share"]) == "<0.1 %"
    assert [percent(value) for value in (0.0, 0.0006, 1.0, None)] == ["0.0 %", "0.1 %", "100.0 %", "-"]


def test_a_view_is_held_against_the_others_only() -> None:
    learner = EMLearner(SCENE, NUM_CLASSES)
    taught(learner, CLEAN[:1]).fit()
    alone = MaskChecker(learner).check_all()[0]
    truth = CLEAN[0].read_labels()
    # Nobody else has seen what it shows, so only the empty rays, which belong to the background, say anything.
    assert alone.checked < truth.size and not alone.counts.sums()[1:].any()
    assert (alone.prediction()[truth > 0] == UNKNOWN).mean() > 0.9


def test_a_mask_is_compared_by_the_classes_that_occur_however_many_names_there_are() -> None:
    ids = np.array([0, 1, 700, 65_534])
    truth, predicted = (wrong_views(2, seed=seed)[0].read_labels() for seed in (1, 2))
    predicted[:5] = UNKNOWN
    camera = CLEAN[0].camera
    few = compare_mask(View.from_arrays(camera, truth), predicted, NUM_CLASSES)
    view = View.from_arrays(camera, ids[truth].astype(np.int32))
    far = np.where(predicted < 0, UNKNOWN, ids[predicted]).astype(np.int32)
    compare_mask(view, far, 65_535)  # Whoever does so first in a process loads what it takes.
    tracemalloc.start()
    many = compare_mask(view, far, 65_535)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**24, "of tables of all names, one row each would take 512 KiB"
    assert many.classes.tolist() == ids[few.classes].tolist() and many.num_pixels == few.num_pixels
    np.testing.assert_array_equal(many.counts.dense(4)[ids], few.counts.dense(4))
    assert many.checked == few.checked and many.reliability == few.reliability
    assert many.confusions() == [(ids[k], ids[y], share) for k, y, share in few.confusions()]


def test_a_check_holds_what_occurs_however_many_labels_and_names_there_are() -> None:
    labels = np.arange(HEIGHT * WIDTH, dtype=np.int32).reshape(HEIGHT, WIDTH)
    check = compare_mask(View.from_arrays(CLEAN[0].camera, labels), labels // 2 * 2, 65_535)
    assert sum(part.nbytes for part in check.counts) < 2**20, "all classes by all labels would take 1.6 GB"
    assert check.checked == labels.size and check.reliability == 0.5
    assert check.confusions(2) == [(0, 1, 1 / labels.size), (2, 3, 1 / labels.size)]


def test_a_prediction_of_another_view_or_of_other_classes_is_refused() -> None:
    right = CLEAN[0].read_labels()
    for wrong in (right[:3], right.T, right.astype(float), right - 2, right + NUM_CLASSES):
        with pytest.raises(MaskFormatError, match=f"view '{CLEAN[0].name}': prediction is .* expected integers -1 to"):
            compare_mask(CLEAN[0], wrong, NUM_CLASSES)


def test_unknown_pixels_do_not_count() -> None:
    labels = CLEAN[0].read_labels().copy()
    labels[:20] = UNKNOWN
    learner = EMLearner(SCENE, NUM_CLASSES)
    taught(learner, [View.from_arrays(CLEAN[0].camera, labels), *CLEAN[1:]]).fit()
    check = MaskChecker(learner).check_all()[0]
    assert check.num_pixels == check.checked == (labels >= 0).sum()


def test_of_large_views_a_third_is_compared_which_tells_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    every = checks()
    monkeypatch.setattr(mask_reliability, "_LARGE", 100)
    for third in MaskChecker(learner_with_bad_frames()).check_all():
        whole = every[third.name]
        assert third.num_pixels == whole.num_pixels and third.checked == pytest.approx(whole.checked / 3, rel=0.1)
        assert third.reliability == pytest.approx(whole.reliability, abs=0.05)  # Of views of 3,072 px.
        shown = third.prediction()
        np.testing.assert_array_equal(shown[shown != UNKNOWN], whole.prediction()[shown != UNKNOWN])
        if third.name in BAD:  # They are shown to people, in full.
            np.testing.assert_array_equal(shown, whole.prediction())


@pytest.mark.parametrize("size", [(480, 640), (1080, 1920), (1152, 2048), (1536, 3072), (1856, 2464), (2160, 3840)])
def test_of_what_is_compared_in_a_large_view_of_any_size_some_is_sampled(size: tuple[int, int]) -> None:
    sampled = grid_of(*size).of(mask_reliability._compared(np.zeros(size, np.int32)))
    assert sampled.mean() > 0.3


def test_views_of_which_nothing_is_known_come_last_and_have_no_figure() -> None:
    unknown = ViewCheck("unknown", 5, np.array([1]), CSRRows.empty(2, np.int64))
    good = ViewCheck("good", 5, np.array([1]), CSRRows.from_dense(np.array([[0], [5]])))
    assert math.isnan(unknown.reliability) and good.reliability == 1
    assert [check.name for check in worst_views([unknown, good])] == ["good", "unknown"]
    assert reliability_report([unknown], {})[0] == {
        "name": "unknown", "reliability": None, "num_pixels": 5, "rejected_share": 0.0, "confusions": [],
    }  # fmt: skip


def test_every_view_is_told_of_and_nothing_that_was_learnt_changes() -> None:
    learner = learner_with_bad_frames()
    codes, told = learner.codes_.copy(), []
    MaskChecker(learner).check_all(lambda stage, done, total: told.append((stage, done, total)))
    np.testing.assert_array_equal(learner.codes_, codes)
    assert told == [("check views", done, 12) for done in range(13)]


def test_a_check_tells_which_classes_the_border_cuts() -> None:
    labels, predicted = np.zeros((2, HEIGHT, WIDTH), np.int32)
    labels[5:9, :3], predicted[7, :3] = 2, 2  # they agree there
    labels[5:9, -1], predicted[5:9, -1] = 1, 3
    labels[20:30, 20:30] = predicted[20:30, 20:30] = 4
    check = compare_mask(View.from_arrays(ring(1)[0], labels), predicted, 5)
    np.testing.assert_array_equal(check.cut, [0, 2])


def test_the_same_views_give_the_same_figures() -> None:
    again = MaskChecker(learner_with_bad_frames()).check_all()
    for check in again:
        for one, other in zip(check.counts, checks()[check.name].counts, strict=True):
            np.testing.assert_array_equal(one, other)


def test_picture_has_a_row_of_three_for_each_of_the_worst_views() -> None:
    learner = learner_with_bad_frames()
    images, every = ViewImages(SCENE), list(checks().values())
    one, two = (draw_worst_views(images.rendered, learner.views, every, count) for count in (1, 2))
    assert one.dtype == np.uint8 and one.shape[1] == two.shape[1] > 3 * 64
    assert two.shape[0] - one.shape[0] > 48
