"""Gaussians moved as a whole: from the axes of one format to those of another, and by the nodes of a scene graph."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gsseg_core.scene import spherical_harmonics
from gsseg_core.scene.vertices import MEANS, QUATS, SCALES, columns, rest_names


def move(
    vertices: npt.NDArray[np.void],  # (N,) of `pack_vertices`
    turn: npt.NDArray[np.float64],  # (3, 3) orthogonal
    scale: float = 1.0,
    shift: npt.ArrayLike = (0.0, 0.0, 0.0),  # (3,)
) -> None:
    """Move Gaussians in place: x becomes scale * turn x + shift; covariances and SH turn along, mirrored or not.

    What `pack_vertices` returned is changed, positions to colours. Raises nothing: what is NaN stays NaN.
    """
    signs = np.diag(turn)
    mirrored = not (turn - np.diag(signs)).any()  # Axes that only change their sign need no product of matrices.
    with np.errstate(all="ignore"):
        means: npt.NDArray[np.floating] = columns(vertices, MEANS)
        quats: npt.NDArray[np.floating] = columns(vertices, QUATS)
        _put(vertices, MEANS, scale * (means * signs if mirrored else means @ turn.T) + np.asarray(shift))
        if scale != 1:
            _put(vertices, SCALES, columns(vertices, SCALES) + np.log(scale))
        if mirrored:
            quats = quats * np.array([1, signs[1] * signs[2], signs[0] * signs[2], signs[0] * signs[1]], np.float32)
        else:
            # A Gaussian is its own mirror image through its centre, so a mirror is half a turn of it.
            quats = _product(_quaternion(turn if np.linalg.det(turn) > 0 else -turn), quats)
        _put(vertices, QUATS, quats)
        names = rest_names(sum(name.startswith("f_rest_") for name in vertices.dtype.names or ()))
        if names:
            _turn_harmonics(columns(vertices, names).reshape(len(vertices), 3, -1), turn, mirrored)


def _put(vertices: npt.NDArray[np.void], names: tuple[str, ...], values: npt.NDArray[np.floating]) -> None:
    for name, column in zip(names, values.T, strict=True):
        vertices[name] = column


def _turn_harmonics(
    rest: npt.NDArray[np.float32],  # (N, 3, B)
    turn: npt.NDArray[np.float64],
    mirrored: bool,
) -> None:
    """Turn coefficients of SH above degree 0 in place, band by band."""
    matrix = spherical_harmonics.turned(turn, round(np.sqrt(rest.shape[2] + 1)) - 1)[1:, 1:]
    if mirrored:
        rest *= np.diag(matrix).astype(np.float32)
    else:
        rest[:] = rest @ matrix.T.astype(np.float32)


def _quaternion(turn: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:  # (3, 3)
    """Quaternion w, x, y, z of a rotation matrix."""
    from scipy.spatial.transform import Rotation  # It takes a while to load, and few formats need it.

    x, y, z, w = Rotation.from_matrix(turn).as_quat()
    return np.array([w, x, y, z])


def _product(
    first: npt.NDArray[np.float64],  # (4,) w, x, y, z
    second: npt.NDArray[np.floating],  # (N, 4)
) -> npt.NDArray[np.float64]:
    """Quaternions (N, 4) of rotations by `second`, then by `first`."""
    w, x, y, z = first
    matrix = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    product: npt.NDArray[np.float64] = second.astype(np.float64) @ matrix.T
    return product
