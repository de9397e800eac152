"""Which Gaussians reach which 16 x 16 tile of the image, nearest first."""

from __future__ import annotations

from dataclasses import dataclass

import numba as nb
import numpy as np

from gsseg_core.lanes import HEIGHT, LANES, LOG_ALPHA_MIN, LOG_OPACITY, SHEAR, WIDTH, X_TURN, Y_REACH, U, V
from gsseg_core.projection import Projected

TILE = LANES
"""Side of a tile in px. One row of a tile is one vector register of sixteen float32."""

TYPICAL = 4
"""Tiles that a Gaussian touches, at first; where they touch more on average, they are listed once more."""

_LEAST = np.float32(LOG_ALPHA_MIN)

CHUNKS = 16
"""Parts into which Gaussians are cut, to be sorted beside each other; fixed, so that threads change nothing."""


@dataclass(frozen=True)
class Tiles:
    """The image cut into tiles, row by row, and the Gaussians of each.

    An *entry* is one Gaussian in one tile. Entries of a tile are contiguous and sorted by depth.

    Attributes
    ----------
    columns, rows : int
        Number of tiles across and down.
    start : (columns * rows + 1,) int64
        Entries of tile t are start[t] to start[t + 1].
    entries : (E,) int32
        Row of each entry's Gaussian in the table of projected Gaussians.
    gaussian_start : (M + 1,) int64, gaussian_entries : (E,) int32
        The same relation by Gaussian: its entries, in tile order.
    """

    columns: int
    rows: int
    start: np.ndarray
    entries: np.ndarray
    gaussian_start: np.ndarray
    gaussian_entries: np.ndarray


def assign(projected: Projected, width: int, height: int) -> Tiles:
    """Sort projected Gaussians into the tiles that their ellipse of alpha >= 1/255 touches."""
    columns, rows = -(-width // TILE), -(-height // TILE)
    many = len(projected.ids)
    gaussian_start = np.zeros(many + 1, np.int64)
    place, room = np.zeros((CHUNKS, columns * rows), np.int64), TYPICAL * (many // CHUNKS + 1)
    while True:
        touched = np.empty((CHUNKS, room), np.int32)
        most = _list(projected.table, columns, rows, gaussian_start[1:], place, touched)
        if most <= room:
            break
        room = most
    np.cumsum(gaussian_start, out=gaussian_start)
    start = np.concatenate([[0], np.cumsum(place.sum(axis=0))])
    # From counts to places: chunks follow each other within a tile, so that its entries stay sorted by depth.
    place[1:] = np.cumsum(place[:-1], axis=0)
    place[0] = 0
    place += start[:-1]
    entries, gaussian_entries = np.empty(start[-1], np.int32), np.empty(start[-1], np.int32)
    _fill(touched, gaussian_start, place, entries, gaussian_entries)
    return Tiles(columns, rows, start, entries, gaussian_start, gaussian_entries)


@nb.njit(inline="always")
def _rows_of(v: np.float32, reach: np.float32, rows: int) -> tuple[int, int]:
    """First and last tile row (exclusive) that a Gaussian may touch."""
    first = np.floor((v - reach - np.float32(0.5)) * np.float32(1 / TILE))
    last = np.floor((v + reach - np.float32(0.5)) * np.float32(1 / TILE)) + np.float32(1)
    return int(max(first, np.float32(0))), int(min(max(last, np.float32(0)), np.float32(rows)))


@nb.njit(inline="always")
def _touched(
    u: np.float32,
    v: np.float32,
    shear: np.float32,
    reach: np.float32,
    turn: np.float32,
    cut: np.float32,  # LOG_OPACITY less its least
    height: np.float32,
    narrowness: float,  # 1 / WIDTH
    row: int,
    columns: int,
) -> tuple[int, int]:
    """First and last tile column (exclusive) that a Gaussian touches in one row of tiles."""
    top, bottom = np.float32(row * TILE + 0.5) - v, np.float32(row * TILE + TILE - 0.5) - v
    if bottom < -reach or top > reach:
        return 0, 0
    # The outline x(dy) is concave on the right and convex on the left: its extremes in the band are at the turning
    # points or the ends.
    dy = min(max(turn, top), bottom)
    right = shear * dy + np.sqrt(max(cut - height * dy * dy, np.float32(0)) * narrowness)
    dy = min(max(-turn, top), bottom)
    left = shear * dy - np.sqrt(max(cut - height * dy * dy, np.float32(0)) * narrowness)
    # A hundredth of a pixel of slack covers float32 rounding; the blend tests alpha itself.
    first = np.floor((u + left - np.float32(0.51)) * np.float32(1 / TILE))
    last = np.floor((u + right - np.float32(0.49)) * np.float32(1 / TILE)) + np.float32(1)
    return int(max(first, np.float32(0))), int(min(max(last, np.float32(0)), np.float32(columns)))


@nb.njit(parallel=True, nogil=True, cache=True, error_model="numpy")
def _list(
    table: np.ndarray,  # (M, 8)
    columns: int,
    rows: int,
    per_gaussian: np.ndarray,  # (M,) out: tiles that it touches
    per_tile: np.ndarray,  # (CHUNKS, T) out: Gaussians of each chunk that touch it
    touched: np.ndarray,  # (CHUNKS, R) int32 out: these tiles, Gaussian after Gaussian, as far as there is room
) -> int:
    """List which tiles Gaussians touch; returns the room that the chunk with most of them needs."""
    many, room = table.shape[0], touched.shape[1]
    needed = np.zeros(CHUNKS, np.int64)
    for chunk in nb.prange(CHUNKS):
        counts, mine, n = per_tile[chunk], touched[chunk], 0
        counts[:] = 0
        for g in range(chunk * many // CHUNKS, (chunk + 1) * many // CHUNKS):
            u, v, shear, reach = table[g, U], table[g, V], table[g, SHEAR], table[g, Y_REACH]
            turn, cut = table[g, X_TURN], table[g, LOG_OPACITY] - _LEAST
            height, narrowness = table[g, HEIGHT], np.float32(1) / table[g, WIDTH]
            before = n
            low, high = _rows_of(v, reach, rows)
            for row in range(low, high):
                first, last = _touched(u, v, shear, reach, turn, cut, height, narrowness, row, columns)
                for tile in range(row * columns + first, row * columns + last):
                    counts[tile] += 1
                    if n < room:
                        mine[n] = tile
                    n += 1
            per_gaussian[g] = n - before
        needed[chunk] = n
    return int(needed.max())


@nb.njit(parallel=True, nogil=True, cache=True)
def _fill(
    touched: np.ndarray,  # (CHUNKS, R)
    gaussian_start: np.ndarray,  # (M + 1,)
    place: np.ndarray,  # (CHUNKS, T) where each chunk's next entry of a tile goes
    entries: np.ndarray,  # (E,) out
    gaussian_entries: np.ndarray,  # (E,) out
) -> None:
    many = gaussian_start.shape[0] - 1
    for chunk in nb.prange(CHUNKS):
        cursor, mine = place[chunk], touched[chunk]
        begin = gaussian_start[chunk * many // CHUNKS]
        for g in range(chunk * many // CHUNKS, (chunk + 1) * many // CHUNKS):
            for n in range(gaussian_start[g], gaussian_start[g + 1]):
                tile = mine[n - begin]
                e = cursor[tile]
                cursor[tile] = e + 1
                entries[e] = g
                gaussian_entries[n] = e
