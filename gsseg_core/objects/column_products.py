"""Products of columns, with the same bits whatever number of threads there is."""

from __future__ import annotations

import numpy as np

from gsseg_core.kernels.compiler import kernel


@kernel
def column_products(columns: np.ndarray, chosen: np.ndarray) -> np.ndarray:  # (S, R) float64, (r,) int64
    """Multiply some columns with each of all, (r, R): what is not zero is added up in the order of the rows."""
    products = np.zeros((len(chosen), columns.shape[1]))
    for i in range(len(chosen)):
        into = products[i]
        for s in range(columns.shape[0]):
            share, row = columns[s, chosen[i]], columns[s]
            if share != 0:
                for r in range(len(row)):
                    into[r] += share * row[r]
    return products
