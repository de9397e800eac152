"""Rotation matrices of unit quaternions."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

Number = TypeVar("Number", bound=np.floating[Any])


def rotations(
    quats: npt.NDArray[Number],  # (M, 4) w, x, y, z, unit
) -> npt.NDArray[Number]:
    """Rotation matrices (M, 3, 3) of quaternions, of the same precision; columns are the local axes in the world."""
    w, x, y, z = quats.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrices: npt.NDArray[Number] = np.moveaxis(np.array(rows), 2, 0)
    return matrices
