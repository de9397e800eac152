"""Which cells of the ground a robot must not drive over: those that some Gaussians stand above, between two heights.

A Gaussian is the ellipsoid of one standard deviation, and is sampled densely enough that no cell between two samples is
left out: centres alone would leave gaps in a plain wall, which a trained scene covers with few and wide Gaussians.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from gsseg_core.errors import SettingsError

OPAQUE = 0.1  # opacity from which on a Gaussian is solid
_MOST_SAMPLES = 1 << 18  # of an ellipsoid, about: enough for a wall that is 128 cells from its middle to each side
_AT_ONCE = 1 << 20  # so many samples at a time, to keep memory small


def occupied_cells(
    means: npt.NDArray[np.floating],  # (N, 3): of the ellipsoids, z being up; all in one unit
    half_axes: npt.NDArray[np.floating],  # (N, 3, 3): one in each column
    size: float,  # side of a cell
    low: float,  # what lies lower does not count
    high: float,  # what lies higher does not count
) -> npt.NDArray[np.float32]:
    """Find the cells, squares of a size along x and y from the origin on, that ellipsoids stand above, (M, 3).

    Of each cell the middle, and the lowest height between the two at which it is occupied; by cell, x before y. Raises
    `SettingsError` for a size that is none.
    """
    if not 0 < size < np.inf:
        raise SettingsError(f"size of a cell is {size}; expected a number above 0")
    # Cells are numbered in floats: those that an endless Gaussian reaches are beyond all integers.
    keys, heights = [np.empty((0, 2))], [np.empty(0)]
    for points in samples(np.asarray(means, np.float64), np.asarray(half_axes, np.float64), size):
        points = points[(points[:, 2] >= low) & (points[:, 2] <= high)]
        cells, z = _lowest(np.floor(points[:, :2] / size), points[:, 2])
        keys.append(cells)
        heights.append(z)
    cells, z = _lowest(np.concatenate(keys), np.concatenate(heights))
    return np.column_stack([(cells + 0.5) * size, z]).astype(np.float32)


def _lowest(
    cells: npt.NDArray[np.float64],  # (n, 2)
    heights: npt.NDArray[np.float64],  # (n,)
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Each cell once, in order, with its least height."""
    order = np.lexsort((heights, cells[:, 1], cells[:, 0]))
    cells, heights = cells[order], heights[order]
    first = np.append(True, (cells[1:] != cells[:-1]).any(axis=1))[: len(cells)]
    return cells[first], heights[first]


def samples(
    means: npt.NDArray[np.float64],  # (N, 3)
    half_axes: npt.NDArray[np.float64],  # (N, 3, 3)
    size: float,
) -> Iterator[npt.NDArray[np.float64]]:
    """Points (n, 3) of the ellipsoids, some at a time; less than a size apart along each axis, unless too many."""
    lengths = np.linalg.norm(half_axes, axis=1)  # (N, 3)
    # Powers of two: few different grids, each for many ellipsoids at once.
    powers = np.ceil(np.log2(np.maximum(2 * lengths / size, 1)))
    while (many := powers.sum(axis=1, keepdims=True) > np.log2(_MOST_SAMPLES)).any():
        powers = np.where(many, np.minimum(powers, powers.max(axis=1, keepdims=True) - 1), powers)
    counts = 2 ** powers.astype(np.int64)
    for count in np.unique(counts, axis=0):
        sides = [(2 * np.arange(n) + 1) / n - 1 for n in count.tolist()]
        grid = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 3)
        grid = grid[(grid**2).sum(axis=1) <= 1]
        index = np.flatnonzero((counts == count).all(axis=1))
        step = max(1, _AT_ONCE // len(grid))
        for first in range(0, len(index), step):
            own = index[first : first + step]
            yield (means[own, None] + np.einsum("sk,mjk->msj", grid, half_axes[own])).reshape(-1, 3)
