"""Codes without their zeros stay the codes that they are."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from gsseg_core import csr_rows
from gsseg_core.csr_rows import CSRRows, largest

codes = arrays.arrays(np.float32, st.tuples(st.integers(1, 20), st.integers(1, 6)), elements=st.sampled_from([0, 1, 2]))


@given(codes, st.data())
def test_rows_are_taken_as_from_an_array(array: np.ndarray, data: st.DataObject) -> None:
    ids = np.array(data.draw(st.lists(st.integers(0, len(array) - 1))), np.int32)
    rows = CSRRows.from_dense(array)
    np.testing.assert_array_equal(rows.dense(array.shape[1]), array)
    np.testing.assert_array_equal(rows.take(ids).dense(array.shape[1]), array[ids])


@given(codes, st.data())
def test_rows_are_replaced_as_in_an_array(array: np.ndarray, data: st.DataObject) -> None:
    ids = np.array(data.draw(st.lists(st.integers(0, len(array) - 1), unique=True)), np.int32)
    rows, expected = CSRRows.from_dense(array), array.copy()
    expected[ids] *= 3
    chosen = rows.take(ids)
    replaced = rows.with_rows(ids, chosen.with_data(3 * chosen.data))
    np.testing.assert_array_equal(replaced.dense(array.shape[1]), expected)
    np.testing.assert_array_equal(rows.dense(array.shape[1]), array)


@given(codes, codes, st.data())
def test_rows_of_another_array_stand_in_place_of_some(
    array: np.ndarray, other: np.ndarray, data: st.DataObject
) -> None:
    wide = max(array.shape[1], other.shape[1])
    array, other = (np.pad(one, ((0, 0), (0, wide - one.shape[1]))) for one in (array, other))
    which = np.array(data.draw(st.lists(st.integers(-1, len(other) - 1), min_size=len(array), max_size=len(array))))
    expected = np.where(which[:, None] < 0, array, other[which])
    rows = CSRRows.from_dense(array)
    np.testing.assert_array_equal(rows.replaced(which, CSRRows.from_dense(other)).dense(wide), expected)
    np.testing.assert_array_equal(rows.dense(wide), array)
    np.testing.assert_array_equal(rows.only(which < 0).dense(wide), np.where(which[:, None] < 0, array, 0))


@given(codes, st.data())
def test_columns_that_become_one_are_added_up(array: np.ndarray, data: st.DataObject) -> None:
    to = np.array(data.draw(st.lists(st.integers(0, 4), min_size=array.shape[1], max_size=array.shape[1])), np.uint32)
    expected = np.zeros((len(array), 5), np.float32)
    for k, column in enumerate(to):
        expected[:, column] += array[:, k]
    rows = CSRRows.from_dense(array)
    moved = rows.in_columns(to[rows.indices])
    np.testing.assert_array_equal(moved.dense(5), expected)
    assert all((np.diff(moved.indices[a:b].astype(int)) > 0).all() for a, b in pairwise(moved.indptr))


@given(codes)
def test_the_largest_of_a_row_is_the_first_of_equal_ones(array: np.ndarray) -> None:
    entries, columns = largest(CSRRows.from_dense(array))
    np.testing.assert_array_equal(entries, array.max(axis=1))
    np.testing.assert_array_equal(columns, np.where(array.any(axis=1), array.argmax(axis=1), -1))


def test_an_array_is_written_out_in_blocks_that_take_little_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    array = np.random.default_rng(0).integers(0, 3, (50, 4)).astype(np.float32)
    for entries in (1, 7, 16, 1000):
        monkeypatch.setattr(csr_rows, "_AT_A_TIME", entries)
        blocks = list(CSRRows.from_dense(array).blocks(4))
        np.testing.assert_array_equal(np.concatenate(blocks), array)
        assert max(map(len, blocks)) <= max(entries // 4, 1)
