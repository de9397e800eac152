"""Regions of masks: what is connected, and which lose their label since the other views contradict it."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from scipy import ndimage
from small_scenes import NUM_CLASSES, balls_on_a_table, clean_views, mean_iou, taught, with_clutter

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.label_evidence import LabelEvidence
from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.data.soft_masks import SeenLabels
from gsseg_core.data.view import View
from gsseg_core.errors import SettingsError
from gsseg_core.learn.em.confusion_model import ErrorModel
from gsseg_core.learn.em.em_learner import EMLearner, EMSettings
from gsseg_core.learn.em.rejected_regions import MOST, SMALLEST, connected_pixels, find_rejected, split_regions
from gsseg_core.learn.vote_learner import VoteLearner

SCENE, _ = balls_on_a_table()
SHAPES = st.tuples(st.integers(1, 12), st.integers(1, 12))


@given(arrays.arrays(np.int32, SHAPES, elements=st.integers(-1, 2)))
def test_connected_pixels_are_those_of_scipy(labels: np.ndarray) -> None:
    connected, first, area = connected_pixels(labels)
    np.testing.assert_array_equal(connected < 0, labels < 0)
    np.testing.assert_array_equal(np.bincount(connected[connected >= 0], minlength=len(area)), area)
    numbers, firsts = np.unique(connected, return_index=True)
    np.testing.assert_array_equal(first, firsts[numbers >= 0])
    assert (np.diff(first) > 0).all()
    many = 0
    for k in range(3):
        parts, count = ndimage.label(labels == k)
        many += count
        for part in range(1, count + 1):
            assert len(np.unique(connected[parts == part])) == 1
    assert len(area) == many


@given(arrays.arrays(np.int32, st.just((40, 30)), elements=st.integers(-1, 2), fill=st.integers(0, 2)))
def test_regions_mean_what_the_labels_were_and_only_large_ones_stand_alone(labels: np.ndarray) -> None:
    seen = split_regions(SeenLabels(labels))
    np.testing.assert_array_equal(seen.named(), np.maximum(labels, UNKNOWN))
    if seen.evidence is None:
        assert (labels < 0).all()
        return
    assert seen.evidence.is_certain and seen.evidence.informative.all()
    np.testing.assert_array_equal(np.unique(seen.labels[seen.labels >= 0]), np.arange(len(seen.evidence.informative)))
    connected, _, area = connected_pixels(labels)
    large = np.flatnonzero(area >= SMALLEST)
    alone = [np.unique(seen.labels[connected == part]) for part in large]
    assert all(len(region) == 1 for region in alone)
    assert len(np.unique(alone)) == len(large)
    assert len(seen.evidence.informative) <= len(large) + 3


def test_regions_of_one_word_each_need_no_product_of_matrices() -> None:
    rng = np.random.default_rng(0)
    labels = np.kron(rng.integers(0, 6, (8, 8)), np.ones((12, 12), int)).astype(np.int32)
    evidence = split_regions(SeenLabels(labels)).evidence
    assert evidence is not None and len(evidence.informative) > 20
    evidence = evidence.without_names(rng.random(len(evidence.informative)) < 0.3)
    only, plausible = evidence.only_words, evidence.word_plausibility
    assert only is not None and plausible is not None
    np.testing.assert_array_equal(np.eye(plausible.shape[1])[only], plausible)
    assert evidence.nameless is not None and evidence.mass is not None
    voted = np.where(evidence.nameless[:, None], 0, evidence.mass)
    np.testing.assert_array_equal(evidence.votes.dense(6)[:, evidence.classes], voted)
    counts = rng.random((6, len(only)))
    model = ErrorModel.from_counts(evidence, counts, 0.3, 1e-3, np.full(len(only), 9))
    words = (1 - 1e-3) * model.confusion + np.float32(1e-3 / plausible.shape[1])
    np.testing.assert_array_equal(model.likelihood, words @ plausible.T)
    np.testing.assert_allclose(
        model.expected_counts(counts), counts @ plausible * (1 - 1e-3) * model.confusion, rtol=1e-12
    )
    soft = LabelEvidence(evidence.classes, np.full((1, len(evidence.classes)), 1 / 8, np.float32))
    blank = LabelEvidence(evidence.classes[:1], np.array([[1], [0]], np.float32))  # the second says nothing
    assert soft.only_words is None and blank.only_words is None


def test_votes_of_thousands_of_labels_take_memory_for_one_each() -> None:
    evidence = LabelEvidence(np.arange(3_000, dtype=np.int32), np.eye(3_000, dtype=np.float32))
    tracemalloc.start()
    votes = evidence.votes
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**25, "a table of all labels by all classes takes 72 MB"
    assert votes.indices.tolist() == list(range(3_000)) and (votes.data == 1).all()


def test_of_very_many_regions_the_largest_stand_alone() -> None:
    y, x = np.indices((30 * 8, 40 * 8)) // 8
    labels = ((y + x) % 2).astype(np.int32)
    labels[:8, :24] = 2
    seen = split_regions(SeenLabels(labels))
    assert seen.evidence is not None and len(seen.evidence.informative) == MOST + 2
    assert (seen.labels == seen.labels[0, 0]).sum() == 8 * 24


def test_what_one_view_alone_claims_against_all_others_is_rejected() -> None:
    views = clean_views(8)
    clean = taught(EMLearner(SCENE, NUM_CLASSES), views).fit()
    assert not any(clean.rejected_share(view) for view in views)
    cluttered = [with_clutter(view, 1 + i % 3) for i, view in enumerate(views)]
    naive, learner = (
        taught(EMLearner(SCENE, NUM_CLASSES, EMSettings(least_agreement=least)), cluttered).fit()
        for least in (0.0, EMSettings.least_agreement)
    )
    for view in cluttered:
        evidence = learner.error_models_[view.name].evidence
        labels = split_regions(view.read_seen()).labels
        assert evidence.nameless is not None and evidence.nameless[labels[-1, 0]]
        assert evidence.nameless.sum() == 1
        assert learner.rejected_share(view) == pytest.approx((labels == labels[-1, 0]).mean(), rel=0.1)
    assert mean_iou(learner) > mean_iou(naive)
    assert mean_iou(learner) > mean_iou(clean) - 0.01


def test_what_is_rejected_has_no_say_against_others() -> None:
    right, wrong, *others = clean_views(6)
    # Two views show a ball, and one of them gives it and much around it a label of its own.
    labels = wrong.read_labels()
    around = ndimage.binary_dilation(labels == 1, iterations=16)
    views = [right, View.from_arrays(wrong.camera, np.where(around, NUM_CLASSES, labels))]
    for view in others:
        near = ndimage.binary_dilation(view.read_labels() == 1, iterations=12)
        views.append(View.from_arrays(view.camera, np.where(near, UNKNOWN, view.read_labels())))
    learner = taught(EMLearner(SCENE, NUM_CLASSES + 1), views)
    votes, evidence = learner._votes.rows(), learner.observation(right.name).evidence
    _, at_first = learner._find_rejected(votes, dict.fromkeys(learner.views), lambda: None)
    assert evidence.named()[at_first[right.name]].tolist() == [1]
    _, rejected = learner._reject_regions(votes, lambda: None)
    assert [name for name, labels in rejected.items() if labels is not None] == [wrong.name]
    learner.fit()
    assert learner.rejected_share(right) == 0
    assert 1 in learner.codes_.argmax(axis=1)


def test_gaussians_of_which_only_doubtful_regions_speak_have_no_code() -> None:
    first, *others = clean_views(4)
    # A blob over all of the table in one view; the others leave open what is near one of the balls.
    views = [View.from_arrays(first.camera, np.where(first.read_labels() < 2, 3, 2))]
    for view in others:
        near = ndimage.binary_dilation(view.read_labels() == 1, iterations=9)
        views.append(View.from_arrays(view.camera, np.where(near, UNKNOWN, view.read_labels())))
    learner = taught(EMLearner(SCENE, NUM_CLASSES), views).fit()
    voted = learner._votes.dense().any(axis=1)
    assert (voted & ~learner.observed_).any()
    np.testing.assert_array_equal(learner.codes_.any(axis=1), learner.observed_)
    assert (learner.observed_ <= voted).all()


@pytest.mark.parametrize(("seen", "expected"), [(1.0, True), (0.5, True), (0.2, False), (0.001, False)])
def test_a_region_is_rejected_only_where_the_others_saw_enough_of_it(seen: float, expected: bool) -> None:
    view = clean_views(1)[0]
    learner = EMLearner(SCENE, NUM_CLASSES + 1)
    learner.observe(view)
    votes = learner._votes.dense()
    votes[:, NUM_CLASSES] = seen * votes.sum(axis=1)  # all is one more class to the others
    observation, possible = learner._prepared.in_memory[view.name], np.ones(NUM_CLASSES + 1, bool)
    rejected = find_rejected(CSRRows.from_dense(votes), observation, possible, EMSettings().least_agreement)
    assert len(rejected) >= NUM_CLASSES
    np.testing.assert_array_equal(rejected, expected)


@pytest.mark.parametrize(("rivals", "expected"), [(1, True), (2, False)])
def test_one_other_class_speaks_against_a_label_more_than_many(rivals: int, expected: bool) -> None:
    view = clean_views(1)[0]
    learner = EMLearner(SCENE, NUM_CLASSES + rivals)
    learner.observe(view)
    votes = learner._votes.dense()
    others = votes[:, :NUM_CLASSES].sum(axis=1)
    votes[:, :NUM_CLASSES] += (0.07 * votes[:, :NUM_CLASSES]).astype(np.int64)
    votes[:, NUM_CLASSES:] = (0.93 / rivals * others)[:, None]
    observation, possible = learner._prepared.in_memory[view.name], np.ones(NUM_CLASSES + rivals, bool)
    rejected = find_rejected(CSRRows.from_dense(votes), observation, possible, EMSettings().least_agreement)
    np.testing.assert_array_equal(rejected, expected)


@pytest.mark.parametrize(("rivals", "expected"), [(1, True), (4, True), (6, False)])
def test_what_others_saw_of_a_region_speaks_against_its_label_only_if_one_class_has_enough_of_it(
    rivals: int, expected: bool
) -> None:
    view = clean_views(1)[0]
    learner = EMLearner(SCENE, NUM_CLASSES + rivals)
    learner.observe(view)
    votes = learner._votes.dense()
    votes[:, NUM_CLASSES:] = votes.sum(axis=1)[:, None] / rivals  # As where others see it through gaps.
    observation, possible = learner._prepared.in_memory[view.name], np.ones(NUM_CLASSES + rivals, bool)
    rejected = find_rejected(CSRRows.from_dense(votes), observation, possible, EMSettings().least_agreement)
    np.testing.assert_array_equal(rejected, expected)


def test_a_region_without_its_label_still_tells_what_its_pixels_are() -> None:
    views = clean_views(6)
    labels = views[2].read_labels()
    views[2] = View.from_arrays(views[2].camera, np.where(labels == 1, 3, labels))
    learner = taught(EMLearner(SCENE, NUM_CLASSES), views).fit()
    model = learner.error_models_[views[2].name]
    assert model.evidence.nameless is not None and model.evidence.nameless.sum() == 1
    (word,) = np.flatnonzero(model.evidence.vocabulary == UNKNOWN)
    assert model.confusion[1].argmax() == word
    assert model.confusion[:, word].argmax() == 1
    np.testing.assert_allclose(model.confusion.sum(axis=1), 1, atol=1e-5)


def test_regions_of_a_single_view_are_never_rejected() -> None:
    view = with_clutter(clean_views(1)[0])
    learner = taught(EMLearner(SCENE, NUM_CLASSES), [view]).fit()
    assert learner.rejected_share(view) == 0
    assert learner.observed_.any()


def test_labels_of_partial_masks_and_of_soft_ones_that_name_no_class_are_never_rejected() -> None:
    views = clean_views(5)
    odd = with_clutter(views[0]).read_labels()
    views[0] = View.from_probabilities(views[0].camera, np.stack([0.4 * (odd == k) for k in range(NUM_CLASSES)]))
    odd = with_clutter(views[1]).read_labels()
    views[1] = View.from_arrays(views[1].camera, np.where(odd == 3, 3, 0), supervised=[3])
    learner = taught(EMLearner(SCENE, NUM_CLASSES), views).fit()
    assert not any(learner.rejected_share(view) for view in views[:2])
    assert all(learner.observation(view.name).evidence.nameless is None for view in views[:2])


def test_soft_masks_of_all_classes_are_learnt_from_as_what_they_hold_likeliest() -> None:
    views = clean_views(5)
    odd = with_clutter(views[0]).read_labels()
    chances = np.stack([np.where(odd == k, 0.7, 0.3 / (NUM_CLASSES - 1)) for k in range(NUM_CLASSES)])
    chances[:, :9] *= 0.5  # There more is left open than any class has, and so nothing is known.
    soft = [View.from_probabilities(views[0].camera, chances), *views[1:]]
    hard = [View.from_arrays(views[0].camera, np.where(np.arange(48)[:, None] < 9, -1, odd)), *views[1:]]
    one, two = (taught(EMLearner(SCENE, NUM_CLASSES), each).fit() for each in (soft, hard))
    np.testing.assert_array_equal(one.codes_, two.codes_)
    assert one.rejected_share(soft[0]) == two.rejected_share(hard[0]) > 0
    for view in soft:
        one.retract(view.name)
    assert not one._votes.dense().any()


def test_views_come_and_go_exactly_with_regions_too() -> None:
    views = [with_clutter(view) for view in clean_views(4)]
    for budget in (0, 1 << 30):
        learner = taught(EMLearner(SCENE, NUM_CLASSES, memory_budget=budget), views)
        learner.fit()
        for view in views[1:]:
            learner.retract(view.name)
        np.testing.assert_array_equal(
            learner._votes.dense(), taught(EMLearner(SCENE, NUM_CLASSES), views[:1])._votes.dense()
        )
        learner.retract(views[0].name)
        assert not learner._votes.dense().any()


def test_votes_by_region_are_the_votes() -> None:
    views = [with_clutter(view) for view in clean_views(4)]
    em, votes = (taught(make(SCENE, NUM_CLASSES), views)._votes.dense() for make in (EMLearner, VoteLearner))
    np.testing.assert_allclose(em, votes, rtol=1e-6, atol=2 * len(views))  # each sighting is rounded once


def test_settings_out_of_range_are_refused() -> None:
    with pytest.raises(SettingsError, match=r"least_agreement is 1.5; expected a share in \[0, 1\]"):
        EMSettings(least_agreement=1.5)
    with pytest.raises(SettingsError, match=r"majority is 0.5; expected 1 or more"):
        EMSettings(majority=0.5)
