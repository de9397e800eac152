"""Products with the weight matrix W of one view, tile by tile.

They are W q, W^T r, and both restricted to the pixels' own labels.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from gsseg_core.blend import blend_tile
from gsseg_core.lanes import add_product, add_scaled, add_scaled_product, dot, take_sum
from gsseg_core.tiles import TILE

_FAST = {"contract", "nnan", "nsz", "reassoc"}

_TINY = np.float32(1e-30)

CHUNK = 32
"""Channels that one pass of the general adjoint sums at once; bounds its memory at entries x 32 float32."""


@nb.njit(inline="always")
def _scratch(entries: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    # Sized for the worst case; pages that no record reaches are never touched.
    return (
        np.empty((TILE, TILE), np.float32),
        np.empty((TILE * entries, TILE), np.float32),
        np.empty(TILE * entries, np.uint8),
        np.empty(entries, np.int32),
    )


@nb.njit(parallel=True, nogil=True, cache=True)
def render(
    columns: int,
    table: np.ndarray,  # (M, 8)
    start: np.ndarray,  # (T + 1,)
    entries: np.ndarray,  # (E,)
    codes: np.ndarray,  # (M, K) float32
    out: np.ndarray,  # (H, W, K) float32 out
    left_over: np.ndarray,  # (H, W) float32 out: final transmittance
) -> None:
    """Blend codes into the image, W q."""
    height, width, channels = out.shape
    for tile in nb.prange(start.shape[0] - 1):
        first, last = start[tile], start[tile + 1]
        rays, weights, rows, ends = _scratch(last - first)
        used = blend_tile(tile, columns, width, height, table, entries, first, last, rays, weights, rows, ends)
        block = np.zeros((TILE, channels, TILE), np.float32)
        n = 0
        for e in range(used):
            g = entries[first + e]
            for i in range(n, ends[e]):
                for k in range(channels):
                    add_scaled(block, rows[i] * channels + k, weights, i, codes[g, k])
            n = ends[e]
        left, top = (tile % columns) * TILE, (tile // columns) * TILE
        for r in range(min(TILE, height - top)):
            for c in range(min(TILE, width - left)):
                left_over[top + r, left + c] = rays[r, c]
                for k in range(channels):
                    out[top + r, left + c, k] = block[r, k, c]


@nb.njit(parallel=True, nogil=True, cache=True, fastmath=_FAST)
def adjoint_entries(
    columns: int,
    table: np.ndarray,  # (M, 8)
    start: np.ndarray,  # (T + 1,)
    entries: np.ndarray,  # (E,)
    residual: np.ndarray,  # (H, W, C) float32, C <= CHUNK
    sums: np.ndarray,  # (E, C) float32 out
) -> None:
    """Sum weight times residual over the pixels of each entry: the part of W^T r that one tile adds to a Gaussian."""
    height, width, channels = residual.shape
    for tile in nb.prange(start.shape[0] - 1):
        first, last = start[tile], start[tile + 1]
        rays, weights, rows, ends = _scratch(last - first)
        used = blend_tile(tile, columns, width, height, table, entries, first, last, rays, weights, rows, ends)
        left, top = (tile % columns) * TILE, (tile // columns) * TILE
        block = np.zeros((TILE, channels, TILE), np.float32)
        for r in range(min(TILE, height - top)):
            for c in range(min(TILE, width - left)):
                for k in range(channels):
                    block[r, k, c] = residual[top + r, left + c, k]
        sums[first:last] = 0.0
        n = 0
        for e in range(used):
            for i in range(n, ends[e]):
                for k in range(channels):
                    sums[first + e, k] += dot(block, rows[i] * channels + k, weights, i)
            n = ends[e]


@nb.njit(parallel=True, nogil=True, cache=True)
def reduce_entries(
    gaussian_start: np.ndarray,  # (M + 1,)
    gaussian_entries: np.ndarray,  # (E,)
    sums: np.ndarray,  # (E, C)
    out: np.ndarray,  # (M, C) float32 out
) -> None:
    """Add up each Gaussian's entries, in tile order."""
    for g in nb.prange(out.shape[0]):
        out[g] = 0.0
        for i in range(gaussian_start[g], gaussian_start[g + 1]):
            e = gaussian_entries[i]
            for k in range(out.shape[1]):
                out[g, k] += sums[e, k]


