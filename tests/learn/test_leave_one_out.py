"""What the other views make of a view: the fast count against the sum as it is written."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_scenes import NUM_CLASSES, balls_on_a_table, clean_views

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.label_evidence import UNITS, LabelEvidence
from gsseg_core.data.view import View
from gsseg_core.learn.em import em_kernels
from gsseg_core.learn.em.em_kernels import leave_one_out_counts
from gsseg_core.learn.em.em_learner import EMLearner
from gsseg_core.learn.vote_resolution import resolved_votes
from gsseg_core.raster.observation import Observation

SCENE, _ = balls_on_a_table()
POSSIBLE = np.ones(NUM_CLASSES, bool)


def observed(views: list[View], name: str) -> tuple[EMLearner, Observation]:
    learner = EMLearner(SCENE, NUM_CLASSES)
    for view in views:
        learner.observe(view)
    return learner, learner._prepared.in_memory[name]


def slow_count(
    votes: np.ndarray,  # (N, K) int64
    observation: Observation,
    evidence: LabelEvidence,
    power: float,
    most: float,
) -> np.ndarray:
    """Readable twin of `leave_one_out_counts`, Gaussian by Gaussian."""
    counts = np.zeros((NUM_CLASSES, len(observation.classes)))
    own, voted = observation.votes().astype(np.float64), evidence.votes.dense(NUM_CLASSES)
    for m, i in enumerate(observation.ids):
        mine = slice(observation.start[m], observation.start[m + 1])
        label, pixels = observation.labels[mine], own[mine]
        others = votes[i] - np.rint(pixels[:, None] * voted[label] * UNITS).astype(np.int64).sum(axis=0)
        others = resolved_votes(CSRRows.from_dense(others[None]), POSSIBLE).dense(NUM_CLASSES)[0]
        if not others.any():
            continue
        code = (others / others.sum()) ** power
        share = min(1.0, most * others.sum() / UNITS / pixels.sum())
        np.add.at(counts.T, label, share * pixels[:, None] * (code / code.sum()))
    return counts


@settings(max_examples=8)
@given(st.integers(0, 2**31), st.sampled_from([1.0, 4.0, 2.5, 40.0]), st.sampled_from([np.inf, 1.0, 0.3]))
def test_counts_by_the_others_are_those_of_a_slow_twin(seed: int, power: float, most: float) -> None:
    rng = np.random.default_rng(seed)
    views = clean_views(3)
    learner, observation = observed(views, views[1].name)
    shape = learner._votes.shape
    votes = learner._votes.dense() + rng.integers(0, int(UNITS), shape) * (rng.random(shape) < 0.2)
    evidence = observation.evidence.without_names(rng.random(len(observation.classes)) < 0.3)
    found = leave_one_out_counts(CSRRows.from_dense(votes), observation, POSSIBLE, evidence, power, most)
    np.testing.assert_allclose(found, slow_count(votes, observation, evidence, power, most), rtol=1e-4, atol=1e-4)


def test_counts_of_thousands_of_classes_are_the_same_and_take_memory_for_a_few_tables(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    views = clean_views(3)
    learner, observation = observed(views, views[1].name)
    votes, many = learner._votes.rows(), np.arange(60_000) < NUM_CLASSES
    few = leave_one_out_counts(votes, observation, POSSIBLE, observation.evidence, 4.0)
    monkeypatch.setattr(em_kernels, "_AT_ONCE", 3 * len(many) * len(observation.classes))
    tracemalloc.start()
    found = leave_one_out_counts(votes, observation, many, observation.evidence, 4.0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 6 * found.nbytes, "one for each of 16 blocks would be 17"
    np.testing.assert_array_equal(found[:NUM_CLASSES], few)
    assert few.any() and not found[NUM_CLASSES:].any()


@pytest.mark.parametrize("looked_for", [[1], [1, 2], [2, 3]])
def test_votes_against_classes_leave_what_can_be_said_with_them(looked_for: list[int]) -> None:
    views = []
    for view in clean_views(4):
        labels = view.read_labels()
        found = np.where(np.isin(labels, looked_for), labels, 0)
        views.append(View.from_arrays(view.camera, found, supervised=looked_for))
    learner, observation = observed(views, views[2].name)
    assert (learner._votes.dense() < 0).any()
    counts = leave_one_out_counts(learner._votes.rows(), observation, POSSIBLE, observation.evidence, 4.0)
    expected = slow_count(learner._votes.dense(), observation, observation.evidence, 4.0, np.inf)
    np.testing.assert_allclose(counts, expected, rtol=1e-4, atol=1e-4)
    assert counts.any()


def test_a_view_alone_has_nobody_beside_it() -> None:
    view = clean_views(1)[0]
    learner, observation = observed([view], view.name)
    assert not leave_one_out_counts(learner._votes.rows(), observation, POSSIBLE, observation.evidence, 4.0).any()
