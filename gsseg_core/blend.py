"""The inner loop: blend the Gaussians of one tile, and keep their weights just long enough to use them.

Everything that the system does with a view is a product with its weight matrix W or the transpose. W is never stored:
the kernels here make the rows of W that belong to one 16 x 16 tile, in the processor's cache, and use them at once. A
*record* is one Gaussian in one row of a tile: sixteen weights, one vector register.

Sums over tiles go through one slot per (Gaussian, tile), added up Gaussian by Gaussian afterwards, in a fixed order.
So there are no atomic operations, and the result does not depend on the number of threads.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from gsseg_core.lanes import LOG_ALPHA_MIN, blend_row, prefetch
from gsseg_core.projection import HEIGHT, LOG_OPACITY, SHEAR, WIDTH, Y_REACH, U, V
from gsseg_core.tiles import TILE

_CUT = np.float32(LOG_ALPHA_MIN)

AHEAD = 12
"""Entries between the one that is blended and the one that is fetched from memory."""


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
    left, top = (tile % columns) * TILE, (tile // columns) * TILE
    live = np.zeros(TILE, np.bool_)
    live_rows = 0
    for r in range(TILE):
        inside = top + r < height
        live[r] = inside
        live_rows += inside
        for c in range(TILE):
            transmittance[r, c] = 1.0 if inside and left + c < width else 0.0
    n = 0
    for e in range(first, last):
        prefetch(table, entries[min(e + AHEAD, last - 1)])
        g = entries[e]
        u, v = table[g, U] - np.float32(left + 0.5), table[g, V] - np.float32(top + 0.5)
        shear, wide, high, log_opacity = table[g, SHEAR], table[g, WIDTH], table[g, HEIGHT], table[g, LOG_OPACITY]
        reach = table[g, Y_REACH]
        for r in range(max(0, int(np.ceil(v - reach))), min(TILE, int(np.floor(v + reach)) + 1)):
            if not live[r]:
                continue
            dy = np.float32(r) - v
            peak = log_opacity - high * dy * dy
            x = u + shear * dy
            bits = blend_row(transmittance, r, weights, n, x, peak, wide)
            rows[n] = r
            n += int(bits >= np.uint32(65536))
            if not bits & np.uint32(65535):
                live[r] = False
                live_rows -= 1
        ends[e - first] = n
        if live_rows == 0:
            return e - first + 1
    return last - first
