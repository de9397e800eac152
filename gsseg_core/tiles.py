"""Which Gaussians reach which 16 x 16 tile of the image, nearest first."""

from __future__ import annotations

from dataclasses import dataclass

import numba as nb
import numpy as np

from gsseg_core.lanes import HEIGHT, LANES, LOG_ALPHA_MIN, LOG_OPACITY, SHEAR, WIDTH, X_TURN, Y_REACH, U, V
from gsseg_core.projection import Projected

TILE = LANES
"""Side of a tile in px. One row of a tile is one vector register of sixteen float32."""

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
    gaussian_start = np.zeros(len(projected.ids) + 1, np.int64)
    place = np.zeros((CHUNKS, columns * rows), np.int64)
    _count(projected.table, columns, rows, gaussian_start[1:], place)
    np.cumsum(gaussian_start, out=gaussian_start)
    start = np.concatenate([[0], np.cumsum(place.sum(axis=0))])
    # From counts to places: chunks follow each other within a tile, so that its entries stay sorted by depth.
    place[1:] = np.cumsum(place[:-1], axis=0)
    place[0] = 0
    place += start[:-1]
    entries, gaussian_entries = np.empty(start[-1], np.int32), np.empty(start[-1], np.int32)
    _fill(projected.table, columns, rows, gaussian_start, place, entries, gaussian_entries)
    return Tiles(columns, rows, start, entries, gaussian_start, gaussian_entries)


@nb.njit(inline="always")
def _rows_of(
    table: np.ndarray,  # (M, 8)
    g: int,
    rows: int,
) -> tuple[int, int]:
    """First and last tile row (exclusive) that Gaussian g may touch."""
    v, reach = table[g, V], table[g, Y_REACH]
    first, last = np.floor((v - reach - 0.5) / TILE), np.floor((v + reach - 0.5) / TILE) + 1
    return int(max(first, 0.0)), int(min(max(last, 0.0), rows))


@nb.njit(inline="always")
def _touched(
    table: np.ndarray,  # (M, 8)
    g: int,
    row: int,
    columns: int,
) -> tuple[int, int]:
    """First and last tile column (exclusive) that Gaussian g touches in one row of tiles."""
    top, bottom = row * TILE + 0.5 - table[g, V], row * TILE + TILE - 0.5 - table[g, V]
    reach = table[g, Y_REACH]
    if bottom < -reach or top > reach:
        return 0, 0
    cut = table[g, LOG_OPACITY] - LOG_ALPHA_MIN
    # The outline x(dy) is concave on the right and convex on the left: its extremes in the band are at the turning
    # points or the ends.
    dy = min(max(table[g, X_TURN], top), bottom)
    right = table[g, SHEAR] * dy + np.sqrt(max(cut - table[g, HEIGHT] * dy * dy, 0.0) / table[g, WIDTH])
    dy = min(max(-table[g, X_TURN], top), bottom)
    left = table[g, SHEAR] * dy - np.sqrt(max(cut - table[g, HEIGHT] * dy * dy, 0.0) / table[g, WIDTH])
    # A hundredth of a pixel of slack covers float32 rounding; the blend tests alpha itself.
    first = np.floor((table[g, U] + left - 0.51) / TILE)
    last = np.floor((table[g, U] + right - 0.49) / TILE) + 1
    return int(max(first, 0.0)), int(min(max(last, 0.0), columns))


@nb.njit(parallel=True, nogil=True, cache=True, error_model="numpy")
def _count(
    table: np.ndarray,  # (M, 8)
    columns: int,
    rows: int,
    per_gaussian: np.ndarray,  # (M,) out
    per_tile: np.ndarray,  # (CHUNKS, T) out: of each chunk of Gaussians
) -> None:
    many = table.shape[0]
    for chunk in nb.prange(CHUNKS):
        counts = per_tile[chunk]
        for g in range(chunk * many // CHUNKS, (chunk + 1) * many // CHUNKS):
            low, high = _rows_of(table, g, rows)
            for row in range(low, high):
                first, last = _touched(table, g, row, columns)
                for column in range(first, last):
                    counts[row * columns + column] += 1
                per_gaussian[g] += max(last - first, 0)


@nb.njit(parallel=True, nogil=True, cache=True, error_model="numpy")
def _fill(
    table: np.ndarray,  # (M, 8)
    columns: int,
    rows: int,
    gaussian_start: np.ndarray,  # (M + 1,)
    place: np.ndarray,  # (CHUNKS, T) where each chunk's next entry of a tile goes
    entries: np.ndarray,  # (E,) out
    gaussian_entries: np.ndarray,  # (E,) out
) -> None:
    many = table.shape[0]
    for chunk in nb.prange(CHUNKS):
        cursor = place[chunk]
        for g in range(chunk * many // CHUNKS, (chunk + 1) * many // CHUNKS):
            n = gaussian_start[g]
            low, high = _rows_of(table, g, rows)
            for row in range(low, high):
                first, last = _touched(table, g, row, columns)
                for column in range(first, last):
                    e = cursor[row * columns + column]
                    cursor[row * columns + column] = e + 1
                    entries[e] = g
                    gaussian_entries[n] = e
                    n += 1
