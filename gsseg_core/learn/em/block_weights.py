"""Block weights: which blocks of a mask, 4 x 4 pixels each, the steps of EM go through, and how much they count.

Where an object ends is told by the pixels near the boundaries of its regions. Far inside, neighbouring pixels say the
same of the same object, and most views that see a Gaussian at all see it there. So every block near a boundary is gone
through, and of the others few, in most views other ones. docs/memory.md has what that saves and costs.
"""

from __future__ import annotations

from zlib import crc32

import numpy as np

from gsseg_core.kernels.compiler import kernel
from gsseg_core.raster.constants import BLOCK

NEAR = 1  # blocks around one with a boundary in it
STEP = 2  # in rows and columns, from one block to the next of those farther away
FAR = 4.0  # weight of these, each for the four that it stands for


def block_weights(
    labels: np.ndarray,  # (H, W) int32: the mask as it is learnt from, its boundaries aligned
    mask: np.ndarray,  # (H, W) int32: the mask as it came
) -> np.ndarray:
    """Weigh the blocks of a view's mask, (ceil(H / 4), ceil(W / 4)) float32; those of weight 0 are left out.

    Which of those far from boundaries are gone through follows from where the mask had its boundaries, not from names
    of views or classes: the same masks teach the same, whoever sends them.
    """
    near = near_boundaries(labels, NEAR)
    first, some = crc32(near_boundaries(mask, 0).tobytes()) % STEP**2, np.zeros(near.shape, np.float32)
    some[first // STEP :: STEP, first % STEP :: STEP] = FAR
    return np.where(near, np.float32(1), some)


@kernel
def near_boundaries(labels: np.ndarray, distance: int) -> np.ndarray:
    """Mark blocks with a boundary of a mask (H, W), and so many around them: (ceil(H / 4), ceil(W / 4)) bool.

    A boundary is met by pixels whose label is not that of a pixel beside, above or below them.
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
