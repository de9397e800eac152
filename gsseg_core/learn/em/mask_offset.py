"""Mask offset: how far a whole mask is shifted in its image, because its pose is wrong or it is of another moment.

If a camera is rotated by half a degree, its mask is a few px away from the rendered scene. Moving the mask back makes
all of its boundaries meet edges of the scene. So the search returns the offset at which the boundaries meet the
strongest edges. `gsseg_core.learn.em.boundary_alignment` decides whether to apply it.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.kernels.compiler import kernel

FARTHEST = 8  # rows or columns

LOG_OFFSETS = 2 * np.log(2 * FARTHEST + 1)  # nats: log of the number of offsets, which are equally likely


def likeliest_offset(
    pixels: np.ndarray,  # (P,) int64: pixels along the boundaries, as flat indices (row-major)
    weights: np.ndarray,  # (P,) float64: log-likelihood of an edge of strength 1 at each of these pixels, in nats
    edges: np.ndarray,  # (H, W) float32: strength of the scene's edges
) -> tuple[int, int]:
    """Find the offset, in rows and columns, that moves the boundaries of a mask to the strongest edges."""
    width = edges.shape[1]
    strengths = _strengths(pixels // width, pixels % width, weights, edges)
    middle = strengths.size // 2
    # The mask stays if no offset is better.
    best = middle if strengths.flat[middle] == strengths.max() else int(strengths.argmax())
    rows, columns = divmod(best, 2 * FARTHEST + 1)
    return rows - FARTHEST, columns - FARTHEST


def move_mask(labels: np.ndarray, offset: tuple[int, int]) -> np.ndarray:
    """Move a mask (H, W) by an offset in rows and columns; pixels that it no longer covers become `UNKNOWN`."""
    moved = np.full_like(labels, UNKNOWN)
    (to_y, from_y), (to_x, from_x) = map(_overlap, offset)
    moved[to_y, to_x] = labels[from_y, from_x]
    return moved


def _overlap(by: int) -> tuple[slice, slice]:
    """Return the target and source slices along one axis for a move by `by` pixels."""
    return (slice(by, None), slice(None, -by or None)) if by >= 0 else (slice(None, by), slice(-by, None))


@kernel(parallel=True)
def _strengths(rows: np.ndarray, columns: np.ndarray, weights: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Average the edges along the boundaries, weighted, for each offset: (2 FARTHEST + 1, 2 FARTHEST + 1) float64.

    Pixels that an offset moves out of the image are left out of its average.
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
