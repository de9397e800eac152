"""What is left of a view once its mask has been lifted: only what a labelled pixel really sees.

A *pair* is a Gaussian with one of the labels under which a view sees it. There are few: most Gaussians lie inside
one label. Everything that learning asks of a view is one number per pair, and `share` makes these numbers, from the
entries and blocks that `lifting` found to have a weight. It projects nothing, sorts nothing, and meets no Gaussian that
something else hides.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from gsseg_core import simd
from gsseg_core.kernels.compiler import called_by_kernels, kernel
from gsseg_core.raster.constants import CHUNKS, TINY
from gsseg_core.raster.cpu.blending import open_rays, tile_of_turn
from gsseg_core.raster.cpu.lifting import Labels, weighted_blocks
from gsseg_core.raster.cpu.splat import WIDTH, aim, lift_block
from gsseg_core.raster.cpu.tiling import TILE, Tiles

_TINY = np.float32(TINY)

# Each chunk of Gaussians counts from 0, and `number_on` makes one count of these.
_BITS = 27  # of a number; those above them say which chunk it belongs to
_NUMBER = (1 << _BITS) - 1

PARTS = 4  # parts of the image whose sums are added up beside each other


@kernel(parallel=True)
def keep_entries(
    start: np.ndarray, reached: np.ndarray, kept_start: np.ndarray, shared_start: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Give numbers to the entries that reach a labelled pixel, and others to those where such a pixel has a weight.

    The numbers of a tile begin where the two starts say, (T + 1,). Returns for each entry both numbers, -1 for none,
    and its tile, (E, 3) int32; for those with a weight, (E',), their first number, int32, and the blocks with a weight,
    uint16.
    """
    kept = np.empty((len(reached), 3), np.int32)
    shared, blocks = np.empty(shared_start[-1], np.int32), np.empty(shared_start[-1], np.uint16)
    for tile in nb.prange(start.shape[0] - 1):
        n, s, weighted = kept_start[tile], shared_start[tile], weighted_blocks(weights[tile])
        for e in range(start[tile], start[tile + 1]):
            kept[e, 0], kept[e, 1], kept[e, 2] = -1, -1, tile
            if reached[e]:
                kept[e, 0] = n
                if reached[e] & weighted:
                    kept[e, 1], shared[s], blocks[s] = s, n, reached[e] & weighted
                    s += 1
                n += 1
    return kept, shared, blocks


