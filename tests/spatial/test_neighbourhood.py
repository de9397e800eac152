"""Mean codes of neighbours: the sparse rows, bit for bit, are those of a dense array that a readable twin writes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsseg_core import csr_rows
from gsseg_core.csr_rows import CSRRows
from gsseg_core.spatial.leaf_codes import CODE_UNIT
from gsseg_core.spatial.neighbourhood import Neighbours


def slow_mean_codes(known: Neighbours, codes: np.ndarray, weights: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Readable twin of `mean_codes`, (N, K)."""
    points, out = np.empty_like(known.tree.points.T), np.zeros_like(codes)
    points[known.tree.order] = known.tree.points.T
    units = np.rint(weights[:, None] * np.float32(1 / CODE_UNIT) * codes).astype(np.int64)
    for i in np.flatnonzero(wanted):
        x, y, z = (points - points[i]).T
        distances = x * x + y * y + z * z
        distances[i] = np.inf
        radius = np.sort(distances)[known.k - 1]
        inside, tied = distances < radius, distances == radius
        share = (known.k - inside.sum()) / tied.sum()
        masses = units[inside].sum(axis=0) + share * units[tied].sum(axis=0)
        total = np.add.accumulate(masses)[-1]  # class after class, as the kernel adds them
        if total > 0:
            out[i] = masses / total
    return out


def some_codes(rng: np.random.Generator, means: np.ndarray, num_classes: int, entries: int) -> np.ndarray:
    """Make a few entries a row, like those nearby or not, rows of none, and entries so small that they are nothing."""
    n = len(means)
    columns = rng.integers(0, num_classes, (n, entries))
    columns[:, 0] = np.floor(means[:, 0] + 50) % num_classes
    codes = np.zeros((n, num_classes), np.float32)
    np.add.at(codes, (np.arange(n)[:, None], columns), rng.dirichlet(np.full(entries, 0.3), n))
    codes[rng.random(codes.shape) < 0.1] *= np.float32(1e-9)
    codes[rng.random(n) < 0.3] = 0
    return np.minimum(codes, 1)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10**6), n=st.integers(2, 300), k=st.integers(1, 60), num_classes=st.integers(1, 600),
    entries=st.integers(1, 8), on_grid=st.booleans(), weighted=st.booleans(), share=st.sampled_from([0.0, 0.2, 1.0]),
)  # fmt: skip
def test_mean_codes_are_those_of_the_slow_twin_bit_for_bit(
    seed: int, n: int, k: int, num_classes: int, entries: int, on_grid: bool, weighted: bool, share: float
) -> None:
    rng = np.random.default_rng(seed)
    means = (rng.integers(-4, 5, (n, 3)) if on_grid else rng.normal(size=(n, 3))).astype(np.float32)
    codes = some_codes(rng, means, num_classes, entries)
    counted, wanted = codes.any(axis=1) & (rng.random(n) < 0.8), rng.random(n) < share
    weights = rng.random(n, np.float32) * counted if weighted else counted
    rows = CSRRows.from_dense(codes)
    rows.data[rng.random(len(rows.data)) < 0.1] = 0  # explicit zeros
    known = Neighbours.among(means, k)
    expected = CSRRows.from_dense(slow_mean_codes(known, rows.dense(num_classes), weights, wanted))
    for blocks in (csr_rows._AT_A_TIME, 7 * num_classes):
        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(csr_rows, "_AT_A_TIME", blocks)
            found = known.mean_codes(rows, weights, num_classes, None if share == 1 else wanted)
        for one, other in zip(found, expected, strict=True):
            np.testing.assert_array_equal(one, other, strict=True)
