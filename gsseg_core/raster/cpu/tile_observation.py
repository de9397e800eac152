"""A view with its mask on the CPU: lifted once, and then only what was seen."""

from __future__ import annotations

import numpy as np

from gsseg_core.csr_rows import starts
from gsseg_core.raster.constants import CHUNKS
from gsseg_core.raster.cpu import label_pairs
from gsseg_core.raster.cpu.lifting import Lifted
from gsseg_core.raster.cpu.tiling import Tiles
from gsseg_core.raster.observation import Observation, VoteShares


class TileObservation(Observation):
    """W of one view, cut down to the Gaussians that its labelled pixels see; remade from them in every product.

    Holds about 48 bytes per Gaussian that is seen and 18 per tile in which it is.
    """

    def __init__(self, name: str, ids: np.ndarray, tiles: Tiles, lifted: Lifted) -> None:  # ids (M,)
        self.name, self.classes, self.areas, self._mask = name, lifted.classes, lifted.areas, lifted.labels
        label_count, counts = np.diff(self._mask.start), lifted.counts
        start, self._slot_start = starts(counts[:, 0]), starts(counts[:, 0] * label_count)
        self._records = counts[:, 1].copy()
        kept, self._blocks = label_pairs.keep_entries(tiles.start, lifted.reached, start)
        # A Gaussian has at most as many labels as sums, and each entry one sum, but for so many in all:
        extra = counts[:, 2].sum() - counts[:, 0].sum()
        chunks = np.arange(CHUNKS + 1) * len(ids) // CHUNKS
        capacity = tiles.gaussian_start[chunks] + extra * np.arange(len(chunks))
        begins = (tiles.start, lifted.slot_start, start, self._slot_start, self._mask.start)
        facts = np.stack([*(begin[:-1] for begin in begins), label_count], axis=1)
        entries, self._pair = np.empty(start[-1], np.int32), np.empty(self._slot_start[-1], np.int32)
        found, gaussians, label_counts, labels, votes = label_pairs.number_pairs(
            tiles, kept, facts, lifted.sums, self._mask.present, len(self.classes), capacity, entries, self._pair
        )
        before = np.cumsum(found, axis=0) - found
        label_pairs.renumber(entries, before[:, 0])
        label_pairs.renumber(self._pair, before[:, 1])
        seen = _joined(gaussians, chunks, found[:, 0])
        self.ids, self.start = ids[seen], starts(_joined(label_counts, chunks, found[:, 0]))
        self.labels, self._votes = _joined(labels, capacity, found[:, 1]), _joined(votes, capacity, found[:, 1])
        table, none = label_pairs.take(tiles.table, seen), np.empty(0, np.int64)
        self._tiles = tiles._replace(
            table=table, start=start, entries=entries, gaussian_start=none, gaussian_entries=none.astype(np.int32)
        )
        self._answered: tuple[np.ndarray, np.ndarray, VoteShares] | None = None

    @property
    def nbytes(self) -> int:
        """Memory that it holds, in bytes."""
        held = (self.ids, self.start, self.labels, self._votes, *self._tiles[4:], self._blocks, self._records,
                self._slot_start, self._pair, *self._mask)  # fmt: skip
        # The ids once more for `order`; and what `shares` was asked last, and answered.
        return sum(array.nbytes for array in held) + self.ids.nbytes + 2 * self._votes.nbytes

    def votes(self) -> np.ndarray:
        """Weights summed by pair, (P,) float32."""
        return self._votes

    def _shares(self, likelihood: np.ndarray, rest: np.ndarray) -> VoteShares:
        if self._answered is not None and all(map(np.array_equal, self._answered[:2], (likelihood, rest))):
            return self._answered[2]  # a refit begins with what the last step asked
        slots = self._slot_start, self._pair
        logs, left_over, sums = label_pairs.share(
            self._tiles, self._mask, self._blocks, self._records, *slots, likelihood, rest
        )
        pairs = label_pairs.add_up(*slots, sums, len(likelihood)).sum(axis=0)
        total = np.bincount(self._mask.present, weights=left_over, minlength=len(rest))
        shares = VoteShares(pairs, total, float(logs.sum()))
        self._answered = likelihood.copy(), rest.copy(), shares
        return shares


def _joined(
    values: np.ndarray, begins: np.ndarray, counts: np.ndarray  # (CHUNKS + 1,), (CHUNKS,)
) -> np.ndarray:  # fmt: skip
    """Put together what each chunk has written to its own part of the values."""
    return np.concatenate([values[begin : begin + count] for begin, count in zip(begins, counts, strict=False)])