@kernel(parallel=True)
def number_pairs(
    tiles: Tiles, kept: np.ndarray,  # (E, 3)
    facts: np.ndarray,  # (T, 6) int64: first of all entries, of all slots, of the entries with a weight, of their
    # slots, of the labels, and how many labels; together, since each look at another tile waits for memory
    sums: np.ndarray, present: np.ndarray, num_labels: int,  # (slots,) sum of weights by entry and label
    capacity: np.ndarray,  # (CHUNKS + 1,) where each chunk's pairs begin; there is more than needed
    entries: np.ndarray,  # (E',) int32 out: Gaussian of each kept entry
    pair: np.ndarray,  # (slots,) int32 out: of each entry with a weight and label of its tile, -1 where none
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Give a number to every Gaussian that is seen, and to each of its labels, and tell the entries.

    Returns how many Gaussians and pairs each chunk has, (CHUNKS, 2) int64; these Gaussians and how many labels each of
    them has, both (M,) int32, each chunk's from where it begins; and, each from `capacity` on, labels and votes of the
    pairs, int32 and float32.
    """
    count, last = len(tiles.table), len(tiles.gaussian_entries) - 1
    found, gaussians, counts = np.empty((CHUNKS, 2), np.int64), np.empty(count, np.int32), np.empty(count, np.int32)
    labels, votes = np.empty(capacity[-1], np.int32), np.empty(capacity[-1], np.float32)
    for chunk in nb.prange(CHUNKS):
        seen, number = np.full(num_labels, -1, np.int64), np.zeros(num_labels, np.int64)
        first, n = chunk * count // CHUNKS, capacity[chunk]
        place, tag = first, chunk << _BITS
        for g in range(first, (chunk + 1) * count // CHUNKS):
            begin, is_seen = n, False
            for i in range(tiles.gaussian_start[g], tiles.gaussian_start[g + 1]):
                simd.prefetch(kept, tiles.gaussian_entries[min(i + 2 * simd.AHEAD, last)])
                later = tiles.gaussian_entries[min(i + simd.AHEAD, last)]
                of_tile = facts[kept[later, 2]]
                simd.prefetch(sums, of_tile[1] + (later - of_tile[0]) * of_tile[5])
                e = tiles.gaussian_entries[i]
                if kept[e, 0] < 0:
                    continue
                is_seen, shared = True, kept[e, 1]
                entries[kept[e, 0]] = tag | (place - first)
                of_tile = facts[kept[e, 2]]
                slots = of_tile[5]
                base = of_tile[1] + (e - of_tile[0]) * slots
                position = of_tile[3] + (shared - of_tile[2]) * slots
                for j in range(slots):
                    weight = sums[base + j]
                    if not weight > 0:
                        if shared >= 0:
                            pair[position + j] = -1
                        continue
                    label = present[of_tile[4] + j]
                    if seen[label] != g:
                        seen[label], number[label] = g, n
                        labels[n], votes[n] = label, 0.0
                        n += 1
                    votes[number[label]] += weight
                    if shared >= 0:
                        pair[position + j] = tag | (number[label] - capacity[chunk])
            if is_seen:
                gaussians[place], counts[place] = g, n - begin
                place += 1
        found[chunk, 0], found[chunk, 1] = place - first, n - capacity[chunk]
    return found, gaussians, counts, labels, votes


@kernel(parallel=True)
def number_on(numbers: np.ndarray, before: np.ndarray) -> None:
    """Add to numbers, int32, that begin anew in each chunk how many came `before` it, (CHUNKS,), in place; -1 stays."""
    for i in nb.prange(numbers.shape[0]):
        number = (numbers[i] & _NUMBER) + before[max(numbers[i], 0) >> _BITS]
        numbers[i] = number if numbers[i] >= 0 else -1


@kernel(parallel=True, fastmath=simd.FAST, error_model="numpy")
def share(
    tiles: Tiles, labels: Labels, blocks: np.ndarray,  # (E,) uint16: of each entry
    records: np.ndarray,  # (T,) blocks of all the tile's entries
    slot_start: np.ndarray, pair: np.ndarray,  # (T + 1,), (slot_start[-1],)
    likelihood: np.ndarray, rest: np.ndarray,  # (P,), (L,) float32, as `Observation.shares` takes them
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Share one vote per labelled pixel, times its weight, among the pairs that made it.

    With p(y_p) as in `Observation.shares`, returns sums of log p(y_p) by tile, (T,) float64; of T_end / p(y_p) by label
    of each tile, float64 as `labels.present`; and of w / p(y_p) by entry and label, (slot_start[-1],) float32. Each
    term counts by the weight of its pixel.
    """
    logs, left_over = np.zeros(len(records)), np.zeros(len(labels.present))
    sums = np.empty(slot_start[-1], np.float32)
    for turn in nb.prange(tiles.rows * tiles.columns):
        tile = tile_of_turn(tiles, turn)
        here = slice(labels.start[tile], labels.start[tile + 1])
        count = here.stop - here.start
        if count == 0:
            continue
        spans = labels.span_start[tile * TILE : tile * TILE + TILE + 1]
        own, of_entry = slice(tiles.start[tile], tiles.start[tile + 1]), slice(slot_start[tile], slot_start[tile + 1])
        rays, value = np.empty((TILE, TILE), np.float32), np.zeros((TILE, TILE), np.float32)
        weights = np.empty((records[tile], TILE), np.float32)
        left, top, _ = open_rays(tiles, tile, rays)
        _blend_likelihood(
            left, top, tiles.table, tiles.entries[own], blocks[own], count, spans, labels, pair[of_entry], likelihood,
            rays, value, weights,
        )  # fmt: skip
        of_label = rest[labels.present[here]]
        logs[tile] = invert(spans, labels, labels.weights[tile], of_label, rays, value, left_over[here])
        sum_shares(blocks[own], count, spans, labels, value, weights, sums[of_entry])
    return logs, left_over, sums


@called_by_kernels(fastmath=simd.FAST, error_model="numpy")
def _blend_likelihood(
    left: float, top: float, table: np.ndarray,  # (M, 8)
    entries: np.ndarray, blocks: np.ndarray, label_count: int,  # (E_t,), (E_t,) of this tile
    spans: np.ndarray, labels: Labels, pair: np.ndarray, likelihood: np.ndarray,  # (17,), (E_t * label_count,), (P,)
    rays: np.ndarray, value: np.ndarray,  # (16, 16) in and out; (16, 16) in: zeros; out: W likelihood
    weights: np.ndarray,  # (R, 16) out
) -> None:  # fmt: skip
    lines = np.empty((2, TILE), np.float32)
    n = 0
    for e in range(entries.shape[0]):
        later = min(e + simd.AHEAD, entries.shape[0] - 1)
        simd.prefetch(table, entries[later])
        simd.prefetch(likelihood, max(pair[later * label_count], 0))
        g, todo = entries[e], np.int64(blocks[e])
        aim(table, g, left, top, lines, 0)
        only = likelihood[pair[e * label_count]] if label_count == 1 else np.float32(0.0)
        while todo:
            b = simd.first_bit(todo)
            todo &= todo - 1
            weight, _ = lift_block(rays, b, lines, 0, table[g, WIDTH])
            simd.store_row(weights, n, weight)
            n += 1
            total = simd.load_row(value, b)
            if label_count == 1:
                total = simd.add_scaled(total, weight, only)
            else:
                for span in range(spans[b], spans[b + 1]):
                    # Where there is no pair, the weights are zero.
                    s = max(pair[e * label_count + labels.slots[span]], 0)
                    more = simd.add_scaled(total, weight, likelihood[s])
                    total = simd.where(np.int64(labels.lanes[span]), more, total)
            simd.store_row(value, b, total)


@called_by_kernels(error_model="numpy")
def invert(
    spans: np.ndarray, labels: Labels, weights: np.ndarray,  # (17,); (16,) of blocks
    rest: np.ndarray, rays: np.ndarray,  # (L_t,), (16, 16)
    value: np.ndarray,  # (16, 16) in: W likelihood; out: weight / likelihood, 0 where there is no label
    spare: np.ndarray,  # (L_t,) in: zeros; out: sum of T_end / likelihood
) -> float:  # fmt: skip
    """Divide by the likelihood of each pixel of a tile; returns the sum of their logarithms."""
    total = 0.0
    for b in range(TILE):
        known = np.int64(0)
        for span in range(spans[b], spans[b + 1] if weights[b] > 0 else spans[b]):
            known |= np.int64(labels.lanes[span])
            # Each likelihood is at least 1e-30 and at most about 1: products of eight stay within a float64.
            product, s = 1.0, labels.slots[span]
            for i in range(TILE):
                if labels.lanes[span] >> i & 1:
                    p = value[b, i] + rest[s] * rays[b, i]
                    # A pixel that nothing explains has no share to give, at any codes; its term is held at a floor.
                    product *= np.float64(max(p, _TINY))
                    value[b, i] = weights[b] / p if p > _TINY else 0.0
                    spare[s] += rays[b, i] * value[b, i]
                if i == TILE // 2 - 1:
                    total += weights[b] * np.log(product)
                    product = 1.0
            total += weights[b] * np.log(product)
        for i in range(TILE):
            if not known >> i & 1:
                value[b, i] = 0.0
    return total


@called_by_kernels(fastmath=simd.FAST)
def sum_shares(
    blocks: np.ndarray, label_count: int, spans: np.ndarray, labels: Labels,  # (E_t,), (17,)
    inverse: np.ndarray, weights: np.ndarray, sums: np.ndarray,  # (16, 16), (R, 16), (E_t * label_count,) out
) -> None:  # fmt: skip
    """Sum weight / likelihood over the pixels of a tile, by entry and label."""
    sums[:] = 0.0
    n = 0
    for e in range(blocks.shape[0]):
        # Lane by lane, as long as the label stays the same: most blocks have one label, and most entries too.
        current, lanewise = np.int64(-1), simd.zero_row()
        todo = np.int64(blocks[e])
        while todo:
            b = simd.first_bit(todo)
            todo &= todo - 1
            weight = simd.load_row(weights, n)
            n += 1
            if label_count == 1:
                current, lanewise = np.int64(0), simd.add_product(lanewise, weight, simd.load_row(inverse, b))
                continue
            for span in range(spans[b], spans[b + 1]):
                if labels.slots[span] != current:
                    if current >= 0:
                        sums[e * label_count + current] += simd.sum_row(lanewise)
                    current, lanewise = np.int64(labels.slots[span]), simd.zero_row()
                more = simd.add_product(lanewise, weight, simd.load_row(inverse, b))
                lanewise = simd.where(np.int64(labels.lanes[span]), more, lanewise)
        if current >= 0:
            sums[e * label_count + current] += simd.sum_row(lanewise)


@kernel(parallel=True)
def add_up(slot_start: np.ndarray, pair: np.ndarray, sums: np.ndarray, num_pairs: int) -> np.ndarray:
    """Add up what `share` summed for each pair, in tile order: (PARTS, P) float32, of each part of the image."""
    tiles, parts = slot_start.shape[0] - 1, np.zeros((PARTS, num_pairs), np.float32)
    last = pair.shape[0] - 1
    for part in nb.prange(PARTS):
        total = parts[part]
        for i in range(slot_start[part * tiles // PARTS], slot_start[(part + 1) * tiles // PARTS]):
            simd.prefetch(total, max(pair[min(i + 2 * simd.AHEAD, last)], 0))
            if pair[i] >= 0:
                total[pair[i]] += sums[i]
    return parts
