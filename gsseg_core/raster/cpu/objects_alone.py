"""The objects of a view, each as if it stood there alone, on the CPU."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsseg_core.raster.cpu import silhouette_kernels
from gsseg_core.raster.cpu.tiling import Tiles
from gsseg_core.raster.objects_alone import ObjectsAlone
from gsseg_core.spatial.row_order import take_rows


@dataclass(frozen=True, eq=False)
class TileObjects(ObjectsAlone):
    """They come in the order in which tiles meet them: what one tile needs lies close together."""

    ids: np.ndarray
    labels: np.ndarray  # (M,) int32: object of each, above 0
    tiles: Tiles  # of these alone, without what is told by Gaussian

    @classmethod
    def of(cls, ids: np.ndarray, tiles: Tiles, labels: np.ndarray) -> TileObjects:
        """Choose them among the Gaussians of a view, `ids` (M',), by the labels (N,) int32 of the whole scene."""
        labels = labels[ids]
        start, entries, rows = silhouette_kernels.choose(tiles.start, tiles.entries, labels)
        return cls(ids[rows], labels[rows], Tiles(*tiles[:5], take_rows(tiles.table, rows), start, entries))

    @property
    def nbytes(self) -> int:
        """Bytes that they take."""
        return sum(array.nbytes for array in (self.ids, self.labels, *self.tiles[5:]))

    def reasons_to_go(self, depths: np.ndarray, shown: np.ndarray, hidden_from: np.ndarray) -> np.ndarray:
        """Weigh what speaks against each Gaussian in its object."""
        go = silhouette_kernels.reasons_to_go(self.tiles, self.labels, depths, shown, hidden_from)
        return silhouette_kernels.sums(self.tiles.entries, go, len(self.ids))

    def reasons_to_stay(self, kept: np.ndarray, asked: np.ndarray, shown: np.ndarray) -> np.ndarray:
        """Weigh what speaks for each Gaussian in its object."""
        count = int(self.labels.max(initial=0)) + 1
        stay = silhouette_kernels.reasons_to_stay(self.tiles, self.labels, count, kept, asked, shown)
        return silhouette_kernels.sums(self.tiles.entries, stay, len(self.ids))
