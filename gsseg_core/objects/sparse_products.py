"""Sums over the rows of sparse matrices, and products of which only large entries matter."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from gsseg_core.objects.association_kernels import pack, rows_above

_SCRATCH = 1 << 25  # entries of a product that there is room for at a time


def grouping(number: np.ndarray) -> sparse.csr_matrix:  # (n,)
    """Ones that add up the rows of each group, (groups, n) float32."""
    shape = int(number.max(initial=-1)) + 1, len(number)
    return sparse.csr_matrix((np.ones(len(number), np.float32), (number, np.arange(len(number)))), shape=shape)


def sums(matrix: sparse.csr_matrix, axis: int) -> np.ndarray:
    """Sum over an axis, float64."""
    return np.asarray(matrix.sum(axis=axis, dtype=np.float64)).ravel()


def product_above(
    left: sparse.csr_matrix,  # (R, I) float32
    right: sparse.csr_matrix,  # (I, C) float32, all entries of both at least 0
    least: np.ndarray,  # (R, G) float32, at least 0
    group: np.ndarray,  # (C,): in [0, G)
) -> sparse.csr_matrix:
    """Multiply, and keep the entries (r, c) above least[r, group[c]]: (R, C) float32."""
    shape, group = (left.shape[0], right.shape[1]), np.ascontiguousarray(group, np.int32)
    least, at_once = np.ascontiguousarray(least, np.float32), max(_SCRATCH // max(shape[1], 1), 1)
    counts, columns, values = [np.zeros(1, np.int64)], [np.zeros(0, np.int32)], [np.zeros(0, np.float32)]
    for k in range(0, shape[0], at_once):
        part = left[k : k + at_once]
        product = np.empty((part.shape[0], shape[1]), np.float32)  # its rows are filled up to where they end
        which, count = np.empty(product.shape, np.int32), np.empty(len(product), np.int64)
        rows_above(
            part.indptr, part.indices, part.data, right.indptr, right.indices, right.data, least[k : k + at_once],
            group, product, which, count,
        )  # fmt: skip
        ends = np.cumsum(count)
        columns.append(np.empty(ends[-1], np.int32))
        values.append(np.empty(ends[-1], np.float32))
        pack(product, which, count, ends, values[-1], columns[-1])
        counts.append(count)
    entries = np.concatenate(values), np.concatenate(columns), np.cumsum(np.concatenate(counts))
    return sparse.csr_matrix(entries, shape=shape)
