"""Kernels of objects that stand alone and their slow twins; what they make of a view is in `tests/objects`."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gsseg_core.raster.cpu.objects_alone import sums_by_gaussian


@given(seed=st.integers(0, 10**6))
def test_sums_by_gaussian_are_those_of_bincount_bit_for_bit(seed: int) -> None:
    rng = np.random.default_rng(seed)
    entries = rng.integers(0, 40, 300).astype(np.int32)
    weights = np.where(rng.random(300) < 0.5, 10 ** rng.uniform(-9, 9, 300), 0).astype(np.float32)
    np.testing.assert_array_equal(sums_by_gaussian(entries, weights, 50), np.bincount(entries, weights, 50))
