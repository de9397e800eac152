"""Votes of a view straight from the sums of its entries, where no observation of it is needed."""

from __future__ import annotations

import numba as nb
import numpy as np

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.label_evidence import LabelEvidence, vote_units
from gsseg_core.kernels.compiler import kernel
from gsseg_core.raster.constants import CHUNKS
from gsseg_core.raster.cpu.lifting import Lifted
from gsseg_core.raster.cpu.tiling import Tiles
from gsseg_core.simd import AHEAD, prefetch

WAITING = 64  # votes that are put together before they are counted: where they go has come into the cache by then


def add_entry_votes(
    total: np.ndarray, ids: np.ndarray,  # (N, K) int64, added to; (M,) int32, distinct
    tiles: Tiles, lifted: Lifted, evidence: LabelEvidence, units: float, sign: int,  # units per vote; a power of 2
) -> None:  # fmt: skip
    """Add a view's votes to those of others, bit for bit as `raster.observation.add_votes` does with pairs."""
    if not len(lifted.classes):
        return
    labels = lifted.labels
    count = np.diff(labels.start)
    facts = np.stack([count, lifted.slot_start[:-1] - tiles.start[:-1] * count, labels.start[:-1]], axis=1)
    votes = _pack(tiles.start, facts, lifted.sums, labels.present)
    _vote(total, ids, tiles, facts, votes, lifted.sums, labels.present, evidence.votes, units, sign)


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
def _vote(
    total: np.ndarray, ids: np.ndarray, tiles: Tiles,  # (N, K) int64, added to; (M,) int32
    facts: np.ndarray, entry_votes: np.ndarray, sums: np.ndarray, present: np.ndarray,  # as in `_pack`
    label_votes: CSRRows, units: float, sign: int,  # L rows, float64: what a pixel of each label votes
) -> None:  # fmt: skip
    count, last, num_labels = ids.shape[0], tiles.gaussian_entries.shape[0] - 1, label_votes.indptr.shape[0] - 1
    flat, classes = total.reshape(-1), total.shape[1]
    for chunk in nb.prange(CHUNKS):
        first, end = chunk * count // CHUNKS, (chunk + 1) * count // CHUNKS
        seen, place = np.full(num_labels, -1, np.int64), np.zeros(num_labels, np.int64)
        who, labels = np.empty(WAITING + num_labels, np.int32), np.empty(WAITING + num_labels, np.int32)
        votes, n = np.empty(WAITING + num_labels, np.float32), 0
        for g in range(first, end):
            # Most Gaussians have one label in all their tiles: nothing is decided for those.
            name, vote, alone = np.float32(0), np.float32(0), True
            for i in range(tiles.gaussian_start[g], tiles.gaussian_start[g + 1]):
                prefetch(entry_votes, tiles.gaussian_entries[min(i + 2 * AHEAD, last)])
                e = tiles.gaussian_entries[i]
                weight = entry_votes[e, 1]
                name = name if vote > 0 else entry_votes[e, 0]
                alone &= (weight == 0) | ((entry_votes[e, 0] == name) & (name >= 0))
                vote += weight
            if alone:
                label = int(max(name, np.float32(0)))
                who[n], labels[n], votes[n] = ids[g], label, vote
                n += int(vote > 0)
                _fetch(flat, classes, ids[g], label, label_votes)
            else:
                for i in range(tiles.gaussian_start[g], tiles.gaussian_start[g + 1]):
                    e = tiles.gaussian_entries[i]
                    tile = int(-1 - entry_votes[e, 0])
                    slots = int(facts[tile, 0]) if tile >= 0 else 1
                    for j in range(slots if entry_votes[e, 1] > 0 else 0):
                        weight = sums[e * slots + facts[tile, 1] + j] if tile >= 0 else entry_votes[e, 1]
                        if not weight > 0:
                            continue
                        label = int(present[facts[tile, 2] + j] if tile >= 0 else entry_votes[e, 0])
                        if seen[label] != g:
                            seen[label], place[label] = g, n
                            who[n], labels[n], votes[n] = ids[g], label, 0.0
                            n += 1
                            _fetch(flat, classes, ids[g], label, label_votes)
                        votes[place[label]] += weight
            if n < WAITING and g < end - 1:
                continue
            for s in range(n):
                row = total[who[s]]
                for z in range(label_votes.indptr[labels[s]], label_votes.indptr[labels[s] + 1]):
                    row[label_votes.indices[z]] += sign * vote_units(votes[s], label_votes.data[z], units)
            n = 0


@nb.njit(inline="always")
def _fetch(flat: np.ndarray, classes: int, i: int, label: int, label_votes: CSRRows) -> None:
    """Ask for where the first vote of a label for a Gaussian goes."""
    if label_votes.indptr[label] < label_votes.indptr[label + 1]:
        prefetch(flat, i * classes + label_votes.indices[label_votes.indptr[label]])
