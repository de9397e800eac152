"""Hulls of points in space are those that Qhull finds."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from gsseg_core.objects.convex_hull import hull_faces

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
