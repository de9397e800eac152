"""The view operator on a GPU."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import Any

import numpy as np
import torch

from gsseg_core.csr_rows import CSRRows
from gsseg_core.raster.cpu.products import list_weights
from gsseg_core.raster.cpu.projection import footprints
from gsseg_core.raster.cpu.splat import LOG_OPACITY
from gsseg_core.raster.cpu.tiling import Tiles, stride_of
from gsseg_core.raster.gpu import blending
from gsseg_core.raster.gpu.device import find_gpu, launch_each, on_device, to_cpu
from gsseg_core.raster.gpu.gpu_observation import GPUObservation
from gsseg_core.raster.gpu.objects_alone import GPUObjects
from gsseg_core.raster.gpu.projection import TileTensors, project
from gsseg_core.raster.gpu.tensors import RowTensors
from gsseg_core.raster.objects_alone import ObjectsAlone
from gsseg_core.raster.observation import Observation
from gsseg_core.raster.view_operator import ViewOperator
from gsseg_core.raster.view_renderer import NO_PIXELS, Blended, PixelGrid, Strongest
from gsseg_core.raster.vote_total import VoteTotal
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene

FEW, MANY = 4, 32  # channels that are blended at once: colours or depths, and classes
_COPIED = 1 << 24  # votes that are copied from the GPU at once


class GPUOperator(ViewOperator):
    """W of one view on a GPU, remade tile by tile at every product and never stored.

    Arrays go in and come out as on the CPU. What is kept of the view, about 44 bytes per visible Gaussian and 12 per
    tile that it touches, lies on the GPU. By the rules of the CPU, and as there, results are the same bit for bit in
    every run and for any order of the Gaussians, unless two of them have the very same geometry and different codes.
    """

    def __init__(self, camera: Camera, num_gaussians: int, tiles: TileTensors) -> None:
        self.camera, self.num_gaussians, self.tiles = camera, num_gaussians, tiles

    @cached_property
    def ids(self) -> np.ndarray:  # type: ignore[override] # it is copied from the GPU when somebody asks
        """Gaussians that can reach the image, nearest first, (M,) int32."""
        return to_cpu(self.tiles.ids)

    @property
    def _device(self) -> torch.device:
        return self.tiles.table.device

    def footprints(self) -> np.ndarray:
        """Sum of the alphas of each of `ids` over an endless image, (M,)."""
        return footprints(to_cpu(self.tiles.table))

    def _without(self, hidden: np.ndarray) -> GPUOperator:
        other, table = copy.copy(self), self.tiles.table.clone()
        table[on_device(hidden, self._device), LOG_OPACITY] = -torch.inf
        other.tiles = self.tiles._replace(table=table)
        return other

    def blend_seen(self, codes: np.ndarray, wanted: np.ndarray | None = None) -> Blended:
        """Blend codes (M, K) of what is visible; all pixels, whatever is wanted."""
        self._check_rows(len(codes), self.ids, wanted)
        return _to_cpu(*self.blend_there(on_device(codes.astype(np.float32, copy=False), self._device)))

    def blend_rows(self, codes: CSRRows, num_classes: int) -> Blended:
        """Blend codes of which only the entries that are not zero are at hand."""
        return _to_cpu(*self.blend_there(self._dense(codes, num_classes)))

    def strongest(
        self, codes: CSRRows, num_classes: int, background: bool, grid: PixelGrid = NO_PIXELS,
        of: np.ndarray | None = None, beside: np.ndarray | None = None, wanted: np.ndarray | None = None,
    ) -> Strongest:  # fmt: skip
        """Find the class of each pixel, whatever is wanted; the image of all classes stays on the GPU."""
        image, left_over = self.blend_there(self._dense(codes, num_classes, of, wanted))
        if background:
            image[0] += left_over
        classes, known = image.argmax(dim=0).int(), image.sum(dim=0) > 0.5
        return Strongest(
            to_cpu(classes), to_cpu(known), to_cpu(grid.of(image.permute(1, 2, 0))),
            None if beside is None else self.blend_seen(beside),
        )  # fmt: skip

    def _dense(
        self, codes: CSRRows | RowTensors, num_classes: int, of: np.ndarray | torch.Tensor | None = None,
        wanted: np.ndarray | None = None,
    ) -> torch.Tensor:  # fmt: skip
        """Write codes of `ids` out by class on the GPU, (M, K); `of` as in `strongest`. Both may be there already."""
        self._check_rows(len(codes.indptr) - 1, of, wanted)
        rows = RowTensors.kept(codes, self._device) if isinstance(codes, CSRRows) else codes
        self._check_classes(rows.indices, num_classes)
        ids = self.tiles.ids.long()
        if of is not None:
            of = on_device(of, self._device) if isinstance(of, np.ndarray) else of
            place = torch.full((self.num_gaussians,), -1, dtype=torch.int64, device=self._device)
            place[of.long()] = torch.arange(len(of), device=self._device)
            ids = self._all_there(place[ids])
        return rows.dense(ids, num_classes)

    def blend_there(self, codes: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:  # (M, K)
        """Blend codes of `tiles.ids`: image (K, H, W), and final transmittance (H, W), both on the GPU."""
        tiles, channels = self.tiles, codes.shape[1]
        at_once = FEW if channels <= FEW else MANY
        padded = torch.nn.functional.pad(codes, (0, max(-channels % at_once, at_once * (channels == 0))))
        image = codes.new_empty((padded.shape[1], tiles.height, tiles.width))
        left_over = codes.new_empty((tiles.height, tiles.width))
        for k in range(0, padded.shape[1], at_once):
            part = padded[:, k : k + at_once].contiguous()
            kernel = blending.blend_kernel(at_once)
            blending.launch_on_tiles(kernel, tiles, part, image[k : k + at_once], left_over)
        return image[:channels], left_over

    def _adjoint(self, residual: np.ndarray) -> np.ndarray:
        tiles, channels, at_once = self.tiles, residual.shape[2], blending.CARRIED
        carried = torch.empty((len(tiles.ids), channels), device=self._device)
        values = on_device(residual.astype(np.float32, copy=False), self._device)
        sums = torch.empty((len(tiles.entries), at_once), device=self._device)
        for k in range(0, channels, at_once):
            part = values[..., k : k + at_once]
            of_part = torch.empty((len(tiles.ids), at_once), device=self._device)
            padded = torch.nn.functional.pad(part, (0, at_once - part.shape[2])).contiguous()
            blending.launch_on_tiles(blending.carry_back, tiles, tiles.place, padded, sums)
            launch_each(blending.add_up, len(of_part), tiles.gaussian_start, sums, of_part)
            carried[:, k : k + at_once] = of_part[:, : part.shape[2]]
        out = np.zeros((self.num_gaussians, channels), np.float32)
        out[self.ids] = to_cpu(carried)
        return out

    def _weights(self, pixel: tuple[int, int] | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """On the CPU, to which the tiles are copied: whoever lists weights is in no hurry."""
        tiles = self.tiles
        arrays = map(to_cpu, (tiles.table, tiles.start, tiles.entries))
        return list_weights(Tiles(*tiles[:4], stride_of(tiles.rows), *arrays), pixel)

    def _objects_alone(self, labels: np.ndarray) -> ObjectsAlone:
        return GPUObjects.of(self.tiles, labels)

    def _observe(self, labels: np.ndarray, weights: np.ndarray | None) -> Observation:
        return GPUObservation(self, self.tiles, labels, weights)


def _to_cpu(image: torch.Tensor, left_over: torch.Tensor) -> Blended:  # (K, H, W), (H, W)
    return Blended(to_cpu(image.permute(1, 2, 0).contiguous()), to_cpu(left_over))


def view_operator(scene: GaussianScene, camera: Camera, device: str) -> GPUOperator:
    """Make the operator of a view on a GPU."""
    return GPUOperator(camera, len(scene), project(scene, camera, find_gpu(device)))


@contextmanager
def vote_total(votes: VoteTotal, device: str) -> Iterator[Any]:
    """Give a total on the GPU that is added to the votes at the end, or the votes themselves if that has no room."""
    count, classes = votes.shape
    if 4 * 8 * count * classes > free_memory_on(device):
        yield votes
        return
    total = torch.zeros(votes.shape, dtype=torch.int64, device=find_gpu(device))
    try:
        yield total
    finally:
        at_once = max(_COPIED // classes, 1)
        for first in range(0, count, at_once):
            votes.add_rows(CSRRows.from_dense(to_cpu(total[first : first + at_once])), first)


def free_memory_on(device: str) -> int:
    """Bytes that are free on a GPU, or that PyTorch keeps for what comes; of a simulated one, as a small one has."""
    gpu = find_gpu(device)
    if gpu.type != "cuda":
        return 1 << 30
    return torch.cuda.mem_get_info(gpu)[0] + torch.cuda.memory_reserved(gpu) - torch.cuda.memory_allocated(gpu)
