"""The Gaussians of each label of a mask straight from the sums of its entries, where no observation of it is needed."""

from __future__ import annotations

import numba as nb
import numpy as np

from gsseg_core.csr_rows import starts
from gsseg_core.kernels.compiler import kernel
from gsseg_core.raster.cpu.lifting import Labels, Lifted
from gsseg_core.raster.cpu.tiling import Tiles
from gsseg_core.raster.observation import LabelWeights

_PARTS = 2048


def label_weights(ids: np.ndarray, tiles: Tiles, lifted: Lifted) -> LabelWeights:  # (M,) int32, ascending
    """Add up the sums of entries by label and Gaussian, bit for bit as `label_pairs.number_pairs` does."""
    begins = starts(lifted.counts[:, 3])
    rows, sums = _list_sums(tiles, lifted.labels, lifted.slot_start, lifted.sums, begins)
    start, rows, weights = _add_up(rows, sums, len(ids), len(lifted.classes))
    return LabelWeights(lifted.classes, start, ids[rows], weights)


@kernel(parallel=True)
def _list_sums(
    tiles: Tiles, labels: Labels, slot_start: np.ndarray, sums: np.ndarray,  # of `Lifted`
    begins: np.ndarray,  # (T + 1,) where the sums above zero of each tile go
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """List the sums above zero, tile after tile: row of the table, (Z,) int32; label and sum, (Z, 2) float32."""
    rows, listed = np.empty(begins[-1], np.int32), np.empty((begins[-1], 2), np.float32)
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
    rows: np.ndarray, listed: np.ndarray, num_rows: int, num_labels: int,  # (Z,), (Z, 2)
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Add up what is listed of one label and row: where each label begins, (L + 1,); rows, int32, and weights."""
    shift = 0
    while num_rows >> shift >= _PARTS:
        shift += 1
    parts, begins = np.zeros(_PARTS + 1, np.int64), np.zeros(num_labels + 1, np.int64)
    for i in range(len(rows)):
        parts[(rows[i] >> shift) + 1] += 1
        begins[int(listed[i, 0]) + 1] += 1
    parts, begins = np.cumsum(parts), np.cumsum(begins)
    place, near, near_listed = parts[:-1].copy(), np.empty_like(rows), np.empty_like(listed)
    for i in range(len(rows)):
        n = place[rows[i] >> shift]
        place[rows[i] >> shift] = n + 1
        near[n], near_listed[n, 0], near_listed[n, 1] = rows[i], listed[i, 0], listed[i, 1]
    ends, who, weights = begins[:-1].copy(), np.empty_like(rows), np.empty(len(rows), np.float32)
    counts, order = np.empty(1 << shift, np.int64), np.empty(np.diff(parts).max(), np.int64)
    for part in range(_PARTS):
        counts[:] = 0
        for i in range(parts[part], parts[part + 1]):
            counts[near[i] & ((1 << shift) - 1)] += 1
        n = 0
        for k in range(len(counts)):
            n, counts[k] = n + counts[k], n
        for i in range(parts[part], parts[part + 1]):
            k = near[i] & ((1 << shift) - 1)
            order[counts[k]] = i
            counts[k] += 1
        for j in range(parts[part + 1] - parts[part]):
            i = order[j]
            label = int(near_listed[i, 0])
            last = max(ends[label] - 1, 0)
            again = (ends[label] > begins[label]) & (who[last] == near[i])  # no branch: it would be guessed badly
            n = ends[label] - again
            who[n], weights[n] = near[i], (weights[last] if again else np.float32(0)) + near_listed[i, 1]
            ends[label] = n + 1
    start, n = np.zeros(num_labels + 1, np.int64), 0
    for label in range(num_labels):
        for i in range(begins[label], ends[label]):
            who[n], weights[n] = who[i], weights[i]
            n += 1
        start[label + 1] = n
    return start, who[:n].copy(), weights[:n].copy()
