"""Rectangles along the edges of a hull are those of the hull that Qhull finds."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from gsseg_core.objects.rectangles import rectangles_around


def in_order(points: np.ndarray) -> np.ndarray:
    return points[np.lexsort(points.T[::-1])]


def slow_rectangles(points: np.ndarray) -> list[tuple[float, ...]]:
    """Direction, length and width of the rectangle along each edge of the hull, from all points."""
    hull = points[ConvexHull(points).vertices]  # counterclockwise
    found = []
    for start, end in zip(hull, np.roll(hull, -1, axis=0), strict=True):
        x, y = (end - start) / np.linalg.norm(end - start)
        found.append((x, y, np.ptp(points @ [x, y]), np.ptp(points @ [-y, x])))
    return sorted(found)


@given(st.integers(0, 2**31), st.integers(3, 300), st.floats(1e-3, 1e3))
def test_the_rectangles_are_those_along_the_edges_of_the_hull(seed: int, count: int, scale: float) -> None:
    points = scale * np.random.default_rng(seed).normal(size=(count, 2))
    directions, lengths, widths = rectangles_around(in_order(points))
    found = sorted(zip(*directions.T, lengths, widths, strict=True))
    np.testing.assert_allclose(found, slow_rectangles(points), rtol=1e-9, atol=1e-9 * scale)


def test_points_along_an_edge_and_points_that_come_twice_are_no_corners() -> None:
    grid = np.stack(np.meshgrid(np.arange(4.0), np.arange(3.0)), axis=-1).reshape(-1, 2)
    directions, lengths, widths = rectangles_around(in_order(np.concatenate([grid, grid])))
    np.testing.assert_array_equal(directions, [[1, 0], [0, 1], [-1, 0], [0, -1]])
    np.testing.assert_array_equal(lengths, [3, 2, 3, 2])
    np.testing.assert_array_equal(widths, [2, 3, 2, 3])


@given(st.integers(0, 2**31), st.integers(2, 50))
def test_points_on_a_line_have_rectangles_without_area(seed: int, count: int) -> None:
    points = np.random.default_rng(seed).integers(-9, 10, count)[:, None] * np.array([[1.0, 2.0]])
    points[:2] = [[-10, -20], [10, 20]]
    _, lengths, widths = rectangles_around(in_order(points))
    np.testing.assert_allclose(lengths, 20 * 5**0.5)
    np.testing.assert_allclose(widths, 0, atol=1e-12)
