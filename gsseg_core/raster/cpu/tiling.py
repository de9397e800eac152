"""Which Gaussians reach which 16 x 16 tile of the image, nearest first."""

from __future__ import annotations

import math
from typing import NamedTuple

import numba as nb
import numpy as np

from gsseg_core.csr_rows import starts
from gsseg_core.errors import SceneValueError
from gsseg_core.kernels.compiler import called_by_kernels, kernel
from gsseg_core.raster.constants import CHUNKS
from gsseg_core.raster.cpu.projection import Projected, joined
from gsseg_core.raster.cpu.splat import HEIGHT, LOG_ALPHA_MIN, LOG_OPACITY, SHEAR, WIDTH, X_TURN, Y_REACH, U, V
from gsseg_core.simd import AHEAD, LANES, prefetch

TILE = LANES  # side of a tile in px: one row of a tile is one vector register of sixteen float32
TYPICAL = 8  # tiles that a Gaussian touches, at first; where they touch more on average, they are listed once more
MOST_ENTRIES = 2**31 - 1  # their numbers are int32
BATCH = 256  # Gaussians that are looked at together

_LEAST = np.float32(LOG_ALPHA_MIN)


class Tiles(NamedTuple):
    """A projected view cut into tiles, row by row, with the Gaussians of each.

    An *entry* is one Gaussian in one tile. Entries of a tile are contiguous and sorted by depth.
    """

    width: int  # of the image, in px
    height: int
    columns: int  # of tiles
    rows: int
    stride: int  # rows of tiles from one turn of a thread to the next
    table: np.ndarray  # (M, 8) float32: projected Gaussians, as `Projected` has them
    start: np.ndarray  # (columns * rows + 1,) int64: entries of tile t are start[t] to start[t + 1]
    entries: np.ndarray  # (E,) int32: row of each entry's Gaussian in the table
    # The same relation by Gaussian, where that is kept:
    gaussian_start: np.ndarray = np.empty(0, np.int64)  # (M + 1,) int64
    gaussian_entries: np.ndarray = np.empty(0, np.int32)  # (E,) int32: the entries of each, in tile order


