"""Products with the weight matrix W of one view, tile by tile.

They are W q and W^T r; and W is listed.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from gsseg_core.csr_rows import CSRRows
from gsseg_core.kernels.compiler import called_by_kernels, kernel
from gsseg_core.raster.constants import BLOCK
from gsseg_core.raster.cpu.blending import (
    aim_next,
    blend_tile,
    blocks_with,
    corner_of,
    in_block,
    in_tile,
    open_rays,
    tile_of_turn,
)
from gsseg_core.raster.cpu.splat import OPEN, WIDTH, blend_block
from gsseg_core.raster.cpu.tiling import TILE, Tiles
from gsseg_core.simd import (
    AHEAD,
    FAST,
    above,
    add_scaled,
    dot,
    first_bit,
    load_row,
    maximum,
    minimum,
    prefetch,
    store_row,
    zero_row,
)

_ROUNDING = np.float32(1e-5)  # of blended codes, and more
FEW = 4  # channels up to which `render_few` is the faster one: colours, depths


@nb.njit(inline="always")
def _put(
    tiles: Tiles, tile: int, values: np.ndarray, rays: np.ndarray,  # (16, K, 16), (16, 16) by block
    out: np.ndarray, left_over: np.ndarray,  # (H, W, K), (H, W) out
) -> None:  # fmt: skip
    """Write a tile into the image."""
    left, top = corner_of(tiles, tile)
    for r in range(min(TILE, tiles.height - top)):
        for c in range(min(TILE, tiles.width - left)):
            b, lane = in_block(r, c)
            left_over[top + r, left + c] = rays[b, lane]
            for k in range(out.shape[2]):
                out[top + r, left + c, k] = values[b, k, lane]


@kernel(parallel=True)
def render(tiles: Tiles, codes: CSRRows, rows: np.ndarray, channels: int) -> tuple[np.ndarray, np.ndarray]:
    """Blend codes of the M projected Gaussians, float32: W q, (H, W, K) float32, and final transmittance, (H, W).

    Row `rows[m]` of the codes, (M,) int32, is that of Gaussian m.
    """
    (out, left_over), nothing_else = _blank(tiles, channels), np.empty((len(rows), 0), np.float32)
    for turn in nb.prange(tiles.rows * tiles.columns):
        tile = tile_of_turn(tiles, turn)
        values, slots, _, rays = _blend_codes(tiles, tile, codes, rows, channels, nothing_else, OPEN, 0)
        columns, (left, top) = np.flatnonzero(slots >= 0), corner_of(tiles, tile)
        for r in range(min(TILE, tiles.height - top)):
            for c in range(min(TILE, tiles.width - left)):
                b, lane = in_block(r, c)
                left_over[top + r, left + c] = rays[b, lane]
                pixel = out[top + r, left + c]
                pixel[:] = 0
                for k in columns:
                    pixel[k] = values[slots[k] * TILE + b, lane]
    return out, left_over


@kernel(parallel=True)
def strongest(
    tiles: Tiles, codes: CSRRows, rows: np.ndarray, channels: int, background: bool, first: int, step: int,
    beside: np.ndarray, wanted: np.ndarray,  # (M, C) float32; (H, W) bool, or (0, 0) for all pixels
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Find the column of the largest blended code in each pixel, without an image of all columns.

    Returns that column, (H, W) int32, the first of equal ones; whether the sum of all columns is more than a half,
    (H, W) bool; all columns of the pixels of a `PixelGrid`, (R, C, K); and what `render_few` makes of the codes
    `beside` these. What a ray has left over is added to column 0, if that is the background. Blocks of 4 x 4 pixels
    none of which is `wanted` are left out: what is returned for them has no meaning.

    Codes are at most 1. So once one column leads by more than a ray has left, nothing farther changes that, and a block
    in which all rays are so far takes no more codes.
    """
    out, half = np.zeros((tiles.height, tiles.width), np.int32), np.zeros((tiles.height, tiles.width), np.bool_)
    some = np.zeros((len(range(first, tiles.height, step)), len(range(first, tiles.width, step)), channels), np.float32)
    image, left_over = _blank(tiles, beside.shape[1])
    for turn in nb.prange(tiles.rows * tiles.columns):
        tile = tile_of_turn(tiles, turn)
        left, top = corner_of(tiles, tile)
        looked_at = blocks_with(wanted, left, top)
        if not looked_at:
            continue
        best, known = np.zeros((TILE, TILE), np.int32), np.empty((TILE, TILE), np.float32)
        ending = OPEN & ~_blocks_of_grid(first, step, left, top)
        values, slots, others, rays = _blend_codes(tiles, tile, codes, rows, channels, beside, looked_at, ending)
        columns = np.flatnonzero(slots >= 0)
        _compare(values, slots, columns, rays, background, best, known)
        _put(tiles, tile, others, rays, image, left_over)
        for r in range(min(TILE, tiles.height - top)):
            for c in range(min(TILE, tiles.width - left)):
                b, lane = in_block(r, c)
                out[top + r, left + c], half[top + r, left + c] = best[b, lane], known[b, lane] > np.float32(0.5)
        for r in range((first - top) % step, min(TILE, tiles.height - top), step):
            for c in range((first - left) % step, min(TILE, tiles.width - left), step):
                row, column = (top + r - first) // step, (left + c - first) // step
                if row >= 0 and column >= 0:
                    b, lane = in_block(r, c)
                    for k in columns:
                        some[row, column, k] = values[slots[k] * TILE + b, lane]
                    some[row, column, 0] += rays[b, lane] if background else np.float32(0)
    return out, half, some, image, left_over


