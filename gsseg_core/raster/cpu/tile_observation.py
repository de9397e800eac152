"""A view with its mask on the CPU: lifted once, and then only what was seen."""

from __future__ import annotations

import numpy as np

from gsseg_core.csr_rows import starts
from gsseg_core.errors import SceneValueError
from gsseg_core.raster.constants import CHUNKS
from gsseg_core.raster.cpu import label_pairs
from gsseg_core.raster.cpu.lifted_mask import LiftedMask
from gsseg_core.raster.cpu.tiling import Tiles
from gsseg_core.raster.observation import Observation, VoteShares
from gsseg_core.scene.camera import Camera


class TileObservation(Observation):
    """W of one view, cut down to the Gaussians that its labelled pixels see; remade from them in every product.

    Holds about 48 bytes per Gaussian that is seen and 18 per tile in which it is.
    """

    def __init__(
        self,
        camera: Camera,
        ids: np.ndarray,  # (M,)
        table: np.ndarray,  # (M, 8)
        tiles: Tiles,
        lifted: LiftedMask,
    ) -> None:
        self._camera, self._columns = camera, tiles.columns
        self.classes, self.areas, self._labels = lifted.classes, lifted.areas, lifted.labels
        self._number(ids, table, tiles, lifted)
        self._answered: tuple[np.ndarray, np.ndarray, VoteShares] | None = None

    def _number(self, ids: np.ndarray, table: np.ndarray, tiles: Tiles, lifted: LiftedMask) -> None:
        mask, slot_start, counts = lifted.labels, lifted.slot_start, lifted.counts
        label_count = np.diff(mask.start)
        self._start, self._slot_start = starts(counts[:, 0]), starts(counts[:, 0] * label_count)
        self._records = counts[:, 1].copy()
        kept, self._blocks = np.empty((len(lifted.reached), 2), np.int32), np.empty(self._start[-1], np.uint16)
        label_pairs.keep_entries(tiles.start, lifted.reached, self._start, kept, self._blocks)

        # A Gaussian has at most as many labels as sums, and each entry one sum, but for so many in all:
        extra = counts[:, 2].sum() - counts[:, 0].sum()
        chunks = np.arange(CHUNKS + 1) * len(ids) // CHUNKS
        capacity = tiles.gaussian_start[chunks] + extra * np.arange(len(chunks))
        found = np.empty((CHUNKS, 2), np.int64)
        gaussians, label_counts = np.empty(len(ids), np.int32), np.empty(len(ids), np.int32)
        labels, votes = np.empty(capacity[-1], np.int32), np.empty(capacity[-1], np.float32)
        self._entries, self._pair = np.empty(self._start[-1], np.int32), np.empty(self._slot_start[-1], np.int32)
        begins = (tiles.start, slot_start, self._start, self._slot_start, mask.start)
        label_pairs.number_pairs(
            tiles.gaussian_start, tiles.gaussian_entries, kept,
            np.stack([*(begin[:-1] for begin in begins), label_count], axis=1), lifted.sums, mask.present,
            len(self.classes), capacity, found, gaussians, label_counts, labels, votes, self._entries, self._pair,
        )  # fmt: skip
        before = np.cumsum(found, axis=0) - found
        label_pairs.settle(self._entries, before[:, 0])
        label_pairs.settle(self._pair, before[:, 1])
        seen = _joined(gaussians, chunks, found[:, 0])
        self.ids, self._table = ids[seen], label_pairs.take(table, seen)
        self.start = starts(_joined(label_counts, chunks, found[:, 0]))
        self.labels, self._votes = _joined(labels, capacity, found[:, 1]), _joined(votes, capacity, found[:, 1])

    @property
    def nbytes(self) -> int:
        """Memory that it holds, in bytes."""
        mask = self._labels
        held = (self.ids, self.start, self.labels, self._votes, self._table, self._start, self._entries, self._blocks,
                self._records, self._slot_start, self._pair, mask.start, mask.present, mask.span_start, mask.slots,
                mask.lanes)  # fmt: skip
        # The ids once more for `order`; and what `shares` was asked last, and answered.
        return sum(array.nbytes for array in held) + self.ids.nbytes + 2 * self._votes.nbytes

    def votes(self) -> np.ndarray:
        """Weights summed by pair, (P,) float32."""
        return self._votes

    def shares(
        self,
        said: np.ndarray,  # (P,)
        rest: np.ndarray,  # (L,)
    ) -> VoteShares:
        """Share one vote per labelled pixel among the pairs that made it."""
        said, rest = np.ascontiguousarray(said, np.float32), np.ascontiguousarray(rest, np.float32)
        if said.shape != self.labels.shape or rest.shape != self.classes.shape:
            raise SceneValueError(
                f"view '{self._camera.name}': said and rest have shapes {said.shape} and {rest.shape}; "
                f"expected {self.labels.shape} and {self.classes.shape}"
            )
        if self._answered is not None and all(map(np.array_equal, self._answered[:2], (said, rest))):
            return self._answered[2]  # a refit begins with what the last step asked
        mask, camera = self._labels, self._camera
        logs, left_over = np.zeros(len(self._records)), np.zeros(len(mask.present))
        sums, parts = np.empty(self._slot_start[-1], np.float32), np.empty((label_pairs.PARTS, len(said)), np.float32)
        label_pairs.share(
            self._columns, camera.width, camera.height, self._table, self._start, self._entries, self._blocks,
            self._records, mask.start, mask.present, mask.span_start, mask.slots, mask.lanes, self._slot_start,
            self._pair, said, rest, logs, left_over, sums,
        )  # fmt: skip
        label_pairs.add_up(self._slot_start, self._pair, sums, parts)
        total = np.bincount(mask.present, weights=left_over, minlength=len(rest))
        shares = VoteShares(parts.sum(axis=0), total, float(logs.sum()))
        self._answered = said.copy(), rest.copy(), shares
        return shares


def _joined(
    values: np.ndarray,
    begins: np.ndarray,  # (CHUNKS + 1,)
    counts: np.ndarray,  # (CHUNKS,)
) -> np.ndarray:
    """Put together what each chunk has written to its own part of the values."""
    return np.concatenate([values[begin : begin + count] for begin, count in zip(begins, counts, strict=False)])
