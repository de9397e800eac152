"""A tile rasteriser as one would write it at first: the baseline that the one in `gsseg_core` is measured against.

Tiles in parallel; in a tile Gaussian after Gaussian, and for each the pixels within its bounds, one by one. Every tile
keeps sums of its own, which are added up afterwards, so it needs no atomic operations. It is handed the Gaussians as
projected, sorted and sorted into tiles by `gsseg_core`: only the lift itself is compared.
"""

from __future__ import annotations

from typing import NamedTuple

import numba as nb
import numpy as np

from gsseg_core.raster.constants import T_LIFTED
from gsseg_core.raster.cpu.projection import HALF_LOG2E, HEIGHT, LOG_OPACITY, SHEAR, WIDTH, Projected, U, V
from gsseg_core.raster.cpu.tiling import TILE, Tiles


class Splats(NamedTuple):
    """Gaussians on the image, in the usual form.

    Attributes
    ----------
    centres : (M, 2) float32
        In px.
    conics : (M, 3) float32
        a, b, c of the inverse covariance [[a, b], [b, c]], in px^-2.
    opacities : (M,) float32
    reaches : (M, 2) float32
        Half the width and height of the ellipse where alpha is 1/255, in px.
    """

    centres: np.ndarray
    conics: np.ndarray
    opacities: np.ndarray
    reaches: np.ndarray


def to_splats(projected: Projected) -> Splats:
    """Write projected Gaussians in the usual form."""
    table = projected.table.astype(np.float64)
    shear, conditional, syy = table[:, SHEAR], HALF_LOG2E / table[:, WIDTH], HALF_LOG2E / table[:, HEIGHT]
    sxx = conditional + shear**2 * syy
    conics = np.stack([1 / conditional, -shear / conditional, sxx / (conditional * syy)], axis=1)
    opacities = np.exp2(table[:, LOG_OPACITY])
    cut = 2 * np.log(np.maximum(255 * opacities, 1))
    reaches = np.sqrt(cut[:, None] * np.stack([sxx, syy], axis=1)) + 0.01
    arrays = (table[:, [U, V]], conics, opacities, reaches)
    return Splats(*(np.ascontiguousarray(array, np.float32) for array in arrays))


def first_lift(
    splats: Splats,
    tiles: Tiles,
    labels: np.ndarray,  # (H, W) int32, negative = unknown
    num_labels: int,
) -> np.ndarray:
    """Weights summed by label, (M, L) float32."""
    sums = np.zeros((len(tiles.entries), num_labels), np.float32)
    _lift(*splats, tiles.columns, tiles.start, tiles.entries, labels, sums)
    out = np.zeros((len(splats.centres), num_labels), np.float32)
    _add_up(tiles.gaussian_start, tiles.gaussian_entries, sums, out)
    return out


@nb.njit(parallel=True, cache=True, fastmath=True)
def _lift(
    centres: np.ndarray,
    conics: np.ndarray,
    opacities: np.ndarray,
    reaches: np.ndarray,
    columns: int,
    start: np.ndarray,  # (T + 1,)
    entries: np.ndarray,  # (E,)
    labels: np.ndarray,  # (H, W)
    sums: np.ndarray,  # (E, L) out
) -> None:
    height, width = labels.shape
    for tile in nb.prange(len(start) - 1):
        left, top = (tile % columns) * TILE, (tile // columns) * TILE
        right, bottom = min(left + TILE, width), min(top + TILE, height)
        transmittance = np.ones((TILE, TILE), np.float32)
        open_rays = (right - left) * (bottom - top)
        for e in range(start[tile], start[tile + 1]):
            g = entries[e]
            u, v, reach_x, reach_y = centres[g, 0], centres[g, 1], reaches[g, 0], reaches[g, 1]
            a, b, c, opacity = conics[g, 0], conics[g, 1], conics[g, 2], opacities[g]
            for row in range(max(top, int(np.floor(v - reach_y))), min(bottom, int(np.ceil(v + reach_y)))):
                for column in range(max(left, int(np.floor(u - reach_x))), min(right, int(np.ceil(u + reach_x)))):
                    before = transmittance[row - top, column - left]
                    if before < np.float32(T_LIFTED):
                        continue
                    dx, dy = np.float32(column + 0.5) - u, np.float32(row + 0.5) - v
                    power = np.float32(-0.5) * (a * dx * dx + c * dy * dy) - b * dx * dy
                    alpha = min(np.float32(0.99), opacity * np.exp(power))
                    if alpha < np.float32(1 / 255):
                        continue
                    weight = alpha * before
                    if before - weight < np.float32(T_LIFTED):
                        weight = before
                        open_rays -= 1
                    transmittance[row - top, column - left] = before - weight
                    label = labels[row, column]
                    if label >= 0:
                        sums[e, label] += weight
            if open_rays == 0:
                break


@nb.njit(parallel=True, cache=True)
def _add_up(
    gaussian_start: np.ndarray,  # (M + 1,)
    gaussian_entries: np.ndarray,  # (E,)
    sums: np.ndarray,  # (E, L)
    out: np.ndarray,  # (M, L) out
) -> None:
    for g in nb.prange(len(out)):
        for i in range(gaussian_start[g], gaussian_start[g + 1]):
            for label in range(out.shape[1]):
                out[g, label] += sums[gaussian_entries[i], label]
