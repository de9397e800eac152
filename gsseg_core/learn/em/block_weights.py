"""Block weights: which blocks of 4 x 4 mask pixels EM uses in its steps, and with what weight.

Pixels near region boundaries determine where an object ends. Far inside a region, neighbouring pixels carry the same
information, and most views of a Gaussian see it there. EM therefore uses every block near a boundary and a sample of
the others, which differs between most views. docs/memory.md has the savings and the costs.
"""

from __future__ import annotations

from zlib import crc32

import numpy as np

from gsseg_core.kernels.compiler import kernel
from gsseg_core.raster.constants import BLOCK

NEAR = 1  # blocks around one with a boundary in it
STEP = 2  # in rows and columns, from one sampled block to the next far from boundaries
FAR = 4.0  # weight of a sampled block, which represents four


def block_weights(
    labels: np.ndarray,  # (H, W) int32: the mask to learn from, with aligned boundaries
    mask: np.ndarray,  # (H, W) int32: the original mask
) -> np.ndarray:
    """Return the weight of each block of a view's mask, (ceil(H / 4), ceil(W / 4)) float32; EM skips weight 0.

    The boundaries of the original mask select the sample far from boundaries. Names of views or classes have no
    influence, so the same masks always give the same result.
    """
    near = near_boundaries(labels, NEAR)
    first, some = crc32(near_boundaries(mask, 0).tobytes()) % STEP**2, np.zeros(near.shape, np.float32)
    some[first // STEP :: STEP, first % STEP :: STEP] = FAR
    return np.where(near, np.float32(1), some)


@kernel
def near_boundaries(labels: np.ndarray, distance: int) -> np.ndarray:
    """Mark blocks within `distance` blocks of a boundary of a mask (H, W): (ceil(H / 4), ceil(W / 4)) bool.

    A pixel is at a boundary if a horizontal or vertical neighbour has another label.
    """
    height, width = labels.shape
    blocks = np.zeros((-(-height // BLOCK), -(-width // BLOCK)), np.bool_)
    for y in range(height):
        for x in range(width):
            here, right, below = labels[y, x], min(x + 1, width - 1), min(y + 1, height - 1)
            if here != labels[y, right]:
                blocks[y // BLOCK, x // BLOCK] = blocks[y // BLOCK, right // BLOCK] = True
            if here != labels[below, x]:
                blocks[y // BLOCK, x // BLOCK] = blocks[below // BLOCK, x // BLOCK] = True
    near = np.zeros_like(blocks)
    for row in range(blocks.shape[0]):
        for column in range(blocks.shape[1]):
            if blocks[row, column]:
                top, left = max(row - distance, 0), max(column - distance, 0)
                near[top : row + distance + 1, left : column + distance + 1] = True
    return near
