"""The k-d tree and the k nearest others, against SciPy's, on points in general position and on degenerate ones."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from gsseg_core.spatial.kd_tree import LEAF, Tree, scaled
from gsseg_core.spatial.knn import nearest
from gsseg_core.spatial.neighbour_graph import Graph
from gsseg_core.spatial.neighbourhood import Neighbours

KINDS = ("random", "duplicates", "collinear", "one place", "two clusters")


def some_points(kind: str, count: int, seed: int) -> np.ndarray:
    """Points (count, 3) float32."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3))
    if kind == "duplicates":
        points = rng.integers(-2, 3, (count, 3)).astype(float)
    elif kind == "collinear":
        points = rng.normal(size=(count, 1)) * [1.0, -2.0, 0.5]
    elif kind == "one place":
        points[:] = points[0]
    elif kind == "two clusters":
        points = 1e-3 * points + 1e3 * rng.integers(0, 2, (count, 1))
    return points.astype(np.float32)


def of_others(points: np.ndarray, k: int) -> np.ndarray:
    """Distances (n, k) to the k nearest others, ascending, from SciPy in float64: the first found is the point."""
    return cKDTree(points.astype(float)).query(points.astype(float), k + 1)[0][:, 1:].reshape(len(points), k)


any_points = st.builds(
    some_points, st.sampled_from(KINDS), st.sampled_from([2, 3, LEAF, LEAF + 1, 100, 700]), st.integers(0, 10**6)
)


@given(points=any_points)
def test_a_tree_holds_every_point_once_inside_the_boxes_of_all_its_nodes(points: np.ndarray) -> None:
    tree = Tree.build(points)
    assert sorted(tree.order) == list(range(len(points)))
    np.testing.assert_array_equal(tree.points, points[tree.order].T)
    leaves = len(tree.boxes) // 2
    for node in range(1, 2 * leaves):
        level = 1 << (node.bit_length() - 1)
        first, last = ((node - level + i) * len(points) // level for i in (0, 1))
        here = tree.points[:, first:last]
        np.testing.assert_array_equal(tree.boxes[node], [*here.min(axis=1), *here.max(axis=1)])
        if node >= leaves:
            block = tree.blocks[node - leaves]
            assert 0 < last - first <= LEAF
            np.testing.assert_array_equal(block[:, : last - first], here)
            assert np.isinf(block[:, last - first :]).all()


@given(points=any_points, k=st.sampled_from([1, 2, 5, 16, 50]))
def test_the_nearest_others_are_as_far_as_scipy_finds_them(points: np.ndarray, k: int) -> None:
    k, tree = min(k, len(points) - 1), Tree.build(points)
    expected = of_others(points, k)
    radii, means, _ = nearest(tree, np.arange(len(points), dtype=np.int32), k, False)
    size = np.abs(points).max()
    np.testing.assert_allclose(np.sqrt(radii), expected[tree.order, -1], rtol=1e-5, atol=1e-6 * size)
    np.testing.assert_allclose(means, expected[tree.order].mean(axis=1), rtol=1e-5, atol=1e-6 * size)


@given(points=any_points, k=st.sampled_from([1, 3, 12]))
def test_the_nearest_are_listed_with_those_tied_for_the_last_place(points: np.ndarray, k: int) -> None:
    k, tree, places = min(k, len(points) - 1), Tree.build(points), np.arange(len(points), dtype=np.int32)
    radii, means, lists = nearest(tree, places, k, True)
    np.testing.assert_array_equal(radii, nearest(tree, places, k, False)[0])
    assert len(means) == 0
    found, near = np.split(lists.joined(), np.cumsum(lists.counts)[:-1]), tree.points.T
    for i in places:
        squared = ((near - near[i]) ** 2).sum(axis=1)
        squared[i] = np.inf
        within = np.flatnonzero(squared <= radii[i] * np.float32(1 + 1e-6))
        assert len(set(found[i])) == len(found[i]) and set(found[i]) <= set(within)
        assert min(len(within), 2 * k) >= len(found[i]) >= k


@given(points=any_points, seed=st.integers(0, 100))
def test_a_part_of_a_tree_is_a_tree_of_these_points(points: np.ndarray, seed: int) -> None:
    chosen = np.flatnonzero(np.random.default_rng(seed).random(len(points)) < 0.5)
    if len(chosen) < 2:
        return
    part = Tree.build(points).part(chosen)
    k = min(3, len(chosen) - 1)
    radii, *_ = nearest(part, np.arange(len(chosen), dtype=np.int32), k, False)
    expected = of_others(part.points.T, k)[:, -1]
    np.testing.assert_allclose(np.sqrt(radii), expected, rtol=1e-5, atol=1e-6 * np.abs(points).max())


@given(points=any_points, seed=st.integers(0, 100))
def test_distances_are_found_only_where_they_are_asked_for(points: np.ndarray, seed: int) -> None:
    wanted = np.random.default_rng(seed).random(len(points)) < 0.5
    some, every = (Neighbours.among(points, 4) for _ in range(2))
    some.look_for(wanted)
    every.look_for()
    np.testing.assert_array_equal(np.isnan(some.radii), ~wanted)
    np.testing.assert_array_equal(some.radii[wanted], every.radii[wanted])
    np.testing.assert_array_equal(some.distances[wanted], every.distances[wanted])


def test_the_graph_links_each_point_with_the_others_that_scipy_finds() -> None:
    points = some_points("random", 700, 0)
    graph, k = Graph.build(points, points, 6), 6
    found = graph.order[graph.indices.reshape(len(points), k)]
    expected = cKDTree(points).query(points, k + 1)[1][:, 1:]
    np.testing.assert_array_equal(np.sort(found), np.sort(expected[graph.order]))


@pytest.mark.parametrize("size", [1e-30, 1.0, 3e38])
def test_scaled_points_are_within_one_and_exact(size: float) -> None:
    points = (some_points("random", 50, 0) / 5 * size).astype(np.float32)
    inside = scaled(points)
    assert 0.5 <= np.abs(inside).max() <= 1
    ratio = np.unique((points / inside)[inside != 0].astype(np.float64))
    assert len(ratio) == 1 and np.frexp(ratio[0])[0] == 0.5
