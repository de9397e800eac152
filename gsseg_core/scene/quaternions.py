"""Unit quaternions: rotation matrices of them, products, and those of which a file keeps the three smallest parts."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

Number = TypeVar("Number", bound=np.floating[Any])


def rotations(quats: npt.NDArray[Number]) -> npt.NDArray[Number]:  # (M, 4) w, x, y, z, unit
    """Rotation matrices (M, 3, 3) of quaternions, of the same precision; columns are the local axes in the world."""
    w, x, y, z = quats.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def turned_quats(
    quats: npt.NDArray[np.floating],  # (N, 4) w, x, y, z
    turn: npt.NDArray[np.float64],  # (3, 3)
) -> npt.NDArray[np.float64]:
    """Quaternions (N, 4) of rotations by `quats`, then by a matrix; each is the same whichever others are turned."""
    from scipy.spatial.transform import Rotation  # It takes a while to load, and few scenes are turned.

    b, c, d, a = Rotation.from_matrix(turn).as_quat()
    w, x, y, z = quats.astype(np.float64).T
    product = [
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    ]
    return np.stack(product, axis=1)


def half_axes(
    quats: npt.NDArray[Number],  # (M, 4) w, x, y, z, unit
    scales: npt.NDArray[Any],  # (M, 3)
) -> npt.NDArray[Number]:
    """Half axes (M, 3, 3) of ellipsoids, one in each column, of the higher precision of the two."""
    return rotations(quats) * scales[:, None, :]


def covariances(quats: npt.NDArray[Number], scales: npt.NDArray[Any]) -> npt.NDArray[Number]:
    """Covariances (M, 3, 3) of Gaussians, R diag(scales^2) R^T, of what `half_axes` takes."""
    half = half_axes(quats, scales)
    return half @ half.transpose(0, 2, 1)


def from_smallest_three(
    largest: npt.NDArray[np.integer],  # (M,) 0 to 3
    others: npt.NDArray[np.floating],  # (M, 3)
) -> npt.NDArray[np.float32]:
    """Restore unit quaternions (M, 4) from which component is largest, and the others in their order."""
    rest = np.sqrt(np.maximum(0, 1 - np.square(others).sum(axis=1)))
    quats = np.empty((len(others), 4), np.float32)
    for k in range(4):
        before = others[:, min(k, 2)]  # where the largest comes later
        after = others[:, max(k - 1, 0)]
        quats[:, k] = np.where(largest == k, rest, np.where(largest > k, before, after))
    return quats
