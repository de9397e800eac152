"""The objects of a view, each as if it stood there alone: what speaks for and against each Gaussian in its object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsseg_core.raster.cpu import silhouette_kernels
from gsseg_core.raster.cpu.tiling import Tiles
from gsseg_core.spatial.row_order import take_rows


@dataclass(frozen=True, eq=False)
class ObjectsAlone:
    """The Gaussians of a view that belong to an object; the others take neither time nor memory.

    Attributes
    ----------
    ids : (M,) int32
        Those that reach a tile, as indices in the scene, in the order in which tiles meet them: what one tile needs
        lies close together.
    labels : (M,) int32
        Object of each, above 0.
    tiles : Tiles
        Of these alone, without what is told by Gaussian.
    """

    ids: np.ndarray
    labels: np.ndarray
    tiles: Tiles

    @classmethod
    def of(cls, ids: np.ndarray, tiles: Tiles, labels: np.ndarray) -> ObjectsAlone:
        """Choose them among the Gaussians of a view, `ids` (M',), by the labels (N,) int32 of the whole scene."""
        start, entries, rows = silhouette_kernels.choose(tiles.start, tiles.entries, labels[ids])
        ids, none = ids[rows], np.empty(0, np.int32)
        return cls(ids, labels[ids], tiles._replace(
            table=take_rows(tiles.table, rows), start=start, entries=entries,
            gaussian_start=none.astype(np.int64), gaussian_entries=none,
        ))  # fmt: skip

    @property
    def nbytes(self) -> int:
        """Bytes that they take."""
        return sum(array.nbytes for array in (self.ids, self.labels, *self.tiles[4:]))

    def reasons_to_go(self, depths: np.ndarray, shown: np.ndarray, hidden_from: np.ndarray) -> np.ndarray:
        """Weigh what speaks against each Gaussian in its object, were the object alone in the view.

        Parameters
        ----------
        depths : (M,) float32
            Depth of each Gaussian, in scene units.
        shown : (H, W) int32
            Object that the view shows in each pixel, negative where unknown.
        hidden_from : (H, W) float32
            Depth from which on the pixel hides a Gaussian.

        Returns
        -------
        (M,) float64
            Sum of alpha, in px, over the pixels that show another object and do not hide the Gaussian.
        """
        go = np.zeros(len(self.tiles.entries), np.float32)
        silhouette_kernels.reasons_to_go(self.tiles, self.labels, depths, shown, hidden_from, go)
        return np.bincount(self.tiles.entries, go, len(self.ids))

    def reasons_to_stay(self, kept: np.ndarray, asked: np.ndarray, shown: np.ndarray) -> np.ndarray:
        """Weigh what speaks for each Gaussian in its object k, were the object alone in the view.

        Parameters
        ----------
        kept : (M,) float32
            Share of each Gaussian that its object keeps, by which its alphas are multiplied.
        asked : (M,) bool
            Whose reasons are wanted; those of all others are 0. Only the blocks of pixels that these reach are looked
            at.
        shown : (H, W) int32
            As `reasons_to_go` takes it.

        Returns
        -------
        (M,) float64
            Sum of alpha T_k / (1 - T_k), in px, over the pixels that show the object, whose transmittance is T_k; as
            good as 0 where the object lets no light through.
        """
        stay, count = np.zeros(len(self.tiles.entries), np.float32), int(self.labels.max(initial=0)) + 1
        silhouette_kernels.reasons_to_stay(self.tiles, self.labels, count, kept, asked, shown, stay)
        return np.bincount(self.tiles.entries, stay, len(self.ids))
