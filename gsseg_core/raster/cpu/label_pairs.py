"""What is left of a view once its mask has been lifted: only what a labelled pixel really sees.

A *pair* is a Gaussian with one of the labels under which a view sees it. There are few: most Gaussians lie inside
one label. Everything that learning asks of a view is one number per pair, and `share` makes these numbers, from the
entries and blocks that `lift` found to have a weight. It projects nothing, sorts nothing, and meets no Gaussian that
something else hides.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from gsseg_core.raster.constants import CHUNKS, TINY
from gsseg_core.raster.cpu.blending import AHEAD, open_rays, stride_of, tile_of_turn
from gsseg_core.raster.cpu.splat import WIDTH, aim, blend_block
from gsseg_core.raster.cpu.tiling import TILE
from gsseg_core.simd import (
    FAST,
    add_product,
    add_product_where,
    add_scaled,
    add_scaled_where,
    first_bit,
    load_row,
    nothing,
    prefetch,
    store_row,
    sum_row,
)

_TINY = np.float32(TINY)

# Each chunk of Gaussians counts from 0, and `settle` makes one count of these.
_CHUNK = 27  # the bits above these say which chunk a number belongs to
_NUMBER = (1 << _CHUNK) - 1

PARTS = 4
"""Parts of the image whose sums are added up beside each other."""


@nb.njit(parallel=True, nogil=True, cache=True)
def keep_entries(
    start: np.ndarray,  # (T + 1,)
    reached: np.ndarray,  # (E,) uint16: blocks of each entry
    kept_start: np.ndarray,  # (T + 1,) where the entries that are kept of each tile go
    kept: np.ndarray,  # (E, 2) int32 out: where each entry goes, -1 if nowhere; its tile
    blocks: np.ndarray,  # (E',) uint16 out: blocks of those that are kept
) -> None:
    """Give a number to every entry that reaches a labelled pixel."""
    for tile in nb.prange(start.shape[0] - 1):
        n = kept_start[tile]
        for e in range(start[tile], start[tile + 1]):
            kept[e, 0], kept[e, 1] = -1, tile
            if reached[e]:
                kept[e, 0], blocks[n] = n, reached[e]
                n += 1


@nb.njit(parallel=True, nogil=True, cache=True)
def number_pairs(
    gaussian_start: np.ndarray,  # (M + 1,)
    gaussian_entries: np.ndarray,  # (E,)
    kept: np.ndarray,  # (E, 2)
    tiles: np.ndarray,  # (T, 6) int64: first of all entries, of all slots, of the entries kept, of their slots, of the
    # labels, and how many labels; together, since each look at another tile waits for memory
    sums: np.ndarray,  # (slots,) sum of weights by entry and label
    present: np.ndarray,
    num_labels: int,
    capacity: np.ndarray,  # (CHUNKS + 1,) where each chunk's pairs begin; there is more than needed
    found: np.ndarray,  # (CHUNKS, 2) int64 out: Gaussians and pairs of each chunk
    gaussians: np.ndarray,  # (M,) int32 out: those that are seen; each chunk's from where it begins
    counts: np.ndarray,  # (M,) int32 out: how many labels each of them has; the same
    labels: np.ndarray,  # (capacity[-1],) int32 out
    votes: np.ndarray,  # (capacity[-1],) float32 out
    entries: np.ndarray,  # (E',) int32 out: Gaussian of each kept entry
    pair: np.ndarray,  # (kept_slot_start[-1],) int32 out: of each kept entry and label of its tile, -1 where none
) -> None:
    """Give a number to every Gaussian that is seen, and to each of its labels, and tell the entries."""
    count, last = gaussians.shape[0], gaussian_entries.shape[0] - 1
    for chunk in nb.prange(CHUNKS):
        seen, number = np.full(num_labels, -1, np.int64), np.zeros(num_labels, np.int64)
        first, n = chunk * count // CHUNKS, capacity[chunk]
        place, tag = first, chunk << _CHUNK
        for g in range(first, (chunk + 1) * count // CHUNKS):
            begin, is_seen = n, False
            for i in range(gaussian_start[g], gaussian_start[g + 1]):
                prefetch(kept, gaussian_entries[min(i + 2 * AHEAD, last)])
                later = gaussian_entries[min(i + AHEAD, last)]
                facts = tiles[kept[later, 1]]
                prefetch(sums, facts[1] + (later - facts[0]) * facts[5])
                e = gaussian_entries[i]
                target, tile = kept[e, 0], kept[e, 1]
                if target < 0:
                    continue
                is_seen = True
                entries[target] = tag | (place - first)
                facts = tiles[tile]
                slots = facts[5]
                base = facts[1] + (e - facts[0]) * slots
                position = facts[3] + (target - facts[2]) * slots
                for j in range(slots):
                    weight = sums[base + j]
                    if not weight > 0:
                        pair[position + j] = -1
                        continue
                    label = present[facts[4] + j]
                    if seen[label] != g:
                        seen[label], number[label] = g, n
                        labels[n], votes[n] = label, 0.0
                        n += 1
                    votes[number[label]] += weight
                    pair[position + j] = tag | (number[label] - capacity[chunk])
            if is_seen:
                gaussians[place], counts[place] = g, n - begin
                place += 1
        found[chunk, 0], found[chunk, 1] = place - first, n - capacity[chunk]


@nb.njit(parallel=True, nogil=True, cache=True)
def settle(
    numbers: np.ndarray,  # int32, changed in place
    before: np.ndarray,  # (CHUNKS,) how many there are in the chunks before
) -> None:
    """Make one count of numbers that begin anew in every chunk."""
    for i in nb.prange(numbers.shape[0]):
        if numbers[i] >= 0:
            numbers[i] = (numbers[i] & _NUMBER) + before[numbers[i] >> _CHUNK]


@nb.njit(parallel=True, nogil=True, cache=True)
def take(
    table: np.ndarray,  # (M, K)
    chosen: np.ndarray,  # (M',)
) -> np.ndarray:
    """Copy some rows of a table, (M', K); several times as fast as numpy."""
    out = np.empty((chosen.shape[0], table.shape[1]), table.dtype)
    for m in nb.prange(chosen.shape[0]):
        for j in range(table.shape[1]):
            out[m, j] = table[chosen[m], j]
    return out


@nb.njit(parallel=True, nogil=True, cache=True, fastmath=FAST, error_model="numpy")
def share(
    columns: int,
    width: int,
    height: int,
    table: np.ndarray,  # (M, 8)
    start: np.ndarray,  # (T + 1,)
    entries: np.ndarray,  # (E,)
    blocks: np.ndarray,  # (E,)
    records: np.ndarray,  # (T,) blocks of all the tile's entries
    label_start: np.ndarray,  # (T + 1,)
    present: np.ndarray,
    span_start: np.ndarray,  # (16 T + 1,)
    slots: np.ndarray,  # (S,)
    lanes: np.ndarray,  # (S,)
    slot_start: np.ndarray,  # (T + 1,)
    pair: np.ndarray,  # (slot_start[-1],)
    said: np.ndarray,  # (P,) float32: what each pair says of its label
    rest: np.ndarray,  # (L,) float32: what the transmittance left over says of each label
    logs: np.ndarray,  # (T,) float64 out: sum of log likelihood, (W said)[p] + T_end rest
    left_over: np.ndarray,  # like present, float64 out: sum of T_end / likelihood by label
    sums: np.ndarray,  # (slot_start[-1],) float32 out: per entry and label, sum of w / likelihood
) -> None:
    """Share one vote per labelled pixel among the pairs that made it."""
    rows = (start.shape[0] - 1) // columns
    stride = stride_of(rows)
    for turn in nb.prange(rows * columns):
        tile = tile_of_turn(turn, columns, rows, stride)
        labels = present[label_start[tile] : label_start[tile + 1]]
        logs[tile] = 0.0
        if labels.shape[0] == 0:
            continue
        own = slice(start[tile], start[tile + 1])
        spans = span_start[tile * TILE : tile * TILE + TILE + 1]
        here = pair[slot_start[tile] : slot_start[tile + 1]]
        rays, value = np.empty((TILE, TILE), np.float32), np.zeros((TILE, TILE), np.float32)
        weights = np.empty((records[tile], TILE), np.float32)
        left, top, _ = open_rays(tile, columns, width, height, rays)
        _blend_said(
            left, top, table, entries[own], blocks[own], labels.shape[0], spans, slots, lanes, here, said, rays,
            value, weights,
        )  # fmt: skip
        spare = left_over[label_start[tile] : label_start[tile + 1]]
        logs[tile] = _invert(spans, slots, lanes, rest[labels], rays, value, spare)
        _sum_shares(
            blocks[own], labels.shape[0], spans, slots, lanes, value, weights,
            sums[slot_start[tile] : slot_start[tile + 1]],
        )  # fmt: skip


@nb.njit(fastmath=FAST, error_model="numpy")
def _blend_said(
    left: float,
    top: float,
    table: np.ndarray,  # (M, 8)
    entries: np.ndarray,  # (E_t,) of this tile
    blocks: np.ndarray,  # (E_t,)
    label_count: int,
    spans: np.ndarray,  # (17,)
    slots: np.ndarray,
    lanes: np.ndarray,
    pair: np.ndarray,  # (E_t * label_count,)
    said: np.ndarray,  # (P,)
    rays: np.ndarray,  # (16, 16) in and out
    value: np.ndarray,  # (16, 16) in: zeros; out: W said
    weights: np.ndarray,  # (R, 16) out
) -> None:
    lines = np.empty((2, TILE), np.float32)
    n = 0
    for e in range(entries.shape[0]):
        prefetch(table, entries[min(e + AHEAD, entries.shape[0] - 1)])
        g = entries[e]
        aim(table, g, left, top, lines)
        only = said[pair[e * label_count]] if label_count == 1 else np.float32(0.0)
        todo = np.int64(blocks[e])
        while todo:
            b = first_bit(todo)
            todo &= todo - 1
            weight, _ = blend_block(rays, b, lines, table[g, WIDTH])
            store_row(weights, n, weight)
            n += 1
            total = load_row(value, b)
            if label_count == 1:
                total = add_scaled(total, weight, only)
            else:
                for span in range(spans[b], spans[b + 1]):
                    # Where there is no pair, the weights are zero.
                    s = max(pair[e * label_count + slots[span]], 0)
                    total = add_scaled_where(total, weight, said[s], np.int64(lanes[span]))
            store_row(value, b, total)


@nb.njit(error_model="numpy")
def _invert(
    spans: np.ndarray,  # (17,)
    slots: np.ndarray,
    lanes: np.ndarray,
    rest: np.ndarray,  # (L_t,)
    rays: np.ndarray,  # (16, 16) final transmittance
    value: np.ndarray,  # (16, 16) in: W said; out: 1 / likelihood, 0 where there is no label
    spare: np.ndarray,  # (L_t,) out: sum of T_end / likelihood
) -> float:
    total = 0.0
    spare[:] = 0.0
    for b in range(TILE):
        known = np.int64(0)
        for span in range(spans[b], spans[b + 1]):
            known |= np.int64(lanes[span])
            # Each likelihood is at least 1e-30 and at most about 1: products of eight stay within a float64.
            product, s = 1.0, slots[span]
            for i in range(TILE):
                if lanes[span] >> i & 1:
                    p = value[b, i] + rest[s] * rays[b, i]
                    # A pixel that nothing explains has no share to give, at any codes; its term is held at a floor.
                    product *= np.float64(max(p, _TINY))
                    value[b, i] = 1.0 / p if p > _TINY else 0.0
                    spare[s] += rays[b, i] * value[b, i]
                if i == TILE // 2 - 1:
                    total += np.log(product)
                    product = 1.0
            total += np.log(product)
        for i in range(TILE):
            if not known >> i & 1:
                value[b, i] = 0.0
    return total


@nb.njit(fastmath=FAST)
def _sum_shares(
    blocks: np.ndarray,  # (E_t,)
    label_count: int,
    spans: np.ndarray,  # (17,)
    slots: np.ndarray,
    lanes: np.ndarray,
    inverse: np.ndarray,  # (16, 16) 1 / likelihood
    weights: np.ndarray,  # (R, 16)
    sums: np.ndarray,  # (E_t * label_count,) out
) -> None:
    sums[:] = 0.0
    n = 0
    for e in range(blocks.shape[0]):
        # Lane by lane, as long as the label stays the same: most blocks have one label, and most entries too.
        current, lanewise = np.int64(-1), nothing()
        todo = np.int64(blocks[e])
        while todo:
            b = first_bit(todo)
            todo &= todo - 1
            weight = load_row(weights, n)
            n += 1
            if label_count == 1:
                current, lanewise = np.int64(0), add_product(lanewise, weight, load_row(inverse, b))
                continue
            for span in range(spans[b], spans[b + 1]):
                if slots[span] != current:
                    if current >= 0:
                        sums[e * label_count + current] += sum_row(lanewise)
                    current, lanewise = np.int64(slots[span]), nothing()
                lanewise = add_product_where(lanewise, weight, load_row(inverse, b), np.int64(lanes[span]))
        if current >= 0:
            sums[e * label_count + current] += sum_row(lanewise)


@nb.njit(parallel=True, nogil=True, cache=True)
def add_up(
    slot_start: np.ndarray,  # (T + 1,)
    pair: np.ndarray,  # (slot_start[-1],)
    sums: np.ndarray,  # (slot_start[-1],)
    parts: np.ndarray,  # (PARTS, P) float32 out: of each part of the image
) -> None:
    """Add up what `share` summed for each pair, in tile order."""
    tiles = slot_start.shape[0] - 1
    for part in nb.prange(PARTS):
        total = parts[part]
        total[:] = 0.0
        for i in range(slot_start[part * tiles // PARTS], slot_start[(part + 1) * tiles // PARTS]):
            if pair[i] >= 0:
                total[pair[i]] += sums[i]
