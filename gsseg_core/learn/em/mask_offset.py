"""Mask offset: how far a mask as a whole lies beside its image, since its pose is off or it is of another moment.

A camera turned by half a degree shows everything a few px away from where its mask has it. All boundaries of such a
mask meet edges of the scene once it is moved by as much, so of all offsets the one is found at which they meet the
strongest. Whether it is believed is for `gsseg_core.learn.em.boundary_alignment` to say.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.kernels.compiler import kernel

FARTHEST = 8  # rows or columns

LOG_OFFSETS = 2 * np.log(2 * FARTHEST + 1)  # nats: log of how many offsets there are, all as likely


def likeliest_offset(
    pixels: np.ndarray,  # (P,) int64: along the boundaries, counted row by row
    weights: np.ndarray,  # (P,) float64: what edges of one unit are worth in each of them, in nats
    edges: np.ndarray,  # (H, W) float32: strength of the scene's edges
) -> tuple[int, int]:
    """Find by how many rows and columns to move a mask so that its boundaries meet the strongest edges."""
    width = edges.shape[1]
    strengths = _strengths(pixels // width, pixels % width, weights, edges)
    middle = strengths.size // 2
    # Where several are as good, the mask stays.
    best = middle if strengths.flat[middle] == strengths.max() else int(strengths.argmax())
    rows, columns = divmod(best, 2 * FARTHEST + 1)
    return rows - FARTHEST, columns - FARTHEST


def move_mask(labels: np.ndarray, offset: tuple[int, int]) -> np.ndarray:
    """Move a mask (H, W) by so many rows and columns; what it says nothing of then is unknown."""
    moved = np.full_like(labels, UNKNOWN)
    (to_y, from_y), (to_x, from_x) = map(_overlap, offset)
    moved[to_y, to_x] = labels[from_y, from_x]
    return moved


def _overlap(by: int) -> tuple[slice, slice]:
    """Where what is moved comes to lie, and where it comes from."""
    return (slice(by, None), slice(None, -by or None)) if by >= 0 else (slice(None, by), slice(-by, None))


@kernel(parallel=True)
def _strengths(rows: np.ndarray, columns: np.ndarray, weights: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Sum up weighed edges along boundaries moved by each offset, (2 FARTHEST + 1, 2 FARTHEST + 1) float64.

    What would leave the image is left out, and the rest weighs as much more.
    """
    height, width = edges.shape
    sums = np.zeros((2 * FARTHEST + 1, 2 * FARTHEST + 1))
    for j in nb.prange(2 * FARTHEST + 1):
        for i in range(2 * FARTHEST + 1):
            total, inside = 0.0, 0.0
            for p in range(rows.shape[0]):
                y, x = rows[p] + j - FARTHEST, columns[p] + i - FARTHEST
                if 0 <= y < height and 0 <= x < width:
                    total += weights[p] * edges[y, x]
                    inside += weights[p]
            sums[j, i] = total / inside if inside > 0 else 0.0
    return sums
