"""Lift a mask: sum each Gaussian's weights by the labels of the pixels that it made, in one pass over the view.

The labels of a row of sixteen pixels are kept as *spans*: for each label in the row, one bit per pixel. Most rows hold
one label, so most records need one sum. The same pass notes which rows of a tile each entry really reached through
what is in front of it. What reached none is left out of all later passes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba as nb
import numpy as np

from gsseg_core.blend import AHEAD, open_rays
from gsseg_core.lanes import (
    FAST,
    LANES,
    OPEN,
    WIDTH,
    add_where,
    aim,
    blend_row,
    count_bits,
    first_bit,
    nothing,
    prefetch,
    sum_row,
)
from gsseg_core.tiles import TILE


@dataclass(frozen=True)
class Labels:
    """A mask, cut into tiles; each tile gives the labels in it numbers of its own.

    Attributes
    ----------
    start : (T + 1,) int64, present : (start[-1],) int32
        Labels of tile t are present[start[t]:start[t + 1]].
    span_start : (16 T + 1,) int64
        Spans of row r of tile t are those from span_start[16 t + r] to the next.
    slots : (S,) int32
        Which of its tile's labels a span is.
    lanes : (S,) int32
        Bit c is set where the span has its label.
    """

    start: np.ndarray
    present: np.ndarray
    span_start: np.ndarray
    slots: np.ndarray
    lanes: np.ndarray


@nb.njit(nogil=True, cache=True)
def cut_labels(
    labels: np.ndarray,  # (H, W) int32, negative = unknown
    columns: int,
    rows: int,
    num_labels: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Make what `Labels` holds."""
    height, width = labels.shape
    start = np.zeros(columns * rows + 1, np.int64)
    present = np.empty(height * width, np.int32)
    span_start = np.zeros(columns * rows * TILE + 1, np.int64)
    slots, lanes = np.empty(height * width, np.int32), np.empty(height * width, np.int32)
    slot_of, span_of = np.full(num_labels, -1, np.int64), np.full(num_labels, -1, np.int64)
    n = spans = 0
    for tile in range(columns * rows):
        left, top = (tile % columns) * TILE, (tile // columns) * TILE
        for r in range(TILE):
            begin = spans
            for c in range(min(TILE, width - left) if top + r < height else 0):
                label = labels[top + r, left + c]
                if label < 0:
                    continue
                if slot_of[label] < 0:
                    slot_of[label] = n - start[tile]
                    present[n] = label
                    n += 1
                if span_of[label] < begin:
                    span_of[label] = spans
                    slots[spans], lanes[spans] = slot_of[label], 0
                    spans += 1
                lanes[span_of[label]] |= 1 << c
            span_start[tile * TILE + r + 1] = spans
        for i in range(start[tile], n):
            slot_of[present[i]] = -1
        start[tile + 1] = n
    return start, present[:n].copy(), span_start, slots[:spans].copy(), lanes[:spans].copy()


@nb.njit(parallel=True, nogil=True, cache=True, fastmath=FAST, error_model="numpy")
def lift(
    columns: int,
    width: int,
    height: int,
    table: np.ndarray,  # (M, 8)
    start: np.ndarray,  # (T + 1,)
    entries: np.ndarray,  # (E,)
    label_start: np.ndarray,  # (T + 1,)
    span_start: np.ndarray,  # (16 T + 1,)
    slots: np.ndarray,  # (S,)
    lanes: np.ndarray,  # (S,)
    slot_start: np.ndarray,  # (T + 1,) where each tile's sums begin: one for each entry and label
    reached: np.ndarray,  # (E,) uint16 out: rows with a label in which the entry has a weight, one bit each
    sums: np.ndarray,  # (slot_start[-1],) float32 out: sum of weights
    counts: np.ndarray,  # (T, 3) int64 out: entries with a row, their rows, sums above zero
) -> None:
    """Blend the view, and sum weights by entry and label."""
    for tile in nb.prange(start.shape[0] - 1):
        many = label_start[tile + 1] - label_start[tile]
        first, last = start[tile], start[tile + 1]
        reached[first:last] = 0
        counts[tile] = 0
        if many:
            mine = sums[slot_start[tile] : slot_start[tile + 1]]
            mine[:] = 0.0
            _lift_tile(
                tile, columns, width, height, table, entries, first, last, span_start, slots, lanes, reached, mine, many
            )
            for e in range(first, last):
                counts[tile, 0] += reached[e] > 0
                counts[tile, 1] += count_bits(np.int64(reached[e]))
            counts[tile, 2] = (mine > 0).sum()


@nb.njit(fastmath=FAST, error_model="numpy")
def _lift_tile(
    tile: int,
    columns: int,
    width: int,
    height: int,
    table: np.ndarray,
    entries: np.ndarray,
    first: int,
    last: int,
    span_start: np.ndarray,
    slots: np.ndarray,
    lanes: np.ndarray,
    reached: np.ndarray,
    sums: np.ndarray,  # (E_t * many,)
    many: int,
) -> None:
    rays, lines = np.empty((TILE, TILE), np.float32), np.empty((2, TILE), np.float32)
    left, top, live = open_rays(tile, columns, width, height, rays)
    labelled = np.zeros(TILE, np.int64)  # one bit per pixel of each row
    for r in range(TILE):
        for span in range(span_start[tile * TILE + r], span_start[tile * TILE + r + 1]):
            labelled[r] |= lanes[span]
        if not labelled[r]:
            live &= ~(1 << r)
    for e in range(first, last):
        prefetch(table, entries[min(e + AHEAD, last - 1)])
        g = entries[e]
        rows = aim(table, g, left, top, lines) & live
        hit = np.int64(0)
        # Sixteen columns apart, as long as the label stays the same: most rows have one label, most entries too.
        current, apart = np.int64(-1), nothing()
        while rows:
            r = first_bit(rows)
            rows &= rows - 1
            weight, bits = blend_row(rays, r, lines, table[g, WIDTH])
            if not bits & OPEN:
                live &= ~(1 << r)
            hit |= np.int64(bits >> LANES & labelled[r] > 0) << r
            if many == 1:
                current, apart = np.int64(0), add_where(apart, weight, labelled[r])
                continue
            for span in range(span_start[tile * TILE + r], span_start[tile * TILE + r + 1]):
                if slots[span] != current:
                    if current >= 0:
                        sums[(e - first) * many + current] += sum_row(apart)
                    current, apart = np.int64(slots[span]), nothing()
                apart = add_where(apart, weight, np.int64(lanes[span]))
        if current >= 0:
            sums[(e - first) * many + current] += sum_row(apart)
        reached[e] = hit
        if not live:
            return
