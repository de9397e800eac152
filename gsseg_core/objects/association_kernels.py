"""Kernels of association. Sparse matrices come as `indptr`, `indices` and `data`, as SciPy's `csr_matrix` has them."""

from __future__ import annotations

import numba as nb
import numpy as np

from gsseg_core.kernels.compiler import kernel

_BLOCKS = 64  # of rows, each the work of one thread


@kernel(parallel=True)
def rows_above(
    indptr: np.ndarray, indices: np.ndarray, data: np.ndarray,
    right_indptr: np.ndarray, right_indices: np.ndarray, right_data: np.ndarray,
    least: np.ndarray, group: np.ndarray, product: np.ndarray, which: np.ndarray, count: np.ndarray,
) -> None:  # fmt: skip
    """Write the entries that are kept to the front of each row of the product, and which columns they are of."""
    num_rows, num_columns = product.shape
    for block in nb.prange(_BLOCKS):
        row, touched = np.zeros(num_columns, np.float32), np.empty(num_columns, np.int32)
        for r in range(num_rows * block // _BLOCKS, num_rows * (block + 1) // _BLOCKS):
            many, found = 0, 0
            for j in range(indptr[r], indptr[r + 1]):
                i, weight = indices[j], data[j]
                for k in range(right_indptr[i], right_indptr[i + 1]):
                    c, term = right_indices[k], weight * right_data[k]
                    if row[c] == 0 and term > 0:
                        touched[many] = c
                        many += 1
                    row[c] += term
            for c in touched[:many]:
                if row[c] > least[r, group[c]]:
                    product[r, found], which[r, found] = row[c], c
                    found += 1
                row[c] = 0
            count[r] = found


@kernel(parallel=True)
def pack(
    product: np.ndarray, which: np.ndarray, count: np.ndarray, ends: np.ndarray, values: np.ndarray, columns: np.ndarray
) -> None:
    """Put the entries of all rows behind each other."""
    for r in nb.prange(len(count)):
        first = ends[r] - count[r]
        for k in range(count[r]):
            values[first + k], columns[first + k] = product[r, k], which[r, k]


@kernel(parallel=True, fastmath={"contract", "reassoc"})
def dots_of_pairs(first: np.ndarray, second: np.ndarray, rows: np.ndarray) -> np.ndarray:  # (P,), (P,), (C, V)
    """Multiply pairs of rows, (P,) float64."""
    out = np.empty(len(first))
    for p in nb.prange(len(first)):
        a, b, total = rows[first[p]], rows[second[p]], 0.0
        for v in range(len(a)):
            total += a[v] * b[v]
        out[p] = total
    return out


@kernel(parallel=True)
def add_common(
    indptr: np.ndarray, gaussians: np.ndarray, weights: np.ndarray,
    profile_indptr: np.ndarray, objects: np.ndarray, profile: np.ndarray,
    total: np.ndarray, common: np.ndarray, known: np.ndarray,
) -> None:  # fmt: skip
    """Share out the weight of each segment on a Gaussian to the objects there, by their weights on it."""
    for a in nb.prange(len(known)):
        for j in range(indptr[a], indptr[a + 1]):
            m = gaussians[j]
            if total[m] > 0:
                known[a] += weights[j]
                for z in range(profile_indptr[m], profile_indptr[m + 1]):
                    common[a, objects[z]] += weights[j] * (profile[z] / total[m])


def call_all() -> None:
    """Call each kernel with arrays of the types that association has for it, so that it is compiled."""
    indptr, none, one = np.zeros(2, np.int32), np.zeros(0, np.int32), np.zeros(1, np.int64)
    small, row = np.zeros(0, np.float32), np.zeros((1, 1), np.float32)
    rows_above(indptr, none, small, indptr, none, small, row, one.astype(np.int32), row, row.astype(np.int32), one)
    pack(row, row.astype(np.int32), one, one, small, none)
    dots_of_pairs(one[:0], one[:0], row)
    add_common(indptr, none, small, indptr, none, small.astype(np.float64), np.zeros(1), np.zeros((1, 1)), np.zeros(1))
