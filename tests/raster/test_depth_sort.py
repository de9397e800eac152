from __future__ import annotations

import numpy as np
import pytest

from gsseg_core.raster.cpu import depth_sort
from gsseg_core.raster.cpu.depth_sort import sort_keys


@pytest.mark.parametrize("few", [0, 1 << 20])
@pytest.mark.parametrize("most", [1, 3, 300, 70_000, 2**32])
@pytest.mark.parametrize("count", [0, 1, 5_000])
def test_keys_are_sorted_whatever_digits_they_have_and_equal_ones_stay_in_their_order(
    count: int, most: int, few: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(depth_sort, "FEW", few)
    keys = np.random.default_rng(most).integers(0, most, count).astype(np.uint32)
    order, found = sort_keys(keys)
    np.testing.assert_array_equal(order, np.argsort(keys, kind="stable"))
    np.testing.assert_array_equal(found, np.sort(keys))
