"""The graph term: codes spread to what no view saw, are held by evidence, and know no unit of length."""

from __future__ import annotations

import numpy as np
import pytest
import small_scenes
from hypothesis import example, given
from hypothesis import strategies as st

from gsseg_core.data.view import View
from gsseg_core.errors import SceneValueError, SettingsError
from gsseg_core.learn.em.em_learner import EMLearner
from gsseg_core.refine.label_propagation import GraphSettings, propagate
from gsseg_core.spatial.neighbour_graph import Graph, graph_of

FEW = GraphSettings(k=4, steps=60)


def some_points(seed: int = 0, count: int = 80) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(count, 3)).astype(np.float32), rng.uniform(size=(count, 3)).astype(np.float32)


def some_codes(seed: int = 0, count: int = 80, classes: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Codes of which a third is unknown, and their evidence."""
    rng = np.random.default_rng(seed)
    codes = rng.dirichlet(np.ones(classes), count).astype(np.float32)
    codes[rng.random(count) < 1 / 3] = 0
    return codes, rng.exponential(3.0, count).astype(np.float32)


def slow_graph(means: np.ndarray, colors: np.ndarray, k: int) -> np.ndarray:
    """Weights p_ij as the module's docstring has them, (N, N)."""
    apart = np.linalg.norm(means[:, None].astype(float) - means, axis=2)
    np.fill_diagonal(apart, np.inf)
    near = np.argsort(apart, axis=1)[:, :k]
    rows = np.arange(len(means))[:, None]
    spacing = apart[rows, near].max(axis=1)
    contrast = np.linalg.norm(colors[:, None] - colors[near], axis=2)
    unnormalised = np.exp(
        -(apart[rows, near] ** 2) / (spacing[:, None] * spacing[near]) - (contrast / np.median(contrast)) ** 2 / 2
    )
    weights = np.zeros((len(means), len(means)))
    weights[rows, near] = unnormalised / unnormalised.sum(axis=1, keepdims=True)
    return weights


def slow_propagate(weights: np.ndarray, codes: np.ndarray, evidence: np.ndarray, strength: float) -> np.ndarray:
    """Solve for the codes at rest; every Gaussian must be within reach of one that is known."""
    weight = np.where(codes.any(axis=1), evidence / strength, 0.0)
    system = np.diag(weight + 1) - weights
    return np.linalg.solve(system, weight[:, None] * codes)


def test_weights_are_those_of_the_formula() -> None:
    means, colors = some_points()
    graph = Graph.build(means, colors, 4)
    dense = np.zeros((80, 80))
    of = np.repeat(graph.order, np.diff(graph.indptr))
    dense[of, graph.order[graph.indices]] = graph.weights
    np.testing.assert_allclose(dense, slow_graph(means, colors, 4), atol=1e-5)


def test_steps_end_where_the_linear_system_is_solved() -> None:
    means, colors = some_points()
    codes, evidence = some_codes()
    fast = propagate(Graph.build(means, colors, 4), codes, evidence, GraphSettings(k=4, steps=2000))
    slow = slow_propagate(slow_graph(means, colors, 4), codes, evidence, 1.0)
    np.testing.assert_allclose(fast, slow, atol=5e-3)


@given(seed=st.integers(0, 1000), classes=st.sampled_from([1, 2, 20]))
def test_codes_stay_probabilities(seed: int, classes: int) -> None:
    codes, evidence = some_codes(seed, classes=classes)
    spread = propagate(Graph.build(*some_points(seed), 4), codes, evidence, FEW)
    assert spread.min() >= 0
    total = spread.sum(axis=1)
    np.testing.assert_allclose(total[total > 0], 1, atol=1e-5)


@given(seed=st.integers(0, 1000), power=st.integers(-6, 6))
def test_the_unit_of_length_does_not_matter(seed: int, power: int) -> None:
    means, colors = some_points(seed)
    codes, evidence = some_codes(seed)
    first = propagate(Graph.build(means, colors, 4), codes, evidence, FEW)
    second = propagate(Graph.build(means * np.float32(10.0**power), colors, 4), codes, evidence, FEW)
    np.testing.assert_allclose(first, second, atol=2e-3)


def test_strong_evidence_keeps_its_code_bit_for_bit_and_weak_evidence_moves() -> None:
    means, colors = some_points()
    codes, evidence = some_codes()
    known = codes.any(axis=1)
    evidence[known] = np.where(np.arange(known.sum()) % 2, 200.0, 0.5)
    spread = propagate(Graph.build(means, colors, 4), codes, evidence, FEW)
    strong = known & (evidence == 200)
    np.testing.assert_array_equal(spread[strong], codes[strong])
    assert np.abs(spread - codes)[known & (evidence == 0.5)].max() > 0.05


def test_unknown_gaussians_take_the_code_around_them() -> None:
    line = np.stack([np.arange(9), np.zeros(9), np.zeros(9)], axis=1).astype(np.float32)
    codes, evidence = np.zeros((9, 2), np.float32), np.full(9, 1e4)
    codes[0, 0] = codes[8, 1] = 1
    spread = propagate(Graph.build(line, np.zeros((9, 3)), 2), codes, evidence, GraphSettings(k=2, steps=1000))
    assert (np.diff(spread[:, 1]) > 0).all()
    assert spread[4].tolist() == pytest.approx([0.5, 0.5], abs=0.02)


def test_what_no_code_reaches_stays_unknown() -> None:
    line = np.stack([np.arange(9), np.zeros(9), np.zeros(9)], axis=1).astype(np.float32)
    codes, evidence = np.zeros((9, 2), np.float32), np.full(9, 1e4)
    codes[0, 0] = 1
    graph = Graph.build(line, np.zeros((9, 3)), 2)
    assert (
        propagate(graph, codes, evidence, GraphSettings(k=2, steps=3)).any(axis=1).tolist() == [True] * 4 + [False] * 5
    )
    assert not propagate(graph, np.zeros_like(codes), evidence).any()


@given(st.integers(0, 99), st.integers(1, 40), st.integers(1, 4))
@example(37, 36, 3)
def test_codes_without_evidence_are_probabilities_and_stay_where_nothing_is_known_around(
    seed: int, count: int, k: int
) -> None:
    graph = Graph.build(*some_points(seed, count), k)
    codes, evidence = some_codes(seed, count)
    evidence[::2] = 0
    known = codes.any(axis=1)
    spread = propagate(graph, codes, evidence)
    np.testing.assert_allclose(spread.sum(axis=1)[known], 1, atol=1e-5)
    alone = np.zeros_like(codes)
    alone[0] = 0.5, 0.25, 0.25  # powers of two, so that no rounding of sums and quotients tells them from before
    np.testing.assert_array_equal(propagate(graph, alone, evidence)[0], alone[0])


def test_without_strength_nothing_changes() -> None:
    codes, evidence = some_codes()
    graph = Graph.build(*some_points(), 4)
    np.testing.assert_array_equal(propagate(graph, codes, evidence, GraphSettings(strength=0)), codes)


@pytest.mark.parametrize("count", [1, 2, 100])
def test_degenerate_scenes_work(count: int) -> None:
    graph = Graph.build(np.ones((count, 3), np.float32), np.zeros((count, 3)), 4)
    codes = np.zeros((count, 2), np.float32)
    codes[0, 1] = 1
    spread = propagate(graph, codes, np.full(count, 1e4))
    assert spread[0].tolist() == [0, 1]
    assert np.diff(graph.indptr).max() <= 8  # a hundred points in one place do not have a hundred neighbours each


def test_the_graph_of_a_scene_is_built_once() -> None:
    scene, _ = small_scenes.balls_on_a_table()
    assert graph_of(scene, 5) is graph_of(scene, 5)
    assert graph_of(scene, 6).k == 6


def test_wrong_settings_and_shapes_are_refused() -> None:
    graph = Graph.build(*some_points(), 4)
    codes, evidence = some_codes()
    with pytest.raises(SceneValueError, match=r"expected \(80, K\) and \(80,\)"):
        propagate(graph, codes[1:], evidence)
    nan, infinite = float("nan"), float("inf")
    counts = ({"k": 0}, {"k": nan}, {"k": infinite}, {"k": 1.5}, {"steps": -1}, {"steps": nan}, {"steps": 0.5})
    for wrong in (*counts, {"strength": -1.0}, {"strength": nan}, {"strength": infinite}):
        with pytest.raises(SettingsError, match="graph: "):
            GraphSettings(**wrong)


def test_where_most_of_each_object_is_unknown_the_graph_fills_it_in() -> None:
    scene, truth = small_scenes.balls_on_a_table()
    camera = small_scenes.ring(1)[0]
    labels = small_scenes.true_labels(scene, truth, camera)
    columns = np.broadcast_to(np.arange(camera.width), labels.shape)
    for k in (1, 2, 3):
        labels[(labels == k) & (columns > np.quantile(columns[labels == k], 0.3))] = -1
    learner = EMLearner(scene, small_scenes.NUM_CLASSES)
    learner.observe(View.from_arrays(camera, labels))
    codes = learner.fit().codes_
    spread = propagate(graph_of(scene), codes, learner.evidence())
    balls = truth > 0
    before, after = ((c.argmax(axis=1) == truth)[balls] & c.any(axis=1)[balls] for c in (codes, spread))
    assert before.mean() < 0.9
    assert after.mean() > before.mean() + 0.05
