"""Lift a mask: sum each Gaussian's weights by the labels of the pixels that it made, in one pass over the view.

The labels of a block of sixteen pixels are kept as *spans*: for each label in the block, one bit per pixel. Most blocks
hold one label, so most records need one sum. The same pass notes which blocks of a tile each entry really reached
through what is in front of it. What reached none is left out of all later passes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba as nb
import numpy as np

from gsseg_core.raster.cpu.blending import aim_next, in_tile, open_rays, stride_of, tile_of_turn
from gsseg_core.raster.cpu.splat import OPEN, WIDTH, blend_block
from gsseg_core.raster.cpu.tiling import TILE
from gsseg_core.simd import FAST, LANES, add_where, count_bits, first_bit, nothing, sum_row


@dataclass(frozen=True)
class Labels:
    """A mask, cut into tiles; each tile gives the labels in it numbers of its own.

    Attributes
    ----------
    start : (T + 1,) int64, present : (start[-1],) int32
        Labels of tile t are present[start[t]:start[t + 1]].
    span_start : (16 T + 1,) int64
        Spans of block b of tile t are those from span_start[16 t + b] to the next.
    slots : (S,) int32
        Which of its tile's labels a span is.
    lanes : (S,) int32
        Bit i is set where pixel i of the block has the label.
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
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Make what `Labels` holds, and count the pixels of each label, (num_labels,) int64."""
    height, width = labels.shape
    start = np.zeros(columns * rows + 1, np.int64)
    present = np.empty(height * width, np.int32)
    span_start = np.zeros(columns * rows * TILE + 1, np.int64)
    slots, lanes = np.empty(height * width, np.int32), np.empty(height * width, np.int32)
    slot_of, span_of = np.full(num_labels, -1, np.int64), np.full(num_labels, -1, np.int64)
    areas = np.zeros(num_labels, np.int64)
    n = spans = 0
    for tile in range(columns * rows):
        left, top = (tile % columns) * TILE, (tile // columns) * TILE
        alike = _is_uniform(labels, left, top)
        for b in range(TILE):
            begin = spans
            for lane in range(1 if alike else LANES):
                r, c = in_tile(b, lane)
                label = labels[top + r, left + c] if top + r < height and left + c < width else -1
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
                lanes[span_of[label]] |= OPEN if alike else 1 << lane
                areas[label] += LANES if alike else 1
            span_start[tile * TILE + b + 1] = spans
        for i in range(start[tile], n):
            slot_of[present[i]] = -1
        start[tile + 1] = n
    return start, present[:n].copy(), span_start, slots[:spans].copy(), lanes[:spans].copy(), areas


@nb.njit
def _is_uniform(labels: np.ndarray, left: int, top: int) -> bool:
    """Whether a tile lies in the image as a whole, and all its pixels have one label, or none has."""
    if top + TILE > labels.shape[0] or left + TILE > labels.shape[1]:
        return False
    different = 0
    for r in range(top, top + TILE):
        for c in range(left, left + TILE):
            different |= labels[r, c] ^ labels[top, left]
    return different == 0


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
    reached: np.ndarray,  # (E,) uint16 out: blocks with a label in which the entry has a weight, one bit each
    sums: np.ndarray,  # (slot_start[-1],) float32 out: sum of weights
    counts: np.ndarray,  # (T, 3) int64 out: entries with a block, their blocks, sums above zero
) -> None:
    """Blend the view, and sum weights by entry and label."""
    rows = (start.shape[0] - 1) // columns
    stride = stride_of(rows)
    for turn in nb.prange(rows * columns):
        tile = tile_of_turn(turn, columns, rows, stride)
        label_count = label_start[tile + 1] - label_start[tile]
        first, last = start[tile], start[tile + 1]
        reached[first:last] = 0
        with_block = blocks = positive = 0
        if label_count:
            own = sums[slot_start[tile] : slot_start[tile + 1]]
            own[:] = 0.0
            if label_count == 1:  # The compiler makes a shorter loop of this.
                _lift_tile(
                    tile,
                    columns,
                    width,
                    height,
                    table,
                    entries,
                    first,
                    last,
                    span_start,
                    slots,
                    lanes,
                    reached,
                    own,
                    1,
                )
            else:
                _lift_tile(
                    tile, columns, width, height, table, entries, first, last, span_start, slots, lanes, reached, own,
                    label_count,
                )  # fmt: skip
            for e in range(first, last):
                with_block += reached[e] > 0
                blocks += count_bits(np.int64(reached[e]))
            for i in range(own.shape[0]):
                positive += own[i] > 0
        counts[tile, 0], counts[tile, 1], counts[tile, 2] = with_block, blocks, positive


@nb.njit(inline="always")
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
    sums: np.ndarray,  # (E_t * label_count,)
    label_count: int,
) -> None:
    rays, lines = np.empty((TILE, TILE), np.float32), np.empty((2, 2, TILE), np.float32)
    left, top, live = open_rays(tile, columns, width, height, rays)
    labelled = np.zeros(TILE, np.int64)  # one bit per pixel of each block
    for b in range(TILE):
        for span in range(span_start[tile * TILE + b], span_start[tile * TILE + b + 1]):
            labelled[b] |= lanes[span]
        if not labelled[b]:
            live &= ~(1 << b)
    ahead = aim_next(table, entries, first - 1, last, left, top, lines)
    for e in range(first, last):
        blocks, own, wide = ahead & live, lines[e % 2], table[entries[e], WIDTH]
        ahead = aim_next(table, entries, e, last, left, top, lines)
        hit = np.int64(0)
        # Lane by lane, as long as the label stays the same: most blocks have one label, and most entries too.
        current, lanewise = np.int64(-1), nothing()
        while blocks:
            b = first_bit(blocks)
            blocks &= blocks - 1
            weight, bits = blend_block(rays, b, own, wide)
            if not bits & OPEN:
                live &= ~(1 << b)
            hit |= np.int64(bits >> LANES & labelled[b] > 0) << b
            if label_count == 1:
                current, lanewise = np.int64(0), add_where(lanewise, weight, labelled[b])
                continue
            for span in range(span_start[tile * TILE + b], span_start[tile * TILE + b + 1]):
                if slots[span] != current:
                    if current >= 0:
                        sums[(e - first) * label_count + current] += sum_row(lanewise)
                    current, lanewise = np.int64(slots[span]), nothing()
                lanewise = add_where(lanewise, weight, np.int64(lanes[span]))
        if current >= 0:
            sums[(e - first) * label_count + current] += sum_row(lanewise)
        reached[e] = hit
        if not live:
            return