def assign(projected: Projected, width: int, height: int) -> Tiles:
    """Sort projected Gaussians into the tiles that their ellipse of alpha >= 1/255 touches; see `check_entries`."""
    columns, rows = -(-width // TILE), -(-height // TILE)
    count = len(projected.ids)
    gaussian_start = np.zeros(count + 1, np.int64)
    capacity = TYPICAL * (count // CHUNKS + 1)
    while True:
        touched = np.empty((CHUNKS, capacity), np.int32)
        needed = _list(projected.table, columns, rows, gaussian_start[1:], touched)
        check_entries(int(needed.sum()), width, height)
        if needed.max() <= capacity:
            break
        capacity = int(needed.max())
    np.cumsum(gaussian_start, out=gaussian_start)
    touched = joined(touched.reshape(-1), capacity * np.arange(CHUNKS), needed)
    counts = _count(touched, gaussian_start, projected.order, nb.get_num_threads(), columns * rows)
    start = starts(counts.sum(axis=0))
    # From counts to places: parts follow each other within a tile, so that its entries stay sorted by depth.
    place = np.cumsum(counts, axis=0) - counts + start[:-1]
    entries = np.empty(start[-1], np.int32)
    _fill(touched, gaussian_start, projected.order, place, entries)
    size = width, height, columns, rows, stride_of(rows)
    return Tiles(*size, projected.table, start, entries, gaussian_start, touched)


def stride_of(rows: int) -> int:
    """Rows of tiles from one turn to the next, so that as many turns visit each row once: about 0.618 of them all.

    Every thread gets many turns in succession. Floors are full of Gaussians and ceilings empty, so no thread may get
    the upper part of the image and another one the lower: multiples of the golden ratio are spread evenly, however many
    there are.
    """
    stride = max(int(0.618 * rows), 1)
    while math.gcd(stride, rows) != 1:
        stride += 1
    return stride


def check_entries(total: int, width: int, height: int) -> None:
    """Raise `SceneValueError` where a view has more than `MOST_ENTRIES`."""
    if total > MOST_ENTRIES:
        raise SceneValueError(
            f"scene: its Gaussians touch {total} tiles of a view of {width} x {height} pixels, each counted for "
            f"each of them; expected at most {MOST_ENTRIES}"
        )


@nb.njit(inline="always")
def _touched(
    u: np.float32, v: np.float32, shear: np.float32, reach: np.float32, turn: np.float32,  # of the table
    cut: np.float32, height: np.float32, narrowness: np.float32,  # LOG_OPACITY less its least; HEIGHT; 1 / WIDTH
    row: np.float32, columns: np.float32,
) -> tuple[np.int32, np.int32]:  # fmt: skip
    """First and last tile column (exclusive) that a Gaussian touches in one row of tiles; without a branch."""
    top = row * np.float32(TILE) + np.float32(0.5) - v
    bottom = row * np.float32(TILE) + np.float32(TILE - 0.5) - v
    # The outline x(dy) is concave on the right and convex on the left: its extremes in the band are at the turning
    # points or the ends.
    dy = min(max(turn, top), bottom)
    right = shear * dy + np.sqrt(max(cut - height * dy * dy, np.float32(0)) * narrowness)
    dy = min(max(-turn, top), bottom)
    left = shear * dy - np.sqrt(max(cut - height * dy * dy, np.float32(0)) * narrowness)
    # A hundredth of a pixel of slack covers float32 rounding; the blend tests alpha itself.
    first, last = _tile_of(u + left - np.float32(0.51), columns), _tile_after(u + right - np.float32(0.49), columns)
    return first, last if (bottom >= -reach) & (top <= reach) else np.int32(0)


@nb.njit(inline="always")
def _tile_of(px: np.float32, limit: np.float32) -> np.int32:
    """Tile that a pixel is in, between the first one and a limit; `floor` would be a call of a function."""
    # In this order NaN becomes 0. An endless Gaussian has some: 0 times an infinite 1 / WIDTH.
    return np.int32(min(max(np.float32(0), px * np.float32(1 / TILE)), limit))


@nb.njit(inline="always")
def _tile_after(px: np.float32, limit: np.float32) -> np.int32:
    """Tile after that one; the first one if the pixel is before it."""
    return min(_tile_of(px, limit) + np.int32(px >= 0), np.int32(limit))


@called_by_kernels(error_model="numpy")
def _touch_two_rows(
    table: np.ndarray, columns: int, rows: int,  # (at most BATCH, 8)
    beside: np.ndarray,  # (8 * BATCH,) scratch: the table, column after column
    found: np.ndarray,  # (6 * BATCH,) int32 out: first and last row (exclusive); tiles in the first one, and the second
) -> None:  # fmt: skip
    """Most Gaussians touch one or two rows of tiles: tell those by instructions for several Gaussians at once."""
    across = np.float32(columns)
    for j in range(table.shape[0]):
        for column in range(8):
            beside[column * BATCH + j] = table[j, column]
    for j in range(table.shape[0]):
        u, v, shear = beside[U * BATCH + j], beside[V * BATCH + j], beside[SHEAR * BATCH + j]
        reach, turn = beside[Y_REACH * BATCH + j], beside[X_TURN * BATCH + j]
        cut, height = beside[LOG_OPACITY * BATCH + j] - _LEAST, beside[HEIGHT * BATCH + j]
        narrowness = np.float32(1) / beside[WIDTH * BATCH + j]
        low = _tile_of(v - reach - np.float32(0.5), np.float32(rows))
        high = _tile_after(v + reach - np.float32(0.5), np.float32(rows))
        row = np.float32(low)
        one = _touched(u, v, shear, reach, turn, cut, height, narrowness, row, across)
        two = _touched(u, v, shear, reach, turn, cut, height, narrowness, row + np.float32(1), across)
        begin = low * np.int32(columns)
        found[j], found[BATCH + j] = low, high
        found[2 * BATCH + j] = begin + one[0]
        found[3 * BATCH + j] = begin + (one[1] if low < high else np.int32(0))
        found[4 * BATCH + j] = begin + np.int32(columns) + two[0]
        found[5 * BATCH + j] = begin + np.int32(columns) + (two[1] if low + np.int32(1) < high else np.int32(0))


@kernel(parallel=True, error_model="numpy")
def _list(
    table: np.ndarray, columns: int, rows: int,  # (M, 8)
    per_gaussian: np.ndarray,  # (M,) out: tiles that it touches
    touched: np.ndarray,  # (CHUNKS, R) int32 out: these tiles, Gaussian after Gaussian, as far as they fit
) -> np.ndarray:  # fmt: skip
    """List which tiles Gaussians touch; returns how many each chunk has, (CHUNKS,), which may be more than fit."""
    count, capacity = table.shape[0], touched.shape[1]
    needed = np.zeros(CHUNKS, np.int64)
    for chunk in nb.prange(CHUNKS):
        own, n = touched[chunk], 0
        beside, found = np.empty(8 * BATCH, np.float32), np.empty(6 * BATCH, np.int32)
        last = (chunk + 1) * count // CHUNKS
        for begin in range(chunk * count // CHUNKS, last, BATCH):
            end = min(begin + BATCH, last)
            _touch_two_rows(table[begin:end], columns, rows, beside, found)
            for g in range(begin, end):
                j, before = g - begin, n
                one, one_end = found[2 * BATCH + j], found[3 * BATCH + j]
                two, two_end = found[4 * BATCH + j], found[5 * BATCH + j]
                low, high = found[j], found[BATCH + j]
                if high - low > 2 or one_end - one > 2 or two_end - two > 2 or n + 4 > capacity:
                    n = _list_many(table[g], low, high, columns, own, n)
                else:  # without a branch: what is not touched is overwritten
                    own[n] = one
                    n += one < one_end
                    own[n] = one + 1
                    n += one + 1 < one_end
                    own[n] = two
                    n += two < two_end
                    own[n] = two + 1
                    n += two + 1 < two_end
                per_gaussian[g] = n - before
        needed[chunk] = n
    return needed


@called_by_kernels(error_model="numpy", forceinline=False)  # which few Gaussians need
def _list_many(
    splat: np.ndarray, low: int, high: int, columns: int,  # (8,) a row of the table; rows of tiles, high excluded
    touched: np.ndarray, n: int,  # (R,) int32 out, from n on, as far as they fit
) -> int:  # fmt: skip
    """List the tiles of a Gaussian that may touch many; returns where the next one's begin."""
    cut, narrowness, across = splat[LOG_OPACITY] - _LEAST, np.float32(1) / splat[WIDTH], np.float32(columns)
    for row in range(low, high):
        first, last = _touched(
            splat[U], splat[V], splat[SHEAR], splat[Y_REACH], splat[X_TURN], cut, splat[HEIGHT], narrowness,
            np.float32(row), across,
        )  # fmt: skip
        for tile in range(row * columns + first, row * columns + last):
            if n < touched.shape[0]:
                touched[n] = tile
            n += 1
    return n


@kernel(parallel=True)
def _count(
    touched: np.ndarray, gaussian_start: np.ndarray, order: np.ndarray,  # (E,), (M + 1,), (M,)
    parts: int, num_tiles: int,
) -> np.ndarray:  # fmt: skip
    """Count the Gaussians of each part of an order that touch each tile, (parts, num_tiles) int64."""
    counts, count = np.zeros((parts, num_tiles), np.int64), order.shape[0]
    for part in nb.prange(parts):
        own = counts[part]
        if parts == 1:  # Then their order does not matter.
            for tile in touched:
                own[tile] += 1
            continue
        for m in range(part * count // parts, (part + 1) * count // parts):
            _fetch(touched, gaussian_start, order, m)
            g = order[m]
            for n in range(gaussian_start[g], gaussian_start[g + 1]):
                own[touched[n]] += 1
    return counts


@kernel(parallel=True)
def _fill(
    touched: np.ndarray, gaussian_start: np.ndarray, order: np.ndarray,  # (E,) in: tiles, out: entries; (M + 1,); (M,)
    place: np.ndarray,  # (parts, T) where the next entry of a tile goes
    entries: np.ndarray,  # (E,) out
) -> None:  # fmt: skip
    count, parts = order.shape[0], place.shape[0]
    for part in nb.prange(parts):
        cursor = place[part]
        for m in range(part * count // parts, (part + 1) * count // parts):
            _fetch(touched, gaussian_start, order, m)
            g = order[m]
            for n in range(gaussian_start[g], gaussian_start[g + 1]):
                e = cursor[touched[n]]
                cursor[touched[n]] = e + 1
                entries[e] = g
                touched[n] = e


@nb.njit(inline="always")
def _fetch(touched: np.ndarray, gaussian_start: np.ndarray, order: np.ndarray, m: int) -> None:
    """Ask for what of the two arrays is needed some places after place m of the order."""
    last = order.shape[0] - 1
    prefetch(gaussian_start, order[min(m + 2 * AHEAD, last)])
    prefetch(touched, gaussian_start[order[min(m + AHEAD, last)]])
