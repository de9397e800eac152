"""Lift a mask: sum each Gaussian's weights by the labels of the pixels that it made, in one pass over the view.

The labels of a block of sixteen pixels are kept as *spans*: for each label in the block, one bit per pixel. Most blocks
hold one label, so most records need one sum. The same pass notes which blocks of a tile each entry really reached
through what is in front of it. What reached none is left out of all later passes.
"""

from __future__ import annotations

from typing import NamedTuple

import numba as nb
import numpy as np

from gsseg_core.csr_rows import starts
from gsseg_core.kernels.compiler import called_by_kernels, kernel
from gsseg_core.raster.constants import BLOCK, CHUNKS
from gsseg_core.raster.cpu.blending import aim_next, in_tile, open_rays, tile_of_turn
from gsseg_core.raster.cpu.splat import OPEN, WIDTH, lift_block
from gsseg_core.raster.cpu.tiling import TILE, Tiles
from gsseg_core.simd import FAST, LANES, add, count_bits, first_bit, sum_row, where, zero_row


class Labels(NamedTuple):
    """A mask, cut into tiles; each tile gives the labels in it numbers of its own."""

    start: np.ndarray  # (T + 1,) int64: labels of tile t are present[start[t]:start[t + 1]]
    present: np.ndarray  # (start[-1],) int32
    span_start: np.ndarray  # (16 T + 1,) int64: spans of block b of tile t are from span_start[16 t + b] to the next
    slots: np.ndarray  # (S,) int32: which of its tile's labels a span is
    lanes: np.ndarray  # (S,) int32: bit i is set where pixel i of the block has the label
    weights: np.ndarray  # (T, 16) float32: of each block's pixels, where votes are shared


