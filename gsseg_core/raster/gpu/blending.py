"""The inner loop on a GPU: one block of threads to a tile, one thread to a pixel.

As on the CPU, rows of W are remade wherever they are used, and never stored. Projected Gaussians come into shared
memory a batch at a time. Sums over the pixels of a tile go through shared memory too: what a batch weighs in each pixel
is written there, and eight threads to each of its Gaussians add it up.

Threads are numbered so that the sixteen of a 4 x 4 block follow each other, and blocks of which every second one in
rows and columns is left out, as EM does far from boundaries, lie in the same warps.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np

from gsseg_core.raster.constants import ALPHA_MAX, T_LIFTED, T_MIN
from gsseg_core.raster.cpu.splat import HEIGHT, LOG_ALPHA_MIN, LOG_OPACITY, SHEAR, WIDTH, U, V
from gsseg_core.raster.cpu.tiling import TILE
from gsseg_core.raster.gpu.device import called_by_kernels, cuda, gpu_kernel, launch
from gsseg_core.raster.gpu.projection import TileTensors

THREADS = TILE * TILE
BATCH = 32  # Gaussians whose weights are in shared memory at once
PARTS = THREADS // BATCH  # threads that add up those of one of them
STRIDE = THREADS + PARTS  # of the weights in shared memory: threads of a warp meet in no bank of it
WARP, WARPS = 32, THREADS // 32  # threads of a warp, and warps of a block of threads

OPEN = np.float32(T_MIN)
LIFTED = np.float32(T_LIFTED)
_HALF_PIXEL = np.float32(0.5)
_LEAST, _MOST, _LN2 = np.float32(LOG_ALPHA_MIN), np.float32(ALPHA_MAX), np.float32(math.log(2))
_NOTHING = np.float32(0)


def launch_on_tiles(kernel: Any, tiles: TileTensors, *arguments: Any) -> None:
    """Start a kernel with a block of threads for each tile of a view, whose arrays it takes before the arguments."""
    arrays = tiles.table, tiles.start, tiles.entries  # (M, 8), (T + 1,), (E,)
    launch(kernel, tiles.columns * tiles.rows, THREADS, *arrays, tiles.columns, *arguments)


@called_by_kernels
def pixel_of(thread: int) -> tuple[int, int]:
    """Row and column in the tile of the pixel of a thread."""
    parity, within, lane = thread // 64, thread // 16 % 4, thread % 16
    row, column = within // 2 * 2 + parity // 2, within % 2 * 2 + parity % 2
    return row * 4 + lane // 4, column * 4 + lane % 4


@called_by_kernels
def own_pixel(columns: int) -> tuple[int, int, int, int]:
    """Tile and number of this thread, and row and column of its pixel in an image of so many columns of tiles."""
    tile, t = cuda.blockIdx.x, cuda.threadIdx.x
    row, column = pixel_of(t)
    return tile, t, tile // columns * TILE + row, tile % columns * TILE + column


@called_by_kernels
def centre_of(row: int, column: int) -> tuple[Any, Any]:
    """Place x, y of a pixel's centre in the image."""
    return np.float32(column) + _HALF_PIXEL, np.float32(row) + _HALF_PIXEL


@called_by_kernels
def alpha_of(splats: np.ndarray, e: int, x: Any, y: Any) -> Any:
    """Alpha of a projected Gaussian at a pixel's centre, as `raster.cpu.splat` has it."""
    dy = y - splats[e, V]
    across = x - splats[e, U] - splats[e, SHEAR] * dy
    power = splats[e, LOG_OPACITY] - splats[e, WIDTH] * across * across - splats[e, HEIGHT] * dy * dy
    return min(math.exp(power * _LN2), _MOST) if power >= _LEAST else _NOTHING


