"""Block weights: which blocks of a mask, 4 x 4 pixels each, the steps of EM go through, and how much they count.

Where an object ends is told by the pixels near the boundaries of its regions. Far inside, neighbouring pixels say the
same of the same object, and most views that see a Gaussian at all see it there. So every block near a boundary is gone
through, and of the others few, in each view other ones. docs/memory.md has what that saves and costs.
"""

from __future__ import annotations

from zlib import crc32

import numpy as np
from scipy.ndimage import maximum_filter

from gsseg_core.raster.constants import BLOCK

NEAR = 1  # blocks around one with a boundary in it
STEP = 2  # in rows and columns, from one block to the next of those farther away
FAR = 4.0  # weight of these, each for the four that it stands for


def block_weights(labels: np.ndarray, name: str) -> np.ndarray:
    """Weigh the blocks of a view's mask; those of weight 0 are left out.

    Parameters
    ----------
    labels : (H, W) int32
        The mask.
    name : str
        Of the view, so that each has others: of what stands still before a robot, all is seen in time.

    Returns
    -------
    (ceil(H / 4), ceil(W / 4)) float32
    """
    changes = np.zeros(labels.shape, np.uint8)
    across, down = labels[:, 1:] != labels[:, :-1], labels[1:] != labels[:-1]
    changes[:, 1:] |= across
    changes[:, :-1] |= across
    changes[1:] |= down
    changes[:-1] |= down
    height, width = (-(-size // BLOCK) for size in labels.shape)
    padded = np.pad(changes, ((0, height * BLOCK - labels.shape[0]), (0, width * BLOCK - labels.shape[1])))
    blocks = padded.reshape(height, BLOCK, width, BLOCK).max(axis=(1, 3))
    near = maximum_filter(blocks, 2 * NEAR + 1) > 0
    first, some = crc32(name.encode()) % STEP**2, np.zeros((height, width), np.float32)
    some[first // STEP :: STEP, first % STEP :: STEP] = FAR
    return np.where(near, np.float32(1), some)
