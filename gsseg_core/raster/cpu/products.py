"""Products with the weight matrix W of one view, tile by tile.

They are W q, W^T r, and both restricted to the pixels' own labels.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from gsseg_core.raster.cpu.blending import (
    AHEAD,
    aim_next,
    blend_tile,
    in_block,
    in_tile,
    open_rays,
    stride_of,
    tile_of_turn,
)
from gsseg_core.raster.cpu.splat import OPEN, WIDTH, blend_block
from gsseg_core.raster.cpu.tiling import TILE
from gsseg_core.simd import FAST, add_scaled, dot, first_bit, load_row, prefetch, store_row

FEW = 4
"""Channels up to which `render_few` is the faster one: colours, depths."""


@nb.njit(inline="always")
def _scratch(entries: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    # Sized for the worst case; pages that no record reaches are never touched.
    return (
        np.empty((TILE, TILE), np.float32),
        np.empty((TILE * entries, TILE), np.float32),
        np.empty(TILE * entries, np.uint8),
        np.empty(entries, np.int32),
    )


@nb.njit(inline="always")
def _put(
    tile: int,
    columns: int,
    values: np.ndarray,  # (16, K, 16) by block
    rays: np.ndarray,  # (16, 16) by block
    out: np.ndarray,  # (H, W, K) out
    left_over: np.ndarray,  # (H, W) out
) -> None:
    """Write a tile into the image."""
    height, width, channels = out.shape
    left, top = (tile % columns) * TILE, (tile // columns) * TILE
    for r in range(min(TILE, height - top)):
        for c in range(min(TILE, width - left)):
            b, lane = in_block(r, c)
            left_over[top + r, left + c] = rays[b, lane]
            for k in range(channels):
                out[top + r, left + c, k] = values[b, k, lane]


@nb.njit(parallel=True, nogil=True, cache=True)
def render(
    columns: int,
    table: np.ndarray,  # (M, 8)
    start: np.ndarray,  # (T + 1,)
    entries: np.ndarray,  # (E,)
    rows_of: np.ndarray,  # (M + 1,) codes, as `CSRRows`
    classes: np.ndarray,  # (Z,) uint32
    codes: np.ndarray,  # (Z,) float32
    out: np.ndarray,  # (H, W, K) float32 out
    left_over: np.ndarray,  # (H, W) float32 out: final transmittance
) -> None:
    """Blend codes into the image, W q."""
    height, width, channels = out.shape
    rows = (start.shape[0] - 1) // columns
    stride = stride_of(rows)
    for turn in nb.prange(rows * columns):
        tile = tile_of_turn(turn, columns, rows, stride)
        first, last = start[tile], start[tile + 1]
        rays, weights, blocks, ends = _scratch(last - first)
        used = blend_tile(tile, columns, width, height, table, entries, first, last, rays, weights, blocks, ends)
        values = np.zeros((TILE, channels, TILE), np.float32)
        n = 0
        for e in range(used):
            g = entries[first + e]
            for i in range(n, ends[e]):
                weight, begin = load_row(weights, i), np.int64(blocks[i]) * channels
                for z in range(rows_of[g], rows_of[g + 1]):
                    k = begin + np.int64(classes[z])
                    store_row(values, k, add_scaled(load_row(values, k), weight, codes[z]))
            n = ends[e]
        _put(tile, columns, values, rays, out, left_over)


@nb.njit(parallel=True, nogil=True, cache=True, fastmath={"contract"}, error_model="numpy")
def render_few(
    columns: int,
    table: np.ndarray,  # (M, 8)
    start: np.ndarray,  # (T + 1,)
    entries: np.ndarray,  # (E,)
    codes: np.ndarray,  # (M, K) float32
    out: np.ndarray,  # (H, W, K) float32 out
    left_over: np.ndarray,  # (H, W) float32 out: final transmittance
) -> None:
    """Do what `render` does for a few channels that hardly have zeros: weights are used where they are made."""
    height, width, channels = out.shape
    rows = (start.shape[0] - 1) // columns
    stride = stride_of(rows)
    for turn in nb.prange(rows * columns):
        tile = tile_of_turn(turn, columns, rows, stride)
        first, last = start[tile], start[tile + 1]
        rays, lines = np.empty((TILE, TILE), np.float32), np.empty((2, 2, TILE), np.float32)
        values = np.zeros((TILE, channels, TILE), np.float32)
        left, top, live = open_rays(tile, columns, width, height, rays)
        ahead = aim_next(table, entries, first - 1, last, left, top, lines)
        for e in range(first, last):
            g = entries[e]
            prefetch(codes, entries[min(e + AHEAD, last - 1)])
            reached, own, wide = ahead & live, lines[e % 2], table[g, WIDTH]
            ahead = aim_next(table, entries, e, last, left, top, lines)
            while reached:
                b = first_bit(reached)
                reached &= reached - 1
                weight, bits = blend_block(rays, b, own, wide)
                for k in range(b * channels, (b + 1) * channels):
                    store_row(values, k, add_scaled(load_row(values, k), weight, codes[g, k - b * channels]))
                if not bits & OPEN:
                    live &= ~(1 << b)
            if not live:
                break
        _put(tile, columns, values, rays, out, left_over)


@nb.njit(parallel=True, nogil=True, cache=True, fastmath=FAST)
def adjoint_entries(
    columns: int,
    table: np.ndarray,  # (M, 8)
    start: np.ndarray,  # (T + 1,)
    entries: np.ndarray,  # (E,)
    residual: np.ndarray,  # (H, W, C) float32, C <= CHANNELS
    sums: np.ndarray,  # (E, C) float32 out
) -> None:
    """Sum weight times residual over the pixels of each entry: the part of W^T r that one tile adds to a Gaussian."""
    height, width, channels = residual.shape
    rows = (start.shape[0] - 1) // columns
    stride = stride_of(rows)
    for turn in nb.prange(rows * columns):
        tile = tile_of_turn(turn, columns, rows, stride)
        first, last = start[tile], start[tile + 1]
        rays, weights, blocks, ends = _scratch(last - first)
        used = blend_tile(tile, columns, width, height, table, entries, first, last, rays, weights, blocks, ends)
        left, top = (tile % columns) * TILE, (tile // columns) * TILE
        values = np.zeros((TILE, channels, TILE), np.float32)
        for r in range(min(TILE, height - top)):
            for c in range(min(TILE, width - left)):
                b, lane = in_block(r, c)
                for k in range(channels):
                    values[b, k, lane] = residual[top + r, left + c, k]
        sums[first:last] = 0.0
        n = 0
        for e in range(used):
            for i in range(n, ends[e]):
                for k in range(channels):
                    sums[first + e, k] += dot(values, blocks[i] * channels + k, weights, i)
            n = ends[e]


@nb.njit(parallel=True, nogil=True, cache=True)
def reduce_entries(
    gaussian_start: np.ndarray,  # (M + 1,)
    gaussian_entries: np.ndarray,  # (E,)
    sums: np.ndarray,  # (E, C)
    out: np.ndarray,  # (M, C) float32 out
) -> None:
    """Add up each Gaussian's entries, in tile order."""
    for g in nb.prange(out.shape[0]):
        out[g] = 0.0
        for i in range(gaussian_start[g], gaussian_start[g + 1]):
            e = gaussian_entries[i]
            for k in range(out.shape[1]):
                out[g, k] += sums[e, k]