@called_by_kernels
def load_batch(table: np.ndarray, entries: np.ndarray, first: int, end: int, splats: np.ndarray, t: int) -> int:
    """Bring the projected Gaussians of a batch into shared memory, one number by each thread; returns how many."""
    count = min(BATCH, end - first)
    if t // 8 < count:
        splats[t // 8, t % 8] = table[entries[first + t // 8], t % 8]
    return count


@functools.cache
def blend_kernel(channels: int) -> Any:
    """Compile the kernel that blends so many channels at once."""

    @gpu_kernel
    def blend(
        table: np.ndarray, start: np.ndarray, entries: np.ndarray, columns: int, codes: np.ndarray,  # (M, channels)
        image: np.ndarray, left_over: np.ndarray,  # (channels, H, W), (H, W) out
    ) -> None:  # fmt: skip
        """Blend codes into one tile of an image."""
        splats = cuda.shared.array((BATCH, 8), np.float32)
        own = cuda.shared.array((BATCH, channels), np.float32)
        values = cuda.local.array(channels, np.float32)
        tile, t, row, column = own_pixel(columns)
        inside = row < left_over.shape[0] and column < left_over.shape[1]
        x, y = centre_of(row, column)
        ray = np.float32(1) if inside else _NOTHING
        for k in range(channels):
            values[k] = 0
        for first in range(start[tile], start[tile + 1], BATCH):
            if not cuda.syncthreads_or(np.int32(ray >= OPEN)):
                break
            count = load_batch(table, entries, first, start[tile + 1], splats, t)
            for i in range(t, count * channels, THREADS):
                own[i // channels, i % channels] = codes[entries[first + i // channels], i % channels]
            cuda.syncthreads()
            if ray >= OPEN:
                for e in range(count):
                    weight = alpha_of(splats, e, x, y) * ray
                    if weight > 0:
                        for k in range(channels):
                            values[k] += weight * own[e, k]
                        ray -= weight
                        if ray < OPEN:
                            break
        if inside:
            left_over[row, column] = ray
            for k in range(channels):
                image[k, row, column] = values[k]

    return blend


@called_by_kernels
def weigh_batch(
    splats: np.ndarray, count: int, x: Any, y: Any, ray: Any, least: Any, scale: Any, weights: np.ndarray, t: int
) -> Any:  # fmt: skip
    """Write what each Gaussian of a batch weighs in the pixel of a thread, times `scale`; returns what is left.

    The one that leaves less than `least` takes what is left.
    """
    for e in range(count):
        weight = alpha_of(splats, e, x, y) * ray if ray >= OPEN else _NOTHING
        if ray - weight < least:
            weight = ray
        ray -= weight
        weights[e, t] = weight * scale
    return ray


CARRIED = 8  # channels that are carried back at once


@gpu_kernel
def carry_back(
    table: np.ndarray, start: np.ndarray, entries: np.ndarray, columns: int,
    place: np.ndarray, residual: np.ndarray,  # (E,), (H, W, CARRIED)
    sums: np.ndarray,  # (E, CARRIED) out: of each entry, at its place
) -> None:  # fmt: skip
    """Sum weights times values of the pixels of one tile, by entry."""
    splats = cuda.shared.array((BATCH, 8), np.float32)
    weights = cuda.shared.array((BATCH, STRIDE), np.float32)
    parts = cuda.shared.array((THREADS, CARRIED), np.float32)
    total = cuda.local.array(CARRIED, np.float32)
    tile, t = cuda.blockIdx.x, cuda.threadIdx.x
    r, c = pixel_of(t)
    top, left = tile // columns * TILE, tile % columns * TILE
    inside = top + r < residual.shape[0] and left + c < residual.shape[1]
    x, y = centre_of(top + r, left + c)
    ray = np.float32(1) if inside else _NOTHING
    for first in range(start[tile], start[tile + 1], BATCH):
        count = load_batch(table, entries, first, start[tile + 1], splats, t)
        cuda.syncthreads()
        ray = weigh_batch(splats, count, x, y, ray, _NOTHING, np.float32(1), weights, t)
        cuda.syncthreads()
        e = t // PARTS
        for k in range(CARRIED):
            total[k] = 0
        if e < count:
            for position in range(t % PARTS, THREADS, PARTS):
                if weights[e, position] > 0:
                    r, c = pixel_of(position)
                    for k in range(CARRIED):
                        total[k] += weights[e, position] * residual[top + r, left + c, k]
        for k in range(CARRIED):
            parts[t, k] = total[k]
        cuda.syncthreads()
        if t % PARTS == 0 and e < count:
            for k in range(CARRIED):
                value = _NOTHING
                for part in range(PARTS):
                    value += parts[t + part, k]
                sums[place[first + e], k] = value


@gpu_kernel
def add_up(gaussian_start: np.ndarray, sums: np.ndarray, out: np.ndarray) -> None:  # (M + 1,), (E, C), (M, C) out
    """Add up the sums of one Gaussian's entries, in the order of its tiles."""
    m = cuda.grid(1)
    if m < out.shape[0]:
        for k in range(out.shape[1]):
            total = _NOTHING
            for i in range(gaussian_start[m], gaussian_start[m + 1]):
                total += sums[i, k]
            out[m, k] = total
