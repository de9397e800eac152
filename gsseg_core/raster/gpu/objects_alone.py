"""The objects of a view, each as if it stood there alone, on a GPU: a block of threads to a tile, a thread to a pixel.

Sums are of whole units, as those of `label_sharing`, so they are the same in every run.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from gsseg_core.data.label_evidence import UNITS
from gsseg_core.raster.constants import T_MIN
from gsseg_core.raster.cpu.objects_alone import ROUNDING
from gsseg_core.raster.cpu.tiling import TILE
from gsseg_core.raster.gpu.blending import (
    BATCH,
    PARTS,
    STRIDE,
    THREADS,
    alpha_of,
    centre_of,
    launch_on_tiles,
    load_batch,
    own_pixel,
)
from gsseg_core.raster.gpu.device import called_by_kernels, cuda, gpu_kernel, on_device, to_cpu
from gsseg_core.raster.gpu.label_sharing import add_units
from gsseg_core.raster.gpu.projection import TileTensors
from gsseg_core.raster.gpu.tensors import starts
from gsseg_core.raster.objects_alone import ObjectsAlone

_NOTHING = np.float32(0)
_ALL = np.float32(1)
_DARK = np.float32(T_MIN / TILE)
_UNKNOWN = np.int32(-1)


@dataclass(frozen=True, eq=False)
class GPUObjects(ObjectsAlone):
    """They come nearest first."""

    tiles: TileTensors  # of these alone, without what is told by Gaussian
    labels: torch.Tensor  # (M,) int32: object of each, above 0

    @classmethod
    def of(cls, tiles: TileTensors, labels: np.ndarray) -> GPUObjects:
        """Choose them among the Gaussians of a view by the labels (N,) int32 of the whole scene."""
        of_ids = on_device(labels, tiles.table.device)[tiles.ids.long()]
        own = of_ids > 0
        kept = own[tiles.entries.long()]
        number, none = own.cumsum(0) - 1, tiles.place[:0]
        tiles = tiles._replace(
            ids=tiles.ids[own], table=tiles.table[own], start=starts(kept)[tiles.start],
            entries=number[tiles.entries[kept].long()].int(), gaussian_start=none, place=none,
        )  # fmt: skip
        return cls(tiles, of_ids[own])

    @cached_property
    def ids(self) -> np.ndarray:  # type: ignore[override] # it is copied from the GPU when somebody asks
        """Those that reach a tile, (M,) int32."""
        return to_cpu(self.tiles.ids)

    @property
    def nbytes(self) -> int:
        """Memory that they hold on the GPU, in bytes."""
        return self.tiles.nbytes + self.labels.nbytes

    def reasons_to_go(self, depths: np.ndarray, shown: np.ndarray, hidden_from: np.ndarray) -> np.ndarray:
        """Weigh what speaks against each Gaussian in its object."""
        return self._sums(_reasons_to_go, depths, shown, hidden_from)

    def reasons_to_stay(self, kept: np.ndarray, asked: np.ndarray, shown: np.ndarray) -> np.ndarray:
        """Weigh what speaks for each Gaussian in its object."""
        return self._sums(_reasons_to_stay, kept, asked, shown)

    def _sums(self, kernel: object, *arrays: np.ndarray) -> np.ndarray:
        """Have a kernel sum up by Gaussian over the pixels of all tiles, (M,) float64, in px."""
        tiles, sums = self.tiles, torch.zeros(len(self.labels), dtype=torch.int64, device=self.labels.device)
        there = (on_device(array, sums.device) for array in arrays)
        launch_on_tiles(kernel, tiles, self.labels, *there, sums)
        return np.asarray(to_cpu(sums) / UNITS)


@gpu_kernel
def _reasons_to_go(
    table: np.ndarray, start: np.ndarray, entries: np.ndarray, columns: int, labels: np.ndarray, depths: np.ndarray,
    shown: np.ndarray, hidden_from: np.ndarray, sums: np.ndarray,  # (H, W), (H, W); (M,) int64, added to
) -> None:  # fmt: skip
    """Sum alphas over the pixels of one tile that show another label, where they do not hide the Gaussian."""
    splats = cuda.shared.array((BATCH, 8), np.float32)
    weighed = cuda.shared.array((BATCH, STRIDE), np.float32)
    tile, t, row, column = own_pixel(columns)
    x, y = centre_of(row, column)
    seen, limit = _UNKNOWN, _NOTHING
    if row < shown.shape[0] and column < shown.shape[1]:
        seen, limit = shown[row, column], hidden_from[row, column]
    for first in range(start[tile], start[tile + 1], BATCH):
        count = load_batch(table, entries, first, start[tile + 1], splats, t)
        cuda.syncthreads()
        for e in range(count):
            g = entries[first + e]
            speaks = seen >= 0 and seen != labels[g] and depths[g] <= limit
            weighed[e, t] = alpha_of(splats, e, x, y) if speaks else _NOTHING
        cuda.syncthreads()
        _add_up(weighed, entries, first, count, t, sums)
        cuda.syncthreads()


@gpu_kernel
def _reasons_to_stay(
    table: np.ndarray, start: np.ndarray, entries: np.ndarray, columns: int, labels: np.ndarray,
    kept: np.ndarray, asked: np.ndarray, shown: np.ndarray, sums: np.ndarray,  # (M,), (M,), (H, W); (M,), added to
) -> None:  # fmt: skip
    """Sum alpha T_k / (1 - T_k) over the pixels of one tile that show the Gaussian's object k, for those asked for."""
    splats = cuda.shared.array((BATCH, 8), np.float32)
    weighed = cuda.shared.array((BATCH, STRIDE), np.float32)
    tile, t, row, column = own_pixel(columns)
    x, y = centre_of(row, column)
    seen, wanted, through = _UNKNOWN, False, _ALL
    if row < shown.shape[0] and column < shown.shape[1]:
        seen = shown[row, column]
    for e in range(start[tile] + t, start[tile + 1], THREADS):
        wanted |= asked[entries[e]]
    if not cuda.syncthreads_or(np.int32(wanted)):
        return
    for first in range(start[tile], start[tile + 1], BATCH):
        count = load_batch(table, entries, first, start[tile + 1], splats, t)
        cuda.syncthreads()
        for e in range(count):
            if seen == labels[entries[first + e]]:
                through *= _ALL - kept[entries[first + e]] * alpha_of(splats, e, x, y)
        cuda.syncthreads()
    need = through / (_ALL - through + ROUNDING) if through >= _DARK else _NOTHING
    for first in range(start[tile], start[tile + 1], BATCH):
        count = load_batch(table, entries, first, start[tile + 1], splats, t)
        cuda.syncthreads()
        for e in range(count):
            g = entries[first + e]
            weighed[e, t] = need * alpha_of(splats, e, x, y) if seen == labels[g] and asked[g] else _NOTHING
        cuda.syncthreads()
        _add_up(weighed, entries, first, count, t, sums)
        cuda.syncthreads()


@called_by_kernels
def _add_up(weighed: np.ndarray, entries: np.ndarray, first: int, count: int, t: int, sums: np.ndarray) -> None:
    """Add what the pixels of a tile weigh of each Gaussian of a batch to its sum, by some threads to each."""
    e, total = t // PARTS, _NOTHING
    if e < count:
        for position in range(t % PARTS, THREADS, PARTS):
            total += weighed[e, position]
        add_units(sums, entries[first + e], total)
