"""The pairs of a view and their votes straight from the sums of its entries, where no observation of it is needed."""

from __future__ import annotations

import numba as nb
import numpy as np

from gsseg_core.kernels.compiler import kernel
from gsseg_core.raster.constants import CHUNKS
from gsseg_core.raster.cpu.lifting import Lifted
from gsseg_core.raster.cpu.tiling import Tiles
from gsseg_core.raster.vote_total import PairVotes
from gsseg_core.simd import AHEAD, prefetch


def pair_votes(ids: np.ndarray, tiles: Tiles, lifted: Lifted) -> PairVotes:  # (M,) int32, distinct
    """List the pairs of a view and their votes, to the last bit as `label_pairs.number_pairs` does.

    Where thousands of labels are in a view, that takes longer than a sort of all sums; of as many as masks have, less.
    """
    labels = lifted.labels
    count = np.diff(labels.start)
    facts = np.stack([count, lifted.slot_start[:-1] - tiles.start[:-1] * count, labels.start[:-1]], axis=1)
    packed = _pack(tiles.start, facts, lifted.sums, labels.present)
    capacity = lifted.room_for_pairs(tiles)
    return _list_pairs(ids, tiles, facts, packed, lifted.sums, labels.present, len(lifted.classes), capacity)


@kernel(parallel=True)
def _pack(start: np.ndarray, facts: np.ndarray, sums: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Pack the vote of each entry, (E, 2) float32: its label and the weight, so that one look in memory finds both.

    An entry with several labels has -1 - tile in place of one: its votes are looked up in the sums of that tile. Facts
    of each tile, (T, 3) int64: the number of its labels, L; what to add to e * L for the first sum of entry e; and the
    place of its first label in `present`.
    """
    votes = np.empty((start[-1], 2), np.float32)
    for tile in nb.prange(start.shape[0] - 1):
        count, base, labels = facts[tile, 0], facts[tile, 1], facts[tile, 2]
        if count == 1:
            only = np.float32(present[labels])
            for e in range(start[tile], start[tile + 1]):
                votes[e, 0], votes[e, 1] = only, sums[e + base]
            continue
        for e in range(start[tile], start[tile + 1]):
            label, weight, found = np.float32(0), np.float32(0), 0
            for j in range(count):
                if sums[e * count + base + j] > 0:
                    label, weight = np.float32(present[labels + j]), sums[e * count + base + j]
                    found += 1
            votes[e, 0], votes[e, 1] = label if found < 2 else np.float32(-1 - tile), weight
    return votes


@kernel(parallel=True)
def _list_pairs(
    ids: np.ndarray, tiles: Tiles,  # (M,) int32
    facts: np.ndarray, packed: np.ndarray, sums: np.ndarray, present: np.ndarray,  # as in `_pack`, and made by it
    num_labels: int, capacity: np.ndarray,  # (CHUNKS + 1,) where each chunk's pairs begin; there is more than needed
) -> PairVotes:  # fmt: skip
    """Sum up the votes of each Gaussian and label."""
    count, last = ids.shape[0], tiles.gaussian_entries.shape[0] - 1
    who, labels = np.empty(capacity[-1], np.int32), np.empty(capacity[-1], np.int32)
    votes, parts = np.empty(capacity[-1], np.float32), np.empty((CHUNKS, 2), np.int64)
    for chunk in nb.prange(CHUNKS):
        seen, place, n = np.full(num_labels, -1, np.int64), np.zeros(num_labels, np.int64), capacity[chunk]
        for g in range(chunk * count // CHUNKS, (chunk + 1) * count // CHUNKS):
            # Most Gaussians have one label in all their tiles: nothing is decided for those.
            name, vote, alone = np.float32(0), np.float32(0), True
            for i in range(tiles.gaussian_start[g], tiles.gaussian_start[g + 1]):
                prefetch(packed, tiles.gaussian_entries[min(i + 2 * AHEAD, last)])
                e = tiles.gaussian_entries[i]
                weight = packed[e, 1]
                name = name if vote > 0 else packed[e, 0]
                alone &= (weight == 0) | ((packed[e, 0] == name) & (name >= 0))
                vote += weight
            if alone:
                who[n], labels[n], votes[n] = ids[g], int(max(name, np.float32(0))), vote
                n += int(vote > 0)
                continue
            for i in range(tiles.gaussian_start[g], tiles.gaussian_start[g + 1]):
                e = tiles.gaussian_entries[i]
                tile = int(-1 - packed[e, 0])
                slots = int(facts[tile, 0]) if tile >= 0 else 1
                for j in range(slots if packed[e, 1] > 0 else 0):
                    weight = sums[e * slots + facts[tile, 1] + j] if tile >= 0 else packed[e, 1]
                    if not weight > 0:
                        continue
                    label = int(present[facts[tile, 2] + j] if tile >= 0 else packed[e, 0])
                    if seen[label] != g:
                        seen[label], place[label] = g, n
                        who[n], labels[n], votes[n] = ids[g], label, 0.0
                        n += 1
                    votes[place[label]] += weight
        parts[chunk, 0], parts[chunk, 1] = capacity[chunk], n
    return PairVotes(who, labels, votes, parts)