@nb.njit(nogil=True, cache=True)
def tile_labels(
    labels: np.ndarray,  # (H, W) int32, negative = unknown
    columns: int,
    rows: int,
    num_labels: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Give each tile's labels numbers of its own.

    Returns
    -------
    start : (T + 1,) int64
    present : (start[-1],) int32
        Labels of tile t are present[start[t]:start[t + 1]].
    slots : (T, 16, 16) int16
        Position of each pixel's label among those of its tile, -1 where unknown or outside.
    """
    height, width = labels.shape
    start = np.zeros(columns * rows + 1, np.int64)
    present = np.empty(height * width, np.int32)
    slots = np.full((columns * rows, TILE, TILE), -1, np.int16)
    slot_of = np.full(num_labels, -1, np.int16)
    n = 0
    for tile in range(columns * rows):
        left, top = (tile % columns) * TILE, (tile // columns) * TILE
        for r in range(min(TILE, height - top)):
            for c in range(min(TILE, width - left)):
                label = labels[top + r, left + c]
                if label < 0:
                    continue
                if slot_of[label] < 0:
                    slot_of[label] = n - start[tile]
                    present[n] = label
                    n += 1
                slots[tile, r, c] = slot_of[label]
        for i in range(start[tile], n):
            slot_of[present[i]] = -1
        start[tile + 1] = n
    return start, present[:n].copy(), slots


@nb.njit(parallel=True, nogil=True, cache=True, fastmath=_FAST, error_model="numpy")
def labelled(
    columns: int,
    width: int,
    height: int,
    table: np.ndarray,  # (M, 8)
    start: np.ndarray,  # (T + 1,)
    entries: np.ndarray,  # (E,)
    label_start: np.ndarray,  # (T + 1,)
    present: np.ndarray,
    slots: np.ndarray,  # (T, 16, 16)
    codes: np.ndarray,  # (M, L) float32
    rest: np.ndarray,  # (L,) float32: what the transmittance left over counts for each label
    divide: bool,
    slot_start: np.ndarray,  # (T + 1,) where each tile's sums begin
    logs: np.ndarray,  # (T,) float64 out: sum of log likelihood, (W codes)[p, y_p] + T_end rest[y_p]
    left_over: np.ndarray,  # like present, float64 out: sum of T_end / likelihood by label
    sums: np.ndarray,  # (slot_start[-1],) float32 out: per entry and label, sum of w, or of w / likelihood
) -> None:
    """Sum each Gaussian's weights by the labels of the pixels that it made, as they are or over the likelihood."""
    for tile in nb.prange(start.shape[0] - 1):
        first, last = start[tile], start[tile + 1]
        labels = present[label_start[tile] : label_start[tile + 1]]
        many = labels.shape[0]
        logs[tile] = 0.0
        if many == 0:
            continue
        rays, weights, rows, ends = _scratch(last - first)
        used = blend_tile(tile, columns, width, height, table, entries, first, last, rays, weights, rows, ends)

        # Per row, the slots that occur in it and where: most rows hold one label, so one product a record.
        counts = np.zeros(TILE, np.int64)
        slot = np.empty((TILE, TILE), np.int64)
        where = np.zeros((TILE, TILE, TILE), np.float32)
        for r in range(TILE):
            for c in range(TILE):
                s = slots[tile, r, c]
                if s < 0:
                    continue
                j = 0
                while j < counts[r] and slot[r, j] != s:
                    j += 1
                if j == counts[r]:
                    slot[r, j] = s
                    counts[r] += 1
                where[r, j, c] = 1.0

        if divide:
            value = np.zeros((TILE, TILE), np.float32)
            _blend_labels(used, entries[first:last], ends, rows, weights, counts, slot, where, labels, codes, value)
            spare = left_over[label_start[tile] : label_start[tile + 1]]
            spare[:] = 0.0
            logs[tile] = _invert(counts, slot, where, rest[labels], rays, value, spare)
        _sum_labels(used, ends, rows, weights, counts, slot, where, many, sums[slot_start[tile] : slot_start[tile + 1]])


@nb.njit(fastmath=_FAST)
def _blend_labels(
    used: int,
    entries: np.ndarray,  # (E_t,) of this tile
    ends: np.ndarray,  # (E_t,)
    rows: np.ndarray,  # (R,)
    weights: np.ndarray,  # (R, 16)
    counts: np.ndarray,  # (16,) labels in each row
    slot: np.ndarray,  # (16, 16)
    where: np.ndarray,  # (16, 16, 16) 1 where a row's pixel has its j-th label
    labels: np.ndarray,  # (L_t,)
    codes: np.ndarray,  # (M, L)
    value: np.ndarray,  # (16, 16) out
) -> None:
    n = 0
    for e in range(used):
        code_of = codes[entries[e]]
        for i in range(n, ends[e]):
            r = np.int64(rows[i])
            if counts[r] == 1:  # Pixels of the row without a label get a value too, which nobody reads.
                add_scaled(value, r, weights, i, code_of[labels[slot[r, 0]]])
                continue
            for j in range(counts[r]):
                add_scaled_product(value, r, weights, i, where, r * TILE + j, code_of[labels[slot[r, j]]])
        n = ends[e]


@nb.njit(error_model="numpy")
def _invert(
    counts: np.ndarray,  # (16,)
    slot: np.ndarray,  # (16, 16)
    where: np.ndarray,  # (16, 16, 16) in: 1 where a row's pixel has its j-th label; out: 1 / likelihood there
    rest: np.ndarray,  # (L_t,)
    rays: np.ndarray,  # (16, 16) final transmittance
    value: np.ndarray,  # (16, 16) W codes
    spare: np.ndarray,  # (L_t,) out: sum of T_end / likelihood
) -> float:
    total = 0.0
    for r in range(TILE):
        for j in range(counts[r]):
            s = slot[r, j]
            for c in range(TILE):
                if where[r, j, c] > 0:
                    p = value[r, c] + rest[s] * rays[r, c]
                    # A pixel that nothing explains has no share to give, at any codes; its term is held at a floor.
                    total += np.log(np.float64(max(p, _TINY)))
                    where[r, j, c] = 1.0 / p if p > _TINY else 0.0
                    spare[s] += rays[r, c] * where[r, j, c]
    return total


@nb.njit(fastmath=_FAST)
def _sum_labels(
    used: int,
    ends: np.ndarray,  # (E_t,)
    rows: np.ndarray,  # (R,)
    weights: np.ndarray,  # (R, 16)
    counts: np.ndarray,  # (16,)
    slot: np.ndarray,  # (16, 16)
    where: np.ndarray,  # (16, 16, 16) what a weight counts where a row's pixel has its j-th label
    many: int,
    sums: np.ndarray,  # (E_t * many,) out
) -> None:
    sums[:] = 0.0
    # Sixteen columns apart, as long as the label stays the same: most rows have one label, most entries too.
    columns = np.zeros((1, TILE), np.float32)
    n = 0
    for e in range(used):
        current = np.int64(-1)
        for i in range(n, ends[e]):
            r = np.int64(rows[i])
            for j in range(counts[r]):
                if slot[r, j] != current:
                    if current >= 0:
                        sums[e * many + current] += take_sum(columns, 0)
                    current = slot[r, j]
                add_product(columns, 0, weights, i, where, r * TILE + j)
        if current >= 0:
            sums[e * many + current] += take_sum(columns, 0)
        n = ends[e]


@nb.njit(parallel=True, nogil=True, cache=True)
def reduce_labelled(
    start: np.ndarray,  # (T + 1,)
    gaussian_start: np.ndarray,  # (M + 1,)
    gaussian_entries: np.ndarray,  # (E,)
    entry_tile: np.ndarray,  # (E,)
    label_start: np.ndarray,  # (T + 1,)
    present: np.ndarray,
    slot_start: np.ndarray,  # (T + 1,)
    sums: np.ndarray,
    out: np.ndarray,  # (M, L) float32 out
) -> None:
    """Add up what `labelled` summed for each Gaussian's entries, in tile order."""
    for g in nb.prange(out.shape[0]):
        out[g] = 0.0
        for i in range(gaussian_start[g], gaussian_start[g + 1]):
            e = gaussian_entries[i]
            tile = entry_tile[e]
            many = label_start[tile + 1] - label_start[tile]
            base = slot_start[tile] + (e - start[tile]) * many
            for j in range(many):
                out[g, present[label_start[tile] + j]] += sums[base + j]


@nb.njit(parallel=True, nogil=True, cache=True)
def list_weights(
    columns: int,
    width: int,
    height: int,
    table: np.ndarray,  # (M, 8)
    start: np.ndarray,  # (T + 1,)
    entries: np.ndarray,  # (E,)
    wanted: np.ndarray,  # (U,) tiles
    place: np.ndarray,  # (U + 1,) int64: where each tile's part begins; with empty lists, counts out (in place[1:])
    pixels: np.ndarray,  # (P,) int32 out
    rows_of: np.ndarray,  # (P,) int32 out: row of the table
    values: np.ndarray,  # (P,) float32 out
) -> None:
    """Count the non-zero weights of each tile, or write them where a first call's counts say."""
    for i in nb.prange(wanted.shape[0]):
        tile = wanted[i]
        first, last = start[tile], start[tile + 1]
        rays, weights, rows, ends = _scratch(last - first)
        used = blend_tile(tile, columns, width, height, table, entries, first, last, rays, weights, rows, ends)
        left, top = (tile % columns) * TILE, (tile // columns) * TILE
        position = place[i] if values.shape[0] else 0
        n = 0
        for e in range(used):
            for record in range(n, ends[e]):
                for c in range(TILE):
                    if weights[record, c] > 0:
                        if values.shape[0]:
                            pixels[position] = (top + rows[record]) * width + left + c
                            rows_of[position] = entries[first + e]
                            values[position] = weights[record, c]
                        position += 1
            n = ends[e]
        if not values.shape[0]:
            place[i + 1] = position