class Lifted(NamedTuple):
    """A mask lifted into a view: the weights of every entry, summed by label."""

    classes: np.ndarray  # (L,) int32: labels that occur in the mask, ascending
    areas: np.ndarray  # (2, L) float64: pixels of each label; the sum of their weights
    labels: Labels  # the mask cut into tiles; its labels are positions in `classes`
    slot_start: np.ndarray  # (T + 1,) int64: where each tile's sums begin, one for each entry and label of the tile
    reached: np.ndarray  # (E,) uint16: blocks with a label in which the entry has a weight, one bit each
    sums: np.ndarray  # (slot_start[-1],) float32: sum of weights, in px
    # Of each tile, (T,) int64:
    seen: np.ndarray  # entries with such a block
    weighted: np.ndarray  # entries with such a block that has a weight
    records: np.ndarray  # blocks of these that have a weight
    positive: np.ndarray  # sums above 0

    @classmethod
    def of(cls, tiles: Tiles, mask: np.ndarray, weights: np.ndarray | None = None) -> Lifted:
        """Lift a mask, (H, W) and negative where unknown, into a view; for weights see `ViewOperator.observe`."""
        mask = np.ascontiguousarray(mask, np.int32)
        blocks = np.ones((tiles.rows * BLOCK, tiles.columns * BLOCK), np.float32)
        if weights is not None:
            blocks[: weights.shape[0], : weights.shape[1]] = weights
        labels, areas = _cut(mask, blocks, tiles.columns, tiles.rows, int(mask.max(initial=0)) + 1)
        classes = np.flatnonzero(areas[0]).astype(np.int32)
        position = np.zeros(areas.shape[1], np.int32)
        position[classes] = np.arange(len(classes))
        labels = labels._replace(present=position[labels.present])
        slot_start = starts(np.diff(tiles.start) * np.diff(labels.start))
        reached, sums, counts = _lift(tiles, labels, slot_start)
        return cls(classes, areas[:, classes], labels, slot_start, reached, sums, *counts)

    def room_for_pairs(self, tiles: Tiles) -> np.ndarray:
        """Where the (Gaussian, label) pairs of each chunk of Gaussians may begin, (CHUNKS + 1,): with room for all."""
        # A chunk has at most one pair for each sum above zero: one for each of its entries, and `extra` more if all
        # entries that have several are in this chunk; and kernels look at the place after its last.
        extra = self.positive.sum() - self.seen.sum() + 1
        chunks, count = np.arange(CHUNKS + 1), len(tiles.gaussian_start) - 1
        return np.asarray(tiles.gaussian_start[chunks * count // CHUNKS] + extra * chunks)

    @property
    def sees(self) -> bool:
        """Whether a labelled pixel sees any Gaussian."""
        return bool(self.seen.any())


@kernel
def _cut(mask: np.ndarray, blocks: np.ndarray, columns: int, rows: int, num_labels: int) -> tuple[Labels, np.ndarray]:
    """Cut a mask (H, W) int32 into tiles, with weights of `blocks`, (4 rows, 4 columns) float32.

    Second come the pixels of each label, and the sum of their weights, (2, num_labels) float64.
    """
    height, width = mask.shape
    start = np.zeros(columns * rows + 1, np.int64)
    present = np.empty(height * width, np.int32)
    span_start = np.zeros(columns * rows * TILE + 1, np.int64)
    slots, lanes = np.empty(height * width, np.int32), np.empty(height * width, np.int32)
    slot_of, span_of = np.full(num_labels, -1, np.int64), np.full(num_labels, -1, np.int64)
    areas, weights = np.zeros((2, num_labels)), np.empty((columns * rows, TILE), np.float32)
    n = spans = 0
    for tile in range(columns * rows):
        left, top = (tile % columns) * TILE, (tile // columns) * TILE
        alike = _is_uniform(mask, left, top)
        for b in range(TILE):
            begin, weights[tile, b] = spans, blocks[top // BLOCK + b // BLOCK, left // BLOCK + b % BLOCK]
            for lane in range(1 if alike else LANES):
                r, c = in_tile(b, lane)
                label = mask[top + r, left + c] if top + r < height and left + c < width else -1
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
                pixels = LANES if alike else 1
                areas[0, label] += pixels
                areas[1, label] += pixels * weights[tile, b]
            span_start[tile * TILE + b + 1] = spans
        for i in range(start[tile], n):
            slot_of[present[i]] = -1
        start[tile + 1] = n
    labels = Labels(start, present[:n].copy(), span_start, slots[:spans].copy(), lanes[:spans].copy(), weights)
    return labels, areas


@called_by_kernels
def _is_uniform(mask: np.ndarray, left: int, top: int) -> bool:
    """Whether a tile lies in the image as a whole, and all its pixels have one label, or none has."""
    if top + TILE > mask.shape[0] or left + TILE > mask.shape[1]:
        return False
    different = 0
    for r in range(top, top + TILE):
        for c in range(left, left + TILE):
            different |= mask[r, c] ^ mask[top, left]
    return different == 0


@kernel(parallel=True, fastmath=FAST, error_model="numpy")
def _lift(tiles: Tiles, labels: Labels, slot_start: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Blend the view, and sum weights by entry and label: the last attributes of `Lifted`, what is of tiles (4, T)."""
    reached, sums = np.empty(len(tiles.entries), np.uint16), np.empty(slot_start[-1], np.float32)
    counts = np.empty((4, len(slot_start) - 1), np.int64)
    for turn in nb.prange(tiles.rows * tiles.columns):
        tile = tile_of_turn(tiles, turn)
        label_count = labels.start[tile + 1] - labels.start[tile]
        blocks = reached[tiles.start[tile] : tiles.start[tile + 1]]
        blocks[:] = 0
        seen = with_weight = records = positive = 0
        weighted = weighted_blocks(labels.weights[tile])
        if label_count:
            own = sums[slot_start[tile] : slot_start[tile + 1]]
            own[:] = 0.0
            if label_count == 1:  # The compiler makes a shorter loop of this.
                _lift_tile(tiles, labels, tile, blocks, own, 1)
            else:
                _lift_tile(tiles, labels, tile, blocks, own, label_count)
            for e in range(len(blocks)):
                seen += blocks[e] > 0
                with_weight += (blocks[e] & weighted) > 0
                records += count_bits(blocks[e] & weighted)
            for i in range(len(own)):
                positive += own[i] > 0
        counts[0, tile], counts[1, tile], counts[2, tile], counts[3, tile] = seen, with_weight, records, positive
    return reached, sums, counts


@called_by_kernels
def weighted_blocks(weights: np.ndarray) -> int:  # (16,)
    """Which blocks of a tile have a weight, as bits."""
    blocks = 0
    for b in range(TILE):
        blocks |= (weights[b] > 0) << b
    return blocks


@nb.njit(inline="always")
def _lift_tile(
    tiles: Tiles, labels: Labels, tile: int,
    reached: np.ndarray, sums: np.ndarray, label_count: int,  # (E_t,), (E_t * label_count,) in: zeros; out
) -> None:  # fmt: skip
    rays, lines = np.empty((TILE, TILE), np.float32), np.empty((2, 2, TILE), np.float32)
    left, top, live = open_rays(tiles, tile, rays)
    spans = labels.span_start[tile * TILE : tile * TILE + TILE + 1]
    labelled = np.zeros(TILE, np.int64)  # one bit per pixel of each block
    for b in range(TILE):
        for span in range(spans[b], spans[b + 1]):
            labelled[b] |= labels.lanes[span]
        if not labelled[b]:
            live &= ~(1 << b)
    first, last, table, entries = tiles.start[tile], tiles.start[tile + 1], tiles.table, tiles.entries
    ahead = aim_next(table, entries, first - 1, last, left, top, lines)
    for e in range(first, last):
        blocks, wide = ahead & live, table[entries[e], WIDTH]
        ahead = aim_next(table, entries, e, last, left, top, lines)
        hit = np.int64(0)
        # Lane by lane, as long as the label stays the same: most blocks have one label, and most entries too.
        current, lanewise = np.int64(-1), zero_row()
        while blocks:
            b = first_bit(blocks)
            blocks &= blocks - 1
            weight, bits = lift_block(rays, b, lines, e % 2, wide)
            if not bits & OPEN:
                live &= ~(1 << b)
            hit |= np.int64(bits >> LANES & labelled[b] > 0) << b
            if label_count == 1:
                current, lanewise = np.int64(0), where(labelled[b], add(lanewise, weight), lanewise)
                continue
            for span in range(spans[b], spans[b + 1]):
                if labels.slots[span] != current:
                    if current >= 0:
                        sums[(e - first) * label_count + current] += sum_row(lanewise)
                    current, lanewise = np.int64(labels.slots[span]), zero_row()
                lanewise = where(np.int64(labels.lanes[span]), add(lanewise, weight), lanewise)
        if current >= 0:
            sums[(e - first) * label_count + current] += sum_row(lanewise)
        reached[e - first] = hit
        if not live:
            return
