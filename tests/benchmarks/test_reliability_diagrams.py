"""The measure of how far confidences are off."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from reliability_diagrams import ReliabilityDiagram, risk_coverage


def test_ece_of_predictions_that_are_right_as_often_as_they_say_tends_to_zero() -> None:
    rng = np.random.default_rng(0)
    errors = []
    for count in (1_000, 100_000):
        sure, diagram = rng.uniform(size=count), ReliabilityDiagram()
        diagram.add(sure, rng.random(count) < sure)
        errors.append(diagram.ece)
    assert errors[1] < 0.006 < errors[0]


def test_ece_of_predictions_that_are_too_sure_is_the_gap() -> None:
    rng = np.random.default_rng(0)
    sure, diagram = rng.uniform(0.5, 1.0, 100_000), ReliabilityDiagram()
    diagram.add(sure, rng.random(100_000) < sure - 0.25)
    assert diagram.ece == pytest.approx(0.25, abs=0.005)


def test_bins_of_a_diagram_hold_shares_means_and_hits_and_views_add_up() -> None:
    diagram = ReliabilityDiagram()
    diagram.add(np.array([[0.9, 1.0], [0.02, 0.04]]), np.array([[True, False], [False, True]]))
    diagram.add(np.array([1.0]), np.array([0.5]), np.array([2.0]))
    assert diagram.shares[[0, 13, 14]] == pytest.approx([2 / 6, 1 / 6, 3 / 6]) and diagram.shares.sum() == 1
    assert diagram.confidence[[0, 13, 14]] == pytest.approx([0.03, 0.9, 1.0])
    assert diagram.accuracy[[0, 13, 14]] == pytest.approx([0.5, 1.0, 1 / 3])
    assert np.isnan(diagram.accuracy[5]) and np.isnan(ReliabilityDiagram().ece)
    assert diagram.ece == pytest.approx((2 * 0.47 + 0.1 + 3 * (1 - 1 / 3)) / 6)


@given(st.integers(1, 200), st.integers(0, 2**32 - 1))
def test_order_of_predictions_does_not_matter(count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    sure, right, order = rng.integers(0, 9, count) / 8, rng.random(count) < 0.7, rng.permutation(count)
    one, two = ReliabilityDiagram(), ReliabilityDiagram()
    one.add(sure, right)
    two.add(sure[order], right[order])
    assert one.ece == pytest.approx(two.ece)
    np.testing.assert_allclose(risk_coverage(sure, right).risk, risk_coverage(sure[order], right[order]).risk)


def test_risk_grows_with_coverage_from_the_surest_on_and_ties_count_as_their_mean() -> None:
    curve = risk_coverage(np.array([0.2, 0.9, 0.5, 0.5]), np.array([False, True, True, False]))
    assert curve.coverage.tolist() == [0.25, 0.5, 0.75, 1.0]
    assert curve.risk == pytest.approx([0, 0.25, 1 / 3, 0.5])
    assert curve.area == pytest.approx(np.mean([0, 0.25, 1 / 3, 0.5]))
