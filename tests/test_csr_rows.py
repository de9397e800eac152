"""Codes without their zeros stay the codes that they are."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from gsseg_core.csr_rows import CSRRows

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
