"""Cells of the ground that Gaussians stand above, against a plain look at every point of every ellipsoid."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsseg_core.errors import SettingsError
from gsseg_core.objects.occupied_cells import occupied_cells
from gsseg_core.scene.quaternions import rotations

SIZE = 0.05


def ellipsoids(seed: int, count: int, largest: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(count, 4))
    turns = rotations(quats / np.linalg.norm(quats, axis=1, keepdims=True))
    return rng.uniform(-1, 1, (count, 3)), turns * rng.uniform(0, largest, (count, 1, 3))


def inside(points: np.ndarray, mean: np.ndarray, half_axes: np.ndarray) -> np.ndarray:
    """Whether points (n, 3) lie in an ellipsoid."""
    lengths = np.linalg.norm(half_axes, axis=0)
    along = (points - mean) @ (half_axes / lengths) / lengths
    return (along**2).sum(axis=1) <= 1 + 1e-6


def cells_of(points: np.ndarray) -> set[tuple[int, int]]:
    return set(map(tuple, np.floor(points[:, :2] / SIZE).astype(int).tolist()))


@given(st.integers(0, 10_000), st.sampled_from([0.01, 0.1, 0.4]))
def test_what_is_occupied_is_in_an_ellipsoid_and_between_the_heights(seed: int, largest: float) -> None:
    means, half_axes = ellipsoids(seed, 5, largest)
    cells = occupied_cells(means, half_axes, SIZE, -0.3, 0.5)
    assert cells.dtype == np.float32 and ((cells[:, 2] >= -0.3 - 1e-6) & (cells[:, 2] <= 0.5 + 1e-6)).all()
    # The point itself is anywhere in its cell; no ellipsoid reaches beyond its longest half axis.
    reach = np.linalg.norm(half_axes, axis=1).max(axis=1) + SIZE
    assert all((np.linalg.norm(cell - means, axis=1) <= reach).any() for cell in cells)
    assert len(cells_of(cells)) == len(cells), "each cell once"


@given(st.integers(0, 10_000))
def test_every_cell_whose_middle_is_well_inside_an_ellipsoid_is_occupied(seed: int) -> None:
    means, half_axes = ellipsoids(seed, 3, 0.6)
    found = cells_of(occupied_cells(means, half_axes, SIZE, -9, 9))
    rng = np.random.default_rng(seed)
    for mean, half in zip(means, half_axes, strict=True):
        points = mean + rng.uniform(-0.6, 0.6, (300, 3))
        middles = np.column_stack([(np.floor(points[:, :2] / SIZE) + 0.5) * SIZE, points[:, 2]])
        shifts = SIZE * np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
        deep = np.all([inside(middles + shift, mean, half) for shift in shifts], axis=0)
        assert cells_of(middles[deep]) <= found


def test_a_wall_of_one_wide_gaussian_has_no_gap() -> None:
    wall = np.diag([1.5, 0.01, 1.2])[None]
    cells = occupied_cells(np.array([[0.0, 0.02, 1.0]]), wall, SIZE, 0.1, 1.8)
    along = np.unique(np.floor(cells[:, 0] / SIZE).astype(int))
    assert (np.diff(along) == 1).all() and along[0] <= -26 and along[-1] >= 25
    assert np.unique(cells[:, 1]) == pytest.approx(0.025)


def test_a_wall_has_no_gap_however_many_cells_it_is_wide() -> None:
    wall = np.diag([5.0, 0.01, 5.0])[None]
    cells = occupied_cells(np.array([[0.0, 0.02, 1.0]]), wall, SIZE, 0.1, 1.8)
    along = np.unique(np.floor(cells[:, 0] / SIZE).astype(int))
    assert (np.diff(along) == 1).all() and along[0] <= -95 and along[-1] >= 94


@pytest.mark.parametrize("size", [0.0, -0.05, float("nan"), float("inf")])
def test_cells_of_no_size_are_refused(size: float) -> None:
    with pytest.raises(SettingsError, match=r"size of a cell is .*; expected a number above 0"):
        occupied_cells(np.zeros((1, 3)), np.eye(3)[None], size, 0.0, 1.0)


def test_what_is_too_low_or_too_high_does_not_count() -> None:
    means = np.array([[0.0, 0, 0.01], [1.0, 0, 0.5], [2.0, 0, 2.5]])
    cells = occupied_cells(means, np.full((3, 3, 3), 1e-4), SIZE, 0.1, 2.0)
    np.testing.assert_allclose(cells, [[1.025, 0.025, 0.5]], atol=1e-3)


def test_no_gaussians_occupy_nothing() -> None:
    assert occupied_cells(np.empty((0, 3)), np.empty((0, 3, 3)), SIZE, 0, 1).shape == (0, 3)


def test_a_huge_gaussian_takes_no_more_memory_than_others() -> None:
    cells = occupied_cells(np.zeros((1, 3)), np.diag([1e4, 1e4, 1e4])[None], SIZE, -1e9, 1e9)
    assert 0 < len(cells) <= 64**2


def test_an_endless_gaussian_reaches_as_far_to_one_side_as_to_the_other() -> None:
    cells = occupied_cells(np.zeros((1, 3)), np.diag([1e30, 0.1, 0.1])[None], SIZE, -1, 1)
    assert [cells[:, 0].min(), cells[:, 0].max()] == pytest.approx([-1e30, 1e30], rel=0.1)
