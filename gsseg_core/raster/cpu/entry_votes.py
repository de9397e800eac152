"""A mask lifted into a view: the weights of every entry, summed by label.

An entry is a Gaussian in one tile. Votes are sums over the entries of each Gaussian, and need no more than this; what
learning needs besides, `TileObservation` makes of it.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from gsseg_core.csr_rows import starts
from gsseg_core.data.label_evidence import LabelEvidence, vote_units
from gsseg_core.raster.constants import CHUNKS
from gsseg_core.raster.cpu.blending import AHEAD
from gsseg_core.raster.cpu.lifting import Labels, cut_labels, lift
from gsseg_core.raster.cpu.tiling import Tiles
from gsseg_core.scene.camera import Camera
from gsseg_core.simd import prefetch

WAITING = 64
"""Votes that are put together before they are counted: where they go has come into the cache by then."""


class LiftedMask:
    """Weights of one view, summed by entry and label.

    Attributes
    ----------
    classes : (L,) int32
        Labels that occur in the mask, ascending.
    areas : (L,) int64
        Pixels of each label.
    labels : Labels
        The mask cut into tiles; labels are positions in `classes`.
    slot_start : (T + 1,) int64
        Where the sums of each tile begin: one for each entry and each label of the tile.
    reached : (E,) uint16
        Blocks with a label in which the entry has a weight, one bit each.
    sums : (slot_start[-1],) float32
        Sum of weights, in px.
    counts : (T, 3) int64
        Entries with such a block, their blocks, sums above zero.
    """

    def __init__(
        self,
        camera: Camera,
        table: np.ndarray,  # (M, 8)
        tiles: Tiles,
        labels: np.ndarray,  # (H, W)
    ) -> None:
        labels = np.ascontiguousarray(labels, np.int32)
        start, present, *spans, areas = cut_labels(labels, tiles.columns, tiles.rows, int(labels.max(initial=0)) + 1)
        self.classes = np.flatnonzero(areas).astype(np.int32)
        self.areas = areas[self.classes]
        position = np.zeros(len(areas), np.int32)
        position[self.classes] = np.arange(len(self.classes))
        self.labels = mask = Labels(start, position[present], *spans)
        self.slot_start = starts(np.diff(tiles.start) * np.diff(mask.start))
        self.reached = np.empty(len(tiles.entries), np.uint16)
        self.sums, self.counts = np.empty(self.slot_start[-1], np.float32), np.empty((len(mask.start) - 1, 3), np.int64)
        lift(
            tiles.columns, camera.width, camera.height, table, tiles.start, tiles.entries,
            mask.start, mask.span_start, mask.slots, mask.lanes, self.slot_start, self.reached, self.sums, self.counts,
        )  # fmt: skip

    @property
    def sees(self) -> bool:
        """Whether a labelled pixel sees any Gaussian."""
        return bool(self.counts[:, 0].any())

    def vote(
        self,
        ids: np.ndarray,  # (M,)
        tiles: Tiles,
        evidence: LabelEvidence,
        total: np.ndarray,  # (N, K) int64, added to
        units: float,
        sign: int,
    ) -> None:
        """Add the votes to those of other views, bit for bit as `raster.votes.add_votes` does with pairs."""
        if not len(self.classes):
            return
        said, mask = np.empty((len(self.reached), 2), np.float32), self.labels
        count = np.diff(mask.start)
        facts = np.stack([count, self.slot_start[:-1] - tiles.start[:-1] * count, mask.start[:-1]], axis=1)
        _put_beside(tiles.start, facts, self.sums, mask.present, said)
        _vote(
            ids, tiles.gaussian_start, tiles.gaussian_entries, said, facts, self.sums, mask.present, len(self.classes),
            *evidence.votes, units, sign, total,
        )  # fmt: skip


@nb.njit(parallel=True, nogil=True, cache=True)
def _put_beside(
    start: np.ndarray,  # (T + 1,)
    tiles: np.ndarray,  # (T, 3), as in `_vote`
    sums: np.ndarray,
    present: np.ndarray,
    said: np.ndarray,  # (E, 2) float32 out
) -> None:
    """Put beside each other what an entry says, in one place of memory: its label and its sum of weights.

    Where it says several labels, there is -1 less the tile instead of one, in whose sums they are found.
    """
    for tile in nb.prange(start.shape[0] - 1):
        count, base, labels = tiles[tile, 0], tiles[tile, 1], tiles[tile, 2]
        if count == 1:
            only = np.float32(present[labels])
            for e in range(start[tile], start[tile + 1]):
                said[e, 0], said[e, 1] = only, sums[e + base]
            continue
        for e in range(start[tile], start[tile + 1]):
            label, weight, found = np.float32(0), np.float32(0), 0
            for j in range(count):
                if sums[e * count + base + j] > 0:
                    label, weight = np.float32(present[labels + j]), sums[e * count + base + j]
                    found += 1
            said[e, 0], said[e, 1] = label if found < 2 else np.float32(-1 - tile), weight


@nb.njit(parallel=True, nogil=True, cache=True)
def _vote(
    ids: np.ndarray,  # (M,) int32, distinct
    gaussian_start: np.ndarray,  # (M + 1,)
    gaussian_entries: np.ndarray,  # (E,)
    said_by: np.ndarray,  # (E, 2) from `_put_beside`
    tiles: np.ndarray,  # (T, 3) int64: how many labels; sums of entry e begin at e times these plus this; first label
    sums: np.ndarray,
    present: np.ndarray,
    num_labels: int,
    said_start: np.ndarray,  # (L + 1,) what a pixel of each label votes, as `CSRRows`
    said_classes: np.ndarray,
    said: np.ndarray,  # float64
    units: float,  # per vote; a power of 2
    sign: int,
    total: np.ndarray,  # (N, K) int64, added to
) -> None:
    count, last = ids.shape[0], gaussian_entries.shape[0] - 1
    flat, classes = total.reshape(-1), total.shape[1]
    for chunk in nb.prange(CHUNKS):
        first, end = chunk * count // CHUNKS, (chunk + 1) * count // CHUNKS
        seen, place = np.full(num_labels, -1, np.int64), np.zeros(num_labels, np.int64)
        who, labels = np.empty(WAITING + num_labels, np.int32), np.empty(WAITING + num_labels, np.int32)
        votes, n = np.empty(WAITING + num_labels, np.float32), 0
        for g in range(first, end):
            # Most Gaussians say one label in all their tiles: nothing is decided for those.
            name, vote, alone = np.float32(0), np.float32(0), True
            for i in range(gaussian_start[g], gaussian_start[g + 1]):
                prefetch(said_by, gaussian_entries[min(i + 2 * AHEAD, last)])
                e = gaussian_entries[i]
                weight = said_by[e, 1]
                name = name if vote > 0 else said_by[e, 0]
                alone &= (weight == 0) | ((said_by[e, 0] == name) & (name >= 0))
                vote += weight
            if alone:
                label = int(max(name, np.float32(0)))
                who[n], labels[n], votes[n] = ids[g], label, vote
                n += int(vote > 0)
                if said_start[label] < said_start[label + 1]:
                    prefetch(flat, ids[g] * classes + said_classes[said_start[label]])
            else:
                for i in range(gaussian_start[g], gaussian_start[g + 1]):
                    e = gaussian_entries[i]
                    tile = int(-1 - said_by[e, 0])
                    slots = int(tiles[tile, 0]) if tile >= 0 else 1
                    for j in range(slots if said_by[e, 1] > 0 else 0):
                        weight = sums[e * slots + tiles[tile, 1] + j] if tile >= 0 else said_by[e, 1]
                        if not weight > 0:
                            continue
                        label = int(present[tiles[tile, 2] + j] if tile >= 0 else said_by[e, 0])
                        if seen[label] != g:
                            seen[label], place[label] = g, n
                            who[n], labels[n], votes[n] = ids[g], label, 0.0
                            n += 1
                            if said_start[label] < said_start[label + 1]:
                                prefetch(flat, ids[g] * classes + said_classes[said_start[label]])
                        votes[place[label]] += weight
            if n < WAITING and g < end - 1:
                continue
            for s in range(n):
                row = total[who[s]]
                for z in range(said_start[labels[s]], said_start[labels[s] + 1]):
                    row[said_classes[z]] += sign * vote_units(votes[s], said[z], units)
            n = 0
