"""Codes without their zeros stay the codes that they are."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from gsseg_core.csr_rows import Rows

codes = arrays.arrays(np.float32, st.tuples(st.integers(1, 20), st.integers(1, 6)), elements=st.sampled_from([0, 1, 2]))


@settings(deadline=None)
@given(codes, st.data())
def test_rows_are_taken_as_from_an_array(array: np.ndarray, data: st.DataObject) -> None:
    ids = np.array(data.draw(st.lists(st.integers(0, len(array) - 1))), np.int32)
    rows = Rows.of(array)
    np.testing.assert_array_equal(rows.dense(array.shape[1]), array)
    np.testing.assert_array_equal(rows.take(ids).dense(array.shape[1]), array[ids])
    places = rows.places(ids)
    np.testing.assert_array_equal(rows.values[places.values], rows.take(ids).values)
