"""Hulls of points in space, and rectangles along the edges of those in a plane, are those that Qhull finds."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from gsseg_core.objects.hulls import hull_faces, rectangles_around

CUBE = np.array(list(product(range(5), repeat=3)), np.float64)
TURN = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]


def require_closed(faces: np.ndarray) -> None:
    """Each edge has a face on either side, which run along it in opposite directions."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).tolist()
    assert sorted(edges) == sorted([b, a] for a, b in edges)


def volume(points: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (points[faces[:, i]] - points.mean(axis=0) for i in range(3))
    return float(np.einsum("fi,fi->", a, np.cross(b, c))) / 6


@given(st.integers(0, 2**31), st.integers(4, 300), st.floats(1e-3, 1e3), st.floats(1e-6, 1))
def test_the_faces_are_those_of_the_hull(seed: int, count: int, scale: float, flatness: float) -> None:
    points = scale * np.random.default_rng(seed).normal(size=(count, 3)) * [1, 1, flatness] + scale
    faces, hull = hull_faces(points), ConvexHull(points)
    assert sorted(sorted(face) for face in faces.tolist()) == sorted(sorted(face) for face in hull.simplices.tolist())
    require_closed(faces)
    assert volume(points, faces) == pytest.approx(hull.volume)


@pytest.mark.parametrize("points", [CUBE, np.concatenate([CUBE, CUBE]) @ TURN], ids=["upright", "turned, twice"])
def test_points_within_sides_and_edges_leave_the_hull_closed(points: np.ndarray) -> None:
    faces = hull_faces(points)
    require_closed(faces)
    assert volume(points, faces) == pytest.approx(4**3)


@given(st.integers(0, 2**31), st.integers(4, 60), st.integers(2, 4))
def test_points_of_a_coarse_grid_have_the_volume_of_their_hull(seed: int, count: int, size: int) -> None:
    points = np.random.default_rng(seed).integers(0, size, (count, 3)).astype(np.float64)
    points[:4] = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
    assert volume(points, hull_faces(points)) == pytest.approx(ConvexHull(points).volume)


@pytest.mark.parametrize(
    "points",
    [np.zeros((4, 3)), np.ones((1, 3)), np.outer(np.arange(9.0), [1, 2, 3]), CUBE[:25], CUBE[:25] @ TURN],
    ids=["one place", "one point", "a line", "a plane", "a turned plane"],
)
def test_what_is_flat_has_no_faces(points: np.ndarray) -> None:
    assert len(hull_faces(points)) == 0


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
