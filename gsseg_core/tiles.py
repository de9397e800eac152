"""Which Gaussians reach which 16 x 16 tile of the image, nearest first."""

from __future__ import annotations

from dataclasses import dataclass

import numba as nb
import numpy as np

from gsseg_core.projection import HEIGHT, LOG_OPACITY, SHEAR, WIDTH, X_TURN, Y_REACH, Projected, U, V

TILE = 16
"""Side of a tile in px. One row of a tile is one vector register of sixteen float32."""

LOG_ALPHA_MIN = -np.log2(255.0)


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
    start = np.zeros(columns * rows + 1, np.int64)
    _count(projected.table, columns, rows, start[1:])
    np.cumsum(start, out=start)
    entries = np.empty(start[-1], np.int32)
    _fill(projected.table, columns, rows, start, entries)
    gaussian_start = np.zeros(len(projected.ids) + 1, np.int64)
    gaussian_entries = np.empty(len(entries), np.int32)
    _transpose(entries, gaussian_start, gaussian_entries)
    return Tiles(columns, rows, start, entries, gaussian_start, gaussian_entries)


@nb.njit(inline="always")
def _touched(
    table: np.ndarray,  # (M, 9)
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
def _count(table: np.ndarray, columns: int, rows: int, counts: np.ndarray) -> None:
    for row in nb.prange(rows):
        for g in range(table.shape[0]):
            first, last = _touched(table, g, row, columns)
            for column in range(first, last):
                counts[row * columns + column] += 1


@nb.njit(parallel=True, nogil=True, cache=True, error_model="numpy")
def _fill(table: np.ndarray, columns: int, rows: int, start: np.ndarray, entries: np.ndarray) -> None:
    for row in nb.prange(rows):
        cursor = start[row * columns : (row + 1) * columns].copy()
        for g in range(table.shape[0]):
            first, last = _touched(table, g, row, columns)
            for column in range(first, last):
                entries[cursor[column]] = g
                cursor[column] += 1


@nb.njit(nogil=True, cache=True)
def _transpose(entries: np.ndarray, start: np.ndarray, by_gaussian: np.ndarray) -> None:
    for g in entries:
        start[g + 1] += 1
    for g in range(start.shape[0] - 1):
        start[g + 1] += start[g]
    cursor = start[:-1].copy()
    for e in range(entries.shape[0]):
        g = entries[e]
        by_gaussian[cursor[g]] = e
        cursor[g] += 1