@nb.njit(parallel=True, nogil=True, cache=True)
def list_weights(
    columns: int,
    width: int,
    height: int,
    table: np.ndarray,  # (M, 8)
    start: np.ndarray,  # (T + 1,)
    entries: np.ndarray,  # (E,)
    wanted: np.ndarray,  # (U,) tiles
    place: np.ndarray,  # (U + 1,) int64: where each tile's part begins; with empty lists, counts out (in place[1:])
    pixels: np.ndarray,  # (P,) int32 out
    rows_of: np.ndarray,  # (P,) int32 out: row of the table
    values: np.ndarray,  # (P,) float32 out
) -> None:
    """Count the non-zero weights of each tile, or write them where a first call's counts say."""
    for i in nb.prange(wanted.shape[0]):
        tile = wanted[i]
        first, last = start[tile], start[tile + 1]
        rays, weights, blocks, ends = _scratch(last - first)
        used = blend_tile(tile, columns, width, height, table, entries, first, last, rays, weights, blocks, ends)
        left, top = (tile % columns) * TILE, (tile // columns) * TILE
        position = place[i] if values.shape[0] else 0
        n = 0
        for e in range(used):
            for record in range(n, ends[e]):
                for lane in range(TILE):
                    if weights[record, lane] > 0:
                        if values.shape[0]:
                            r, c = in_tile(blocks[record], lane)
                            pixels[position] = (top + r) * width + left + c
                            rows_of[position] = entries[first + e]
                            values[position] = weights[record, lane]
                        position += 1
            n = ends[e]
        if not values.shape[0]:
            place[i + 1] = position