@called_by_kernels
def _blocks_of_grid(first: int, step: int, left: int, top: int) -> int:
    """Which blocks of a tile have pixels of a grid, as bits."""
    rows, columns = 0, 0
    for i in range(TILE):
        rows |= (top + i >= first and (top + i - first) % step == 0) << i // BLOCK
        columns |= (left + i >= first and (left + i - first) % step == 0) << i // BLOCK
    blocks = 0
    for b in range(TILE):
        blocks |= (rows >> b // BLOCK & columns >> b % BLOCK & 1) << b
    return blocks


@nb.njit(inline="always")
def _is_decided(values: np.ndarray, count: int, b: int, rays: np.ndarray, live: int) -> bool:  # (16 K, 16); (16, 16)
    """Tell whether nothing that rays of a block meet yet changes the largest column, or that more than half is known.

    Rays that are not `live`, by the bits of their lanes, meet nothing.
    """
    most, second, known = zero_row(), zero_row(), zero_row()
    for slot in range(count):
        value = load_row(values, slot * TILE + b)
        second, most = maximum(second, minimum(most, value)), maximum(most, value)
        known = add_scaled(known, value, np.float32(1))
    ahead = above(add_scaled(most, second, np.float32(-1)), load_row(rays, b), _ROUNDING)
    return (ahead & above(known, zero_row(), np.float32(0.5) + _ROUNDING) | ~live) & OPEN == OPEN


@called_by_kernels
def _compare(
    values: np.ndarray, slots: np.ndarray, columns: np.ndarray,  # as `_blend_codes` returns them; (S,) that occur
    rays: np.ndarray, background: bool,  # (16, 16)
    best: np.ndarray, known: np.ndarray,  # (16, 16) in: zeros, out: column of the largest; (16, 16) out: sum of all
) -> None:  # fmt: skip
    """Find the strongest column of each pixel of a tile; what is left over of a ray counts to the background."""
    most = np.empty(TILE, np.float32)
    for b in range(TILE):
        for lane in range(TILE):
            most[lane] = rays[b, lane] if background else np.float32(0)
            if slots[0] >= 0:
                most[lane] += values[slots[0] * TILE + b, lane]
            known[b, lane] = most[lane]
        for k in columns[int(slots[0] >= 0) :]:
            row = values[slots[k] * TILE + b]
            for lane in range(TILE):  # without a branch, so that the compiler takes the lanes together
                known[b, lane] += row[lane]
                best[b, lane] = np.int32(k) if row[lane] > most[lane] else best[b, lane]
                most[lane] = max(row[lane], most[lane])


@called_by_kernels(fastmath={"contract"}, error_model="numpy")
def _blend_codes(
    tiles: Tiles, tile: int, codes: CSRRows, rows: np.ndarray, channels: int, beside: np.ndarray,  # as `strongest`'s
    looked_at: int, ending: int,  # bits of blocks: of all that count; of those whose largest column alone is wanted
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Blend the codes of a tile, and others beside them; weights are used where they are made.

    Of hundreds of columns, a tile has a few: those get a slot, in the order in which they turn up. Returns the blended
    codes, (16 K, 16) float32, of which slot s has rows 16 s to 16 s + 15, by block; the slot of each column, (K,)
    int64, -1 where there is none; and by block, what is `beside` them, (16, C, 16) float32, and the final
    transmittances, (16, 16) float32.
    """
    last, (indptr, indices, data) = tiles.start[tile + 1], codes
    table, entries = tiles.table, tiles.entries
    # There is room for all, but memory is only what is written to.
    values, slots, count = np.empty((channels * TILE, TILE), np.float32), np.full(channels, -1), 0
    places = np.empty(channels, np.int64)  # where the slots of a Gaussian's columns begin
    others, rays = np.zeros((TILE, beside.shape[1], TILE), np.float32), np.empty((TILE, TILE), np.float32)
    lines, turns = np.empty((2, 2, TILE), np.float32), np.zeros(TILE, np.int64)
    left, top, inside = open_rays(tiles, tile, rays)
    live = inside & looked_at
    wanted, ahead = live, aim_next(table, entries, tiles.start[tile] - 1, last, left, top, lines)
    for e in range(tiles.start[tile], last):
        g = entries[e]
        reached, wide = ahead & live, table[g, WIDTH]
        # Rows are anywhere in memory: they are asked for before they are needed, while they are.
        prefetch(beside, entries[min(e + AHEAD, last - 1)])
        if wanted:
            prefetch(rows, entries[min(e + 3 * AHEAD, last - 1)])
            prefetch(indptr, rows[entries[min(e + 2 * AHEAD, last - 1)]])
            later = indptr[rows[entries[min(e + AHEAD, last - 1)]]]
            prefetch(indices, later)
            prefetch(data, later)
        first, end = (indptr[rows[g]], indptr[rows[g] + 1]) if wanted & reached else (0, 0)
        for z in range(first, end):
            if slots[indices[z]] < 0:
                values[count * TILE : (count + 1) * TILE] = 0
                slots[indices[z]] = count
                count += 1
            places[z - first] = slots[indices[z]] * TILE
        ahead = aim_next(table, entries, e, last, left, top, lines)
        while reached:
            b = first_bit(reached)
            reached &= reached - 1
            weight, bits = blend_block(rays, b, lines, e % 2, wide)
            if wanted >> b & 1:
                for z in range(first, end):
                    row = places[z - first] + b
                    store_row(values, row, add_scaled(load_row(values, row), weight, data[z]))
                turns[b] += ending >> b & 1
                if turns[b] >= 6 + count // 4:  # The more there is to look through, the less often.
                    turns[b] = 0
                    if _is_decided(values, count, b, rays, bits):
                        wanted &= ~(1 << b)
                        live &= wanted if beside.shape[1] == 0 else live
            for c in range(beside.shape[1]):
                k = np.int64(b) * beside.shape[1] + c
                store_row(others, k, add_scaled(load_row(others, k), weight, beside[g, c]))
            if not bits & OPEN:
                live &= ~(1 << b)
        if not live:
            break
    return values, slots, others, rays


@kernel(parallel=True, fastmath={"contract"}, error_model="numpy")
def render_few(tiles: Tiles, codes: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Do what `render` does for codes (M, K) float32 with few zeros, K small: weights are used where they are made.

    Blocks of 4 x 4 pixels none of which is `wanted`, (H, W) bool or (0, 0) for all, are not looked at.
    """
    channels, table, entries = codes.shape[1], tiles.table, tiles.entries
    out, left_over = _blank(tiles, channels)
    for turn in nb.prange(tiles.rows * tiles.columns):
        tile = tile_of_turn(tiles, turn)
        last = tiles.start[tile + 1]
        rays, lines = np.empty((TILE, TILE), np.float32), np.empty((2, 2, TILE), np.float32)
        values, corner = np.zeros((TILE, channels, TILE), np.float32), corner_of(tiles, tile)
        left, top, live = open_rays(tiles, tile, rays)
        live &= blocks_with(wanted, corner[0], corner[1])
        ahead = aim_next(table, entries, tiles.start[tile] - 1, last, left, top, lines)
        for e in range(tiles.start[tile], last):
            g = entries[e]
            prefetch(codes, entries[min(e + AHEAD, last - 1)])
            reached, wide = ahead & live, table[g, WIDTH]
            ahead = aim_next(table, entries, e, last, left, top, lines)
            while reached:
                b = first_bit(reached)
                reached &= reached - 1
                weight, bits = blend_block(rays, b, lines, e % 2, wide)
                for k in range(b * channels, (b + 1) * channels):
                    store_row(values, k, add_scaled(load_row(values, k), weight, codes[g, k - b * channels]))
                if not bits & OPEN:
                    live &= ~(1 << b)
            if not live:
                break
        _put(tiles, tile, values, rays, out, left_over)
    return out, left_over


@nb.njit(inline="always")
def _blank(tiles: Tiles, channels: int) -> tuple[np.ndarray, np.ndarray]:
    size = tiles.height, tiles.width
    return np.empty((*size, channels), np.float32), np.empty(size, np.float32)


@kernel(parallel=True, fastmath=FAST)
def adjoint(tiles: Tiles, residual: np.ndarray) -> np.ndarray:
    """Carry values of pixels, (H, W, C) float32 with C <= CHANNELS, back to the Gaussians: W^T r, (M, C) float32."""
    channels = residual.shape[2]
    sums, out = np.empty((len(tiles.entries), channels), np.float32), np.zeros((len(tiles.table), channels), np.float32)
    for turn in nb.prange(tiles.rows * tiles.columns):
        tile = tile_of_turn(tiles, turn)
        first, records, (left, top) = tiles.start[tile], blend_tile(tiles, tile), corner_of(tiles, tile)
        values = np.zeros((TILE, channels, TILE), np.float32)
        for r in range(min(TILE, tiles.height - top)):
            for c in range(min(TILE, tiles.width - left)):
                b, lane = in_block(r, c)
                for k in range(channels):
                    values[b, k, lane] = residual[top + r, left + c, k]
        sums[first : tiles.start[tile + 1]] = 0.0
        n = 0
        for e in range(len(records.ends)):
            for i in range(n, records.ends[e]):
                for k in range(channels):
                    sums[first + e, k] += dot(values, records.blocks[i] * channels + k, records.weights, i)
            n = records.ends[e]
    for g in nb.prange(len(out)):  # each Gaussian's entries are added up in tile order
        for i in range(tiles.gaussian_start[g], tiles.gaussian_start[g + 1]):
            for k in range(channels):
                out[g, k] += sums[tiles.gaussian_entries[i], k]
    return out


def list_weights(tiles: Tiles, pixel: tuple[int, int] | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """List W: pixels and rows of the table, (P,) int32, and weights, (P,) float32, nearest first in each pixel.

    If only a `pixel` is wanted, those of its tile are listed.
    """
    wanted: np.ndarray = np.arange(tiles.columns * tiles.rows)
    if pixel is not None:
        wanted = wanted[[pixel[0] // TILE * tiles.columns + pixel[1] // TILE]]
    counts, none = np.zeros(len(wanted) + 1, np.int64), np.empty(0, np.int32)
    _list_weights(tiles, wanted, counts, none, none, np.empty(0, np.float32))
    start = np.cumsum(counts)
    pixels, rows = np.empty(start[-1], np.int32), np.empty(start[-1], np.int32)
    weights = np.empty(start[-1], np.float32)
    _list_weights(tiles, wanted, start, pixels, rows, weights)
    return pixels, rows, weights


@kernel(parallel=True)
def _list_weights(
    tiles: Tiles, wanted: np.ndarray,  # (U,) tiles
    place: np.ndarray,  # (U + 1,) int64: where each tile's part begins; with empty lists, counts out (in place[1:])
    pixels: np.ndarray, rows: np.ndarray,  # (P,) int32 out: pixel; row of the table
    values: np.ndarray,  # (P,) float32 out
) -> None:  # fmt: skip
    """Count the non-zero weights of each tile, or write them where a first call's counts say."""
    for i in nb.prange(wanted.shape[0]):
        tile, position = wanted[i], place[i] if len(values) else 0
        records, (left, top) = blend_tile(tiles, tile), corner_of(tiles, tile)
        n = 0
        for e in range(len(records.ends)):
            for record in range(n, records.ends[e]):
                for lane in range(TILE):
                    if records.weights[record, lane] > 0:
                        if len(values):
                            r, c = in_tile(records.blocks[record], lane)
                            pixels[position] = (top + r) * tiles.width + left + c
                            rows[position] = tiles.entries[tiles.start[tile] + e]
                            values[position] = records.weights[record, lane]
                        position += 1
            n = records.ends[e]
        if not len(values):
            place[i + 1] = position
