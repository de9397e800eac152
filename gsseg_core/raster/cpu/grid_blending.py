"""Blend only the pixels of a grid: those of a tile are put side by side, sixteen to a vector."""

from __future__ import annotations

import numba as nb
import numpy as np

from gsseg_core.kernels.compiler import called_by_kernels, kernel
from gsseg_core.raster.cpu.blending import corner_of, in_block, tile_of_turn
from gsseg_core.raster.cpu.splat import OPEN, blend_pixels, reach_pixels
from gsseg_core.raster.cpu.tiling import TILE, Tiles
from gsseg_core.simd import add_scaled, first_bit, load_row, prefetch, store_row

BATCH = 32  # entries that are looked at together before those among them that reach a pixel are blended


@kernel(parallel=True)
def render_grid(tiles: Tiles, codes: np.ndarray, first: int, step: int) -> tuple[np.ndarray, np.ndarray]:
    """Make the pixels of a `PixelGrid` of what `products.render_few` returns, bit for bit: (R, C, K), (R, C)."""
    height, width = len(range(first, tiles.height, step)), len(range(first, tiles.width, step))
    channels = codes.shape[1]
    out, left_over = np.empty((height, width, channels), np.float32), np.empty((height, width), np.float32)
    for turn in nb.prange(tiles.rows * tiles.columns):
        tile = tile_of_turn(tiles, turn)
        left, top = corner_of(tiles, tile)
        # Rows and columns of the grid that cross the tile, the last one excluded.
        low, high = _after(first, step, top, height), _after(first, step, top + TILE, height)
        near, far = _after(first, step, left, width), _after(first, step, left + TILE, width)
        rays, values = np.zeros((TILE, TILE), np.float32), np.zeros((TILE, channels, TILE), np.float32)
        rows, columns = np.zeros((TILE, TILE), np.float32), np.zeros((TILE, TILE), np.float32)
        for r in range(high - low):
            for c in range(far - near):
                b, lane = in_block(r, c)
                rows[b, lane], columns[b, lane] = first + (low + r) * step - top, first + (near + c) * step - left
                rays[b, lane] = 1.0
        _blend(tiles, tile, codes, rows, columns, rays, values)
        for r in range(high - low):
            for c in range(far - near):
                b, lane = in_block(r, c)
                left_over[low + r, near + c] = rays[b, lane]
                for k in range(channels):
                    out[low + r, near + c, k] = values[b, k, lane]
    return out, left_over


@nb.njit(inline="always")
def _after(first: int, step: int, pixel: int, count: int) -> int:
    """Which of a grid's rows, or columns, is the first at or after a pixel; their number where none is."""
    return min(max(-((first - pixel) // step), 0), count)


@called_by_kernels(fastmath={"contract"}, error_model="numpy")
def _blend(
    tiles: Tiles, tile: int, codes: np.ndarray,  # (M, K)
    rows: np.ndarray, columns: np.ndarray,  # (16, 16): where in the tile the pixels of each vector are
    rays: np.ndarray, values: np.ndarray,  # (16, 16) 1, or 0 where there is no pixel; (16, K, 16) zeros
) -> None:  # fmt: skip
    """Blend the entries of a tile into some of its pixels."""
    channels, last = codes.shape[1], tiles.start[tile + 1]
    left, top = corner_of(tiles, tile)
    x, y = np.float32(left + 0.5), np.float32(top + 0.5)
    powers, who, open_rays = np.empty((BATCH, TILE), np.float32), np.empty(BATCH, np.int32), np.zeros(TILE, np.int64)
    live = 0
    for b in range(TILE):
        for lane in range(TILE):
            open_rays[b] |= np.int64(rays[b, lane] > 0) << lane
        live |= (open_rays[b] > 0) << b
    for begin in range(tiles.start[tile], last, BATCH):
        end = min(begin + BATCH, last)
        for e in range(end, min(end + BATCH, last)):
            prefetch(tiles.table, tiles.entries[e])
        blocks = live
        while blocks:
            b = first_bit(blocks)
            blocks &= blocks - 1
            n = 0
            for e in range(begin, end):  # without a branch: what reaches nothing is overwritten
                g = tiles.entries[e]
                power, found = reach_pixels(rows, columns, b, tiles.table, g, x, y)
                store_row(powers, n, power)
                who[n] = g
                n += (found & open_rays[b]) > 0
            for i in range(n):
                prefetch(codes, who[i])
            for i in range(n):
                g = who[i]
                weight, bits = blend_pixels(rays, b, load_row(powers, i))
                open_rays[b] = bits & OPEN
                for k in range(b * channels, (b + 1) * channels):
                    store_row(values, k, add_scaled(load_row(values, k), weight, codes[g, k - b * channels]))
            if not open_rays[b]:
                live &= ~(1 << b)
        if not live:
            return
