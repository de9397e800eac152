"""The inner loop: blend the Gaussians of one tile, and keep their weights just long enough to use them.

Everything that the system does with a view is a product with its weight matrix W or the transpose. W is never stored:
the kernels here make the rows of W that belong to one 16 x 16 tile, in the processor's cache, and use them at once.

A tile is cut into sixteen *blocks* of 4 x 4 pixels, numbered row by row, as the pixels of each are. A *record* is one
Gaussian in one block: sixteen weights, one vector register. Trained Gaussians are small, and squares are met by a third
fewer of them than rows of sixteen pixels are.

Sums over tiles go through one slot per (Gaussian, tile), added up Gaussian by Gaussian afterwards, in a fixed order.
So there are no atomic operations, and the result does not depend on the number of threads.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numba as nb
import numpy as np

from gsseg_core.kernels.compiler import called_by_kernels
from gsseg_core.raster.constants import BLOCK
from gsseg_core.raster.cpu.splat import OPEN, WIDTH, aim, blend_block
from gsseg_core.raster.cpu.tiling import TILE, Tiles
from gsseg_core.simd import AHEAD, first_bit, prefetch, store_row


class Records(NamedTuple):
    """The rows of W that belong to one tile, as far as not every ray had ended."""

    weights: np.ndarray  # (R, 16) float32: pixel by pixel of each record's block
    blocks: np.ndarray  # (R,) uint8: block of each record
    ends: np.ndarray  # (E_t,) int32: one past the last record of each entry that was blended


@nb.njit(inline="always")
def in_block(r: int, c: int) -> tuple[int, int]:
    """Block of the pixel in row r and column c of a tile, and its place there."""
    return r // BLOCK * BLOCK + c // BLOCK, r % BLOCK * BLOCK + c % BLOCK


@nb.njit(inline="always")
def in_tile(b: int, lane: int) -> tuple[int, int]:
    """Row and column in the tile of pixel `lane` of block b: the same formula, which is its own inverse."""
    return in_block(b, lane)


@nb.njit(inline="always")
def tile_of_turn(tiles: Tiles, turn: int) -> int:
    """Which tile comes at a turn, of as many as there are tiles."""
    return (turn // tiles.columns * tiles.stride % tiles.rows) * tiles.columns + turn % tiles.columns


@nb.njit(inline="always")
def corner_of(tiles: Tiles, tile: int) -> tuple[int, int]:
    """Column and row of the first pixel of a tile."""
    return (tile % tiles.columns) * TILE, (tile // tiles.columns) * TILE


@called_by_kernels
def blocks_with(wanted: np.ndarray, left: int, top: int) -> int:  # (H, W) bool, or (0, 0) for all
    """Which blocks of a tile have pixels that are wanted, as bits."""
    if not wanted.size:
        return OPEN
    blocks = 0
    for r in range(top, min(top + TILE, wanted.shape[0])):
        for c in range(left, min(left + TILE, wanted.shape[1])):
            blocks |= wanted[r, c] << in_block(r - top, c - left)[0]
    return blocks


@nb.njit(inline="always")
def open_rays(tiles: Tiles, tile: int, rays: np.ndarray) -> tuple[Any, Any, int]:
    """Begin with a tile: the pixel centre of its corner, and a bit for each of its blocks that is in the image.

    Transmittances, (16, 16) float32 by block, are set to 1 in the image and to 0 elsewhere.
    """
    (left, top), live = corner_of(tiles, tile), 0
    for r in range(TILE):
        for c in range(TILE):
            b, lane = in_block(r, c)
            inside = top + r < tiles.height and left + c < tiles.width
            rays[b, lane] = 1.0 if inside else 0.0
            live |= inside << b
    return np.float32(left + 0.5), np.float32(top + 0.5), live


@called_by_kernels
def aim_next(
    table: np.ndarray, entries: np.ndarray, e: int, last: int, left: float, top: float, lines: np.ndarray
) -> int:
    """Aim the entry after e, before e is blended: pair (e + 1) % 2 of the lines, (2, 2, 16) float32, is its own.

    How many blocks an entry reaches, no processor guesses; where it is known a whole entry early, a wrong guess costs
    little. That saves a quarter of the lift.
    """
    if e + 1 == last:
        return 0
    prefetch(table, entries[min(e + AHEAD, last - 1)])
    return aim(table, entries[e + 1], left, top, lines, (e + 1) % 2)


@called_by_kernels(fastmath={"contract"}, error_model="numpy")
def blend_tile(tiles: Tiles, tile: int) -> Records:
    """Make the records of one tile."""
    first, last, table, entries = tiles.start[tile], tiles.start[tile + 1], tiles.table, tiles.entries
    # Sized for the worst case; pages that no record reaches are never touched.
    rays, weights = np.empty((TILE, TILE), np.float32), np.empty((TILE * (last - first), TILE), np.float32)
    blocks, ends = np.empty(TILE * (last - first), np.uint8), np.empty(last - first, np.int32)
    left, top, live = open_rays(tiles, tile, rays)
    lines = np.empty((2, 2, TILE), np.float32)
    n, ahead = 0, aim_next(table, entries, first - 1, last, left, top, lines)
    for e in range(first, last):
        reached, wide = ahead & live, table[entries[e], WIDTH]
        ahead = aim_next(table, entries, e, last, left, top, lines)
        while reached:
            b = first_bit(reached)
            reached &= reached - 1
            weight, bits = blend_block(rays, b, lines, e % 2, wide)
            store_row(weights, n, weight)
            blocks[n] = b
            n += bits > OPEN
            if not bits & OPEN:
                live &= ~(1 << b)
        ends[e - first] = n
        if not live:
            return Records(weights, blocks, ends[: e - first + 1])
    return Records(weights, blocks, ends)
