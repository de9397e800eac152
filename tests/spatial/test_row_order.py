"""Gaussians along a curve through space, and rows in another order: each as the slow way has it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.lib import recfunctions
from small_scenes import balls_on_a_table

from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.spatial import row_order
from gsseg_core.spatial.row_order import (
    along_curve,
    curve_order,
    in_curve_order,
    reordered,
    rows_by_label,
    take_rows,
)


def cell_number(x: int, y: int, z: int) -> int:
    """Bit by bit, the slow way: the last bits of z, y, x are the last three of the number."""
    return sum((axis >> bit & 1) << (3 * bit + place) for bit in range(10) for place, axis in enumerate((x, y, z)))


@given(st.integers(0, 2**32 - 1))
def test_gaussians_follow_the_curve_from_cell_to_cell(seed: int) -> None:
    cells = np.random.default_rng(seed).integers(0, 1024, (500, 3))
    cells[:100], cells[100:200] = 0, 1023  # So many in the corners that these are the box.
    ordered = [cell_number(*cell) for cell in cells[curve_order(cells.astype(np.float32))].tolist()]
    assert ordered == sorted(ordered)


@given(st.integers(1, 300), st.integers(0, 99))
def test_each_gaussian_comes_once(count: int, seed: int) -> None:
    means = np.random.default_rng(seed).normal(size=(count, 3)).astype(np.float32)
    assert np.array_equal(np.sort(curve_order(means)), np.arange(count))


@pytest.mark.parametrize("far", [1.0, 1e30])
def test_those_at_one_place_stay_in_their_order_also_with_one_far_away(far: float) -> None:
    means = np.ones((500, 3), np.float32)
    means[3] = far
    expected = np.arange(500) if far == 1 else np.append(np.delete(np.arange(500), 3), 3)
    assert np.array_equal(curve_order(means), expected)


def test_neighbours_are_near_each_other_also_with_a_floater_far_away() -> None:
    means = np.random.default_rng(0).uniform(size=(20_000, 3)).astype(np.float32)
    means[7] = 1e9
    along = np.delete(means[curve_order(means)], np.flatnonzero(curve_order(means) == 7), axis=0)
    step = np.median(np.abs(np.diff(along, axis=0)).sum(axis=1))
    assert step < 0.1 * np.median(np.abs(np.diff(np.delete(means, 7, axis=0), axis=0)).sum(axis=1))


def test_the_order_of_a_scene_is_that_of_its_means_and_is_found_once() -> None:
    scene, _ = balls_on_a_table()
    order, places = found = along_curve(scene)
    np.testing.assert_array_equal(order, curve_order(scene.means))
    np.testing.assert_array_equal(order[places], np.arange(len(scene)))
    assert order.dtype == places.dtype == np.int32
    assert along_curve(scene) is found and along_curve(scene.subset(np.arange(9))) is not found


def test_a_scene_that_was_brought_into_the_order_is_not_ordered_again(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, _ = balls_on_a_table()
    ordered, places = in_curve_order(scene)
    np.testing.assert_array_equal(ordered.means[places], scene.means)
    assert ordered.digest == reordered(scene, along_curve(scene).order).digest
    monkeypatch.delattr(row_order, "curve_order")
    for own in along_curve(ordered):
        np.testing.assert_array_equal(own, np.arange(len(scene)))


@pytest.mark.parametrize("added", [None, "u1", "<f8"], ids=["floats", "odd bytes", "doubles"])
def test_a_scene_in_another_order_is_the_subset_in_that_order(added: str | None) -> None:
    scene, _ = balls_on_a_table()
    if added:
        more = recfunctions.append_fields(scene.vertices, "more", np.arange(len(scene)), added, usemask=False)
        scene = GaussianScene.from_vertices(more, None)
    order = np.random.default_rng(0).permutation(len(scene))
    found, expected = reordered(scene, order), scene.subset(order)
    for name in ("means", "quats", "scales", "opacities", "vertices"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    assert found.vertices.dtype == scene.vertices.dtype and found.digest == expected.digest


@given(st.integers(1, 40), st.integers(0, 100), st.integers(0, 99))
def test_rows_are_copied_as_numpy_does(width: int, count: int, seed: int) -> None:
    random = np.random.default_rng(seed)
    table = random.normal(size=(50, width)).astype(np.float32)
    chosen = random.integers(0, 50, count)
    np.testing.assert_array_equal(take_rows(table, chosen), table[chosen])


@pytest.mark.parametrize("dtype", [np.int16, np.int32, np.int64])
@given(st.lists(st.sampled_from([-(2**15), -2, -1, 0, 1, 7, 2**15 - 1, 2**15, 2**31 - 1]), max_size=40))
def test_rows_of_each_label_are_those_that_have_it(dtype: type, values: list[int]) -> None:
    labels = np.array([value for value in values if value <= np.iinfo(dtype).max], dtype)
    found = rows_by_label(labels)
    assert list(found) == np.unique(labels).tolist()
    for label, rows in found.items():
        np.testing.assert_array_equal(rows, np.flatnonzero(labels == label))
