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

from gsseg_core.projection import HEIGHT, LOG_OPACITY, SHEAR, WIDTH, Y_REACH, U, V
from gsseg_core.tiles import LOG_ALPHA_MIN, TILE

ALPHA_MAX = np.float32(0.99)
T_MIN = np.float32(1e-4)
"""A ray ends when its transmittance falls below this."""

_CUT = np.float32(LOG_ALPHA_MIN)

# 2^f on [0, 1): the degree 5 polynomial of least relative error, 7.5e-8.
_P0, _P1, _P2, _P3, _P4, _P5 = (
    np.float32(0.9999999250589409),
    np.float32(0.6931530732228367),
    np.float32(0.2401536175498326),
    np.float32(0.0558263151665912),
    np.float32(0.008989344870914073),
    np.float32(0.0018775742137189244),
)


@nb.njit(inline="always")
def _exp2(x: float) -> np.float32:
    """2^x for x in [-126, 1), in float32, without a call, so that sixteen run at once."""
    whole = np.floor(x)
    f = np.float32(x - whole)
    p = _P0 + f * (_P1 + f * (_P2 + f * (_P3 + f * (_P4 + f * _P5))))
    bits = np.float32(p).view(np.int32) + (np.int32(whole) << 23)
    return np.int32(bits).view(np.float32)


@nb.njit(fastmath={"contract", "nnan", "nsz", "reassoc"}, error_model="numpy")
def blend_tile(
    tile: int,
    columns: int,  # tiles across
    width: int,  # px
    height: int,  # px
    table: np.ndarray,  # (M, 9) projected Gaussians
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
    # Read from the array, since a loop of a constant sixteen would be unrolled into scalars before it can become a
    # vector.
    lanes = weights.shape[1]
    n = 0
    for e in range(first, last):
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
            off = max(-x, max(x - np.float32(TILE - 1), np.float32(0.0)))
            if peak - wide * off * off < _CUT:
                continue
            open_rays = np.int32(0)
            ray, record = transmittance[r], weights[n]
            for c in range(lanes):
                dx = np.float32(c) - x
                power = peak - wide * dx * dx
                alpha = min(_exp2(max(power, np.float32(-20.0))), ALPHA_MAX)
                t = ray[c]
                w = alpha * t if (power >= _CUT and t >= T_MIN) else np.float32(0.0)
                t -= w
                record[c] = w
                ray[c] = t
                open_rays += np.int32(1) if t >= T_MIN else np.int32(0)
            rows[n] = r
            n += 1
            if open_rays == 0:
                live[r] = False
                live_rows -= 1
        ends[e - first] = n
        if live_rows == 0:
            return e - first + 1
    return last - first
