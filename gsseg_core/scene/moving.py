"""Gaussians moved as a whole: from the axes of one format to those of another, and by the nodes of a scene graph."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from gsseg_core.scene import spherical_harmonics
from gsseg_core.scene.quaternions import turned_quats
from gsseg_core.scene.vertices import MEANS, QUATS, REST_COUNTS, SCALES, columns, put, rest_of


def move(
    vertices: npt.NDArray[np.void],  # (N,) of `pack_vertices`
    turn: npt.NDArray[np.float64],  # (3, 3) orthogonal
    scale: float = 1.0,
    shift: npt.ArrayLike = (0.0, 0.0, 0.0),  # (3,)
) -> None:
    """Move Gaussians in place: x becomes scale * turn x + shift; covariances and SH turn along, mirrored or not.

    What `pack_vertices` returned is changed, positions to colours. Raises nothing: what is NaN stays NaN.
    """
    names = rest_of(vertices)
    harmonics = _turned(turn.tobytes(), REST_COUNTS.index(len(names)))
    with np.errstate(all="ignore"):
        put(vertices, MEANS, scale * (columns(vertices, MEANS) @ turn.T) + np.asarray(shift))
        if scale != 1:
            put(vertices, SCALES, columns(vertices, SCALES) + np.log(scale))
        if not (turn - np.diag(np.diag(turn))).any():  # Axes that only change their sign need no product of matrices.
            _change_signs(vertices, np.diag(turn), names, np.diag(harmonics))
            return
        # A Gaussian is its own mirror image through its centre, so a mirror is half a turn of it.
        put(vertices, QUATS, turned_quats(columns(vertices, QUATS), turn if np.linalg.det(turn) > 0 else -turn))
        if names:
            rest = columns(vertices, names).reshape(len(vertices), 3, -1)
            rest[:] = rest @ harmonics.T.astype(np.float32)


@lru_cache(maxsize=4)
def _turned(turn: bytes, degree: int) -> npt.NDArray[np.float64]:
    """Matrix (B, B) that turns coefficients above degree 0; kept, as files are moved block by block."""
    return spherical_harmonics.turned(np.frombuffer(turn).reshape(3, 3), degree)[1:, 1:]


def _change_signs(
    vertices: npt.NDArray[np.void],  # (N,)
    axes: npt.NDArray[np.float64],  # (3,) 1 or -1
    names: tuple[str, ...],  # of 3 B coefficients of SH
    harmonics: npt.NDArray[np.float64],  # (B,) 1 or -1
) -> None:
    """Change signs of rotations and SH in place, as axes that change theirs do: all properties in one product."""
    order = list(vertices.dtype.names or ())
    signs = np.ones(len(order), np.float32)
    signs[[order.index(name) for name in QUATS[1:]]] = axes[[1, 0, 0]] * axes[[2, 2, 1]]
    signs[[order.index(name) for name in names]] = np.tile(harmonics, 3)
    table = vertices.view(np.float32).reshape(len(vertices), -1)
    table *= signs
