"""The inner loop: blend the Gaussians of one tile, and keep their weights just long enough to use them.

Everything that the system does with a view is a product with its weight matrix W or the transpose. W is never stored:
the kernels here make the rows of W that belong to one 16 x 16 tile, in the processor's cache, and use them at once. A
*record* is one Gaussian in one row of a tile: sixteen weights, one vector register.

Sums over tiles go through one slot per (Gaussian, tile), added up Gaussian by Gaussian afterwards, in a fixed order.
So there are no atomic operations, and the result does not depend on the number of threads.
"""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np

from gsseg_core.lanes import OPEN, WIDTH, aim, blend_row, first_bit, prefetch, store_row
from gsseg_core.tiles import TILE

AHEAD = 12
"""Entries between the one that is blended and the one that is fetched from memory."""


@nb.njit(inline="always")
def open_rays(
    tile: int,
    columns: int,  # tiles across
    width: int,  # px
    height: int,  # px
    transmittance: np.ndarray,  # (16, 16) float32 out
) -> tuple[Any, Any, int]:
    """Begin with a tile: the pixel centre of its corner, and a bit for each of its rows that is in the image."""
    left, top = (tile % columns) * TILE, (tile // columns) * TILE
    for r in range(TILE):
        for c in range(TILE):
            transmittance[r, c] = 1.0 if top + r < height and left + c < width else 0.0
    return np.float32(left + 0.5), np.float32(top + 0.5), (1 << min(TILE, height - top)) - 1


@nb.njit(fastmath={"contract"}, error_model="numpy")
def blend_tile(
    tile: int,
    columns: int,  # tiles across
    width: int,  # px
    height: int,  # px
    table: np.ndarray,  # (M, 8) projected Gaussians
    entries: np.ndarray,  # (E,) rows of the table, by tile, nearest first
    first: int,  # entries of this tile
    last: int,
    transmittance: np.ndarray,  # (16, 16) float32 out
    weights: np.ndarray,  # (16 * (last - first), 16) float32 out: the records
    rows: np.ndarray,  # (16 * (last - first),) uint8 out: row in the tile of each record
    ends: np.ndarray,  # (last - first,) int32 out: one past the last record of each entry
) -> int:
    """Make the records of one tile; returns how many of its entries were blended before every ray had ended."""
    left, top, live = open_rays(tile, columns, width, height, transmittance)
    lines = np.empty((2, TILE), np.float32)
    n = 0
    for e in range(first, last):
        prefetch(table, entries[min(e + AHEAD, last - 1)])
        g = entries[e]
        reached = aim(table, g, left, top, lines) & live
        while reached:
            r = first_bit(reached)
            reached &= reached - 1
            weight, bits = blend_row(transmittance, r, lines, table[g, WIDTH])
            store_row(weights, n, weight)
            rows[n] = r
            n += bits > OPEN
            if not bits & OPEN:
                live &= ~(1 << r)
        ends[e - first] = n
        if not live:
            return e - first + 1
    return last - first
