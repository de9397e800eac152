"""The spatial prior: from votes at first, and where masks vote against classes, once more from what EM has learnt."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_scenes import NUM_CLASSES, balls_on_a_table, clean_views, mean_iou, taught, wrong_views

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.view import View
from gsseg_core.learn.em import em_learner
from gsseg_core.learn.em.em_kernels import m_step
from gsseg_core.learn.em.em_learner import EMLearner, EMSettings
from gsseg_core.learn.em.spatial_prior import spatial_prior, with_prior
from gsseg_core.spatial.neighbourhood import HALF

SCENE, TRUTH = balls_on_a_table()


class PriorOfVotes(EMLearner):
    """A learner whose prior stays what the votes of the neighbours say."""

    def _spatial_prior(self, of: CSRRows, evidence: np.ndarray) -> CSRRows:
        if not self.history_:
            self._first = super()._spatial_prior(of, evidence)
        return self._first


def parts_of(views: Sequence[View]) -> list[View]:
    """Masks of one class each, in turn."""
    looked_for = [1 + i % 3 for i in range(len(views))]
    return [
        View.from_arrays(view.camera, np.where(view.read_labels() == k, k, 0), supervised=[k])
        for view, k in zip(views, looked_for, strict=True)
    ]


def test_what_wrong_partial_masks_outvoted_comes_back_by_what_em_has_learnt_of_the_neighbours() -> None:
    """More than before in each of some draws, and of the Gaussians of objects a twentieth more are right."""
    found: list[tuple[float, float]] = []
    for seed in range(4):
        views = parts_of(wrong_views(12, seed=seed))
        learners = [taught(kind(SCENE, NUM_CLASSES), views).fit() for kind in (PriorOfVotes, EMLearner)]
        before, after = (mean_iou(learner) for learner in learners)
        assert after > before
        right = [(learner.codes_.argmax(axis=1) == TRUTH)[TRUTH > 0].mean() for learner in learners]
        found.append((right[0], right[1]))
    before, after = np.mean(found, axis=0)
    assert after > before + 0.05


def test_true_partial_masks_lose_nothing_by_it() -> None:
    views = parts_of(clean_views(12))
    before, after = (mean_iou(taught(kind(SCENE, NUM_CLASSES), views).fit()) for kind in (PriorOfVotes, EMLearner))
    assert after > before - 0.002


@given(st.integers(0, 1000), st.booleans())
@settings(max_examples=6, deadline=None)
def test_of_complete_masks_the_prior_is_that_of_the_votes_bit_for_bit(seed: int, soft: bool) -> None:
    views = wrong_views(5, seed=seed)
    if soft:
        one_hot = [np.arange(NUM_CLASSES)[:, None, None] == view.read_labels() for view in views]
        views = [View.from_probabilities(v.camera, 0.1 + 0.6 * m) for v, m in zip(views, one_hot, strict=True)]
    long = EMSettings(max_steps=60)
    with pytest.MonkeyPatch.context() as patched:
        patched.delattr(em_learner, "with_prior")
        one = taught(EMLearner(SCENE, NUM_CLASSES, long), views).fit()
    two = taught(PriorOfVotes(SCENE, NUM_CLASSES, long), views).fit()
    assert len(one.rounds_) == 2
    np.testing.assert_array_equal(one.codes_, two.codes_)
    assert one.history_ == two.history_


@given(st.integers(0, 2**31 - 1))
@settings(max_examples=30)
def test_another_prior_keeps_what_was_learnt_and_brings_its_classes_with_the_next_step(seed: int) -> None:
    rng = np.random.default_rng(seed)
    shares = rng.random((20, 5)).astype(np.float32) * (rng.random((20, 5)) < 0.4)
    gradient = rng.integers(1, 1 << 30, (20, 5)) * (shares > 0)
    other = rng.random((20, 5)).astype(np.float32) * (rng.random((20, 5)) < 0.4)
    codes = CSRRows.from_dense(shares).normalised()
    kept, gained, prior = with_prior(codes, CSRRows.from_dense(gradient).data, CSRRows.from_dense(other))
    np.testing.assert_array_equal(kept.dense(5), codes.dense(5))
    np.testing.assert_array_equal(kept.with_data(gained).dense(5), gradient)
    np.testing.assert_array_equal(prior.dense(5), other)
    m_step(kept, gained, prior.data)
    np.testing.assert_array_equal(kept.dense(5) > 0, (shares > 0) | (other > 0))


@given(st.integers(0, 2**31 - 1), st.integers(1, 20))
@settings(max_examples=20)
def test_the_better_a_neighbour_was_seen_the_more_it_counts_and_one_that_was_not_counts_nothing(
    seed: int, k: int
) -> None:
    rng, n = np.random.default_rng(seed), len(SCENE)
    codes = rng.dirichlet(np.full(NUM_CLASSES, 0.5), n).astype(np.float32)
    evidence = rng.exponential(2.0, n) * (rng.random(n) < 0.7)
    found = spatial_prior(CSRRows.from_dense(codes), evidence, SCENE, k, 3.0, NUM_CLASSES).dense(NUM_CLASSES)
    means = SCENE.means.astype(np.float64)
    for i in rng.choice(n, 20, replace=False):
        distances = np.linalg.norm(means - means[i], axis=1)
        distances[i] = np.inf
        near, beyond = np.split(np.argsort(distances)[: k + 1], [k])
        if distances[beyond] - distances[near].max() < 1e-6 * distances[beyond]:
            continue  # Both are as near to float32, so that either may count.
        weights = np.maximum(evidence[near] / (evidence[near] + HALF), 2.0**-10) * (evidence[near] > 0)
        expected = 3.0 * weights @ codes[near] / max(weights.sum(), 1e-9)
        np.testing.assert_allclose(found[i], expected, atol=1e-3)
