from __future__ import annotations

import numpy as np
import pytest

from gsseg_core.raster.cpu import depth_sort
from gsseg_core.raster.cpu.depth_sort import sort_keys


@pytest.mark.parametrize("bits", [3, 8, 13])
@pytest.mark.parametrize("most", [1, 3, 300, 70_000, 2**32])
@pytest.mark.parametrize("count", [0, 1, 5_000])
@pytest.mark.parametrize("far", [False, True])
def test_keys_are_sorted_whatever_digits_they_have_and_equal_ones_stay_in_their_order(
    far: bool, count: int, most: int, bits: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(depth_sort, "DIGIT_BITS", (bits, bits))
    least = (2**32 - most) * far
    keys = np.random.default_rng(most).integers(least, least + most, count).astype(np.uint32)
    order, found = sort_keys(keys)
    np.testing.assert_array_equal(order, np.argsort(keys, kind="stable"))
    np.testing.assert_array_equal(found, np.sort(keys))
