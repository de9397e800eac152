"""The Gaussians of each label of a mask straight from the sums of its entries, where no observation of it is needed."""

from __future__ import annotations

import numba as nb
import numpy as np

from gsseg_core.csr_rows import starts
from gsseg_core.kernels.compiler import kernel
from gsseg_core.raster.cpu.depth_sort import sort_keys
from gsseg_core.raster.cpu.lifting import Labels, Lifted
from gsseg_core.raster.cpu.tiling import Tiles
from gsseg_core.raster.observation import LabelWeights
from gsseg_core.simd import AHEAD, prefetch


def label_weights(ids: np.ndarray, tiles: Tiles, lifted: Lifted) -> LabelWeights:  # (M,) int32, ascending
    """Add up the sums of entries by label and Gaussian, bit for bit as `label_pairs.number_pairs` does."""
    begins = starts(lifted.counts[:, 3])
    rows, sums = _list_sums(tiles, lifted.labels, lifted.slot_start, lifted.sums, begins)
    order, sorted_rows = sort_keys(rows)
    start, rows, weights = _add_up(order, sorted_rows, sums, len(lifted.classes))
    return LabelWeights(lifted.classes, start, ids[rows], weights)


@kernel(parallel=True)
def _list_sums(
    tiles: Tiles, labels: Labels, slot_start: np.ndarray, sums: np.ndarray,  # of `Lifted`
    begins: np.ndarray,  # (T + 1,) where the sums above zero of each tile go
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """List the sums above zero, tile after tile: row of the table, (Z,) uint32; label and sum, (Z, 2) float32."""
    rows, listed = np.empty(begins[-1], np.uint32), np.empty((begins[-1], 2), np.float32)
    for tile in nb.prange(len(begins) - 1):
        here = labels.present[labels.start[tile] : labels.start[tile + 1]]
        n, slot, e = begins[tile], slot_start[tile], tiles.start[tile]
        while n < begins[tile + 1]:
            for j in range(len(here)):
                if sums[slot + j] > 0:
                    rows[n], listed[n, 0], listed[n, 1] = tiles.entries[e], here[j], sums[slot + j]
                    n += 1
            slot, e = slot + len(here), e + 1
    return rows, listed


@kernel
def _add_up(
    order: np.ndarray, rows: np.ndarray, listed: np.ndarray, num_labels: int,  # (Z,), (Z,) ascending, (Z, 2)
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Add up what is listed of one label and row; `listed[order[i]]` is of `rows[i]`.

    Returns where each label begins, (L + 1,) int64; its rows, (P,) int32, ascending; and their weights, (P,) float32.
    """
    begins = np.zeros(num_labels + 1, np.int64)
    for i in range(len(listed)):
        begins[int(listed[i, 0]) + 1] += 1
    begins = np.cumsum(begins)
    ends, who, weights = begins[:-1].copy(), np.empty(len(rows), np.int32), np.empty(len(rows), np.float32)
    for i in range(len(rows)):
        prefetch(listed, order[min(i + AHEAD, len(rows) - 1)])
        label, weight = int(listed[order[i], 0]), listed[order[i], 1]
        n = ends[label]
        if n > begins[label] and who[n - 1] == rows[i]:
            weights[n - 1] += weight
        else:
            who[n], weights[n] = rows[i], weight
            ends[label] = n + 1
    start, n = np.zeros(num_labels + 1, np.int64), 0
    for label in range(num_labels):
        for i in range(begins[label], ends[label]):
            who[n], weights[n] = who[i], weights[i]
            n += 1
        start[label + 1] = n
    return start, who[:n].copy(), weights[:n].copy()
