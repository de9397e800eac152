"""A mask lifted into a view: the weights of every entry, summed by label.

An entry is a Gaussian in one tile. Votes are sums over the entries of each Gaussian, and need no more than this; what
learning needs besides, `TileObservation` makes of it.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from gsseg_core.blend import AHEAD
from gsseg_core.cameras import Camera
from gsseg_core.lanes import prefetch
from gsseg_core.lift import Labels, cut_labels, lift
from gsseg_core.meaning import Meaning
from gsseg_core.rows import starts
from gsseg_core.tiles import Tiles

CHUNKS = 16
"""Parts of the Gaussians that are gone through beside each other."""

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
        areas = np.bincount(np.maximum(labels, -1).ravel() + 1, minlength=1)[1:]
        self.classes = np.flatnonzero(areas).astype(np.int32)
        self.areas = areas[self.classes]
        self.labels = mask = _cut(labels, self.classes, tiles)
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
        meaning: Meaning,
        total: np.ndarray,  # (N, K) int64, added to
        units: float,
        sign: int,
    ) -> None:
        """Add the votes to those of other views, bit for bit as `sightings.add_votes` does with sightings."""
        where, mask = np.empty(len(self.reached), np.int32), self.labels
        _locate(tiles.start, self.reached, where)
        many = np.diff(mask.start)
        facts = many, self.slot_start[:-1] - tiles.start[:-1] * many, mask.start[:-1]
        _vote(
            ids, tiles.gaussian_start, tiles.gaussian_entries, where, np.stack(facts, axis=1), self.sums, mask.present,
            len(self.classes), *meaning.votes, units, sign, total,
        )  # fmt: skip


def _cut(
    labels: np.ndarray,  # (H, W)
    classes: np.ndarray,  # (L,)
    tiles: Tiles,
) -> Labels:
    """Cut a mask into tiles, its labels numbered as in `classes`."""
    position = np.full(max(classes.max(initial=0) + 1, 1), -1, np.int32)
    position[classes] = np.arange(len(classes))
    local = np.where(labels >= 0, position[np.maximum(labels, 0)], -1).astype(np.int32)
    return Labels(*cut_labels(local, tiles.columns, tiles.rows, len(classes)))


@nb.njit(parallel=True, nogil=True, cache=True)
def _locate(
    start: np.ndarray,  # (T + 1,)
    reached: np.ndarray,  # (E,)
    where: np.ndarray,  # (E,) int32 out: tile of each entry, -1 where it reaches no labelled pixel
) -> None:
    for tile in nb.prange(start.shape[0] - 1):
        for e in range(start[tile], start[tile + 1]):
            where[e] = tile if reached[e] else -1


@nb.njit(parallel=True, nogil=True, cache=True)
def _vote(
    ids: np.ndarray,  # (M,) int32, distinct
    gaussian_start: np.ndarray,  # (M + 1,)
    gaussian_entries: np.ndarray,  # (E,)
    where: np.ndarray,  # (E,) int32
    tiles: np.ndarray,  # (T, 3) int64: how many labels; sums of entry e begin at e times these plus this; first label
    sums: np.ndarray,
    present: np.ndarray,
    num_labels: int,
    said_start: np.ndarray,  # (L + 1,) what a pixel of each label votes, as `Rows`
    said_classes: np.ndarray,
    said: np.ndarray,  # float64
    units: float,  # per vote; a power of 2
    sign: int,
    total: np.ndarray,  # (N, K) int64, added to
) -> None:
    many, last = ids.shape[0], gaussian_entries.shape[0] - 1
    flat, classes = total.reshape(-1), total.shape[1]
    for chunk in nb.prange(CHUNKS):
        first, end = chunk * many // CHUNKS, (chunk + 1) * many // CHUNKS
        seen, place = np.full(num_labels, -1, np.int64), np.zeros(num_labels, np.int64)
        who, labels = np.empty(WAITING + num_labels, np.int32), np.empty(WAITING + num_labels, np.int32)
        votes, n = np.empty(WAITING + num_labels, np.float32), 0
        for g in range(first, end):
            for i in range(gaussian_start[g], gaussian_start[g + 1]):
                prefetch(where, gaussian_entries[min(i + 2 * AHEAD, last)])
                later = gaussian_entries[min(i + AHEAD, last)]
                facts = tiles[max(where[later], 0)]
                prefetch(sums, later * facts[0] + facts[1])
                e = gaussian_entries[i]
                if where[e] < 0:
                    continue
                facts = tiles[where[e]]
                for j in range(facts[0]):
                    weight = sums[e * facts[0] + facts[1] + j]
                    if not weight > 0:
                        continue
                    label = present[facts[2] + j]
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
                    row[said_classes[z]] += sign * np.int64(np.rint(np.float64(votes[s]) * said[z] * units))
            n = 0
