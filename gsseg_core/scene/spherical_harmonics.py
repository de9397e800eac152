"""View-dependent colours: real spherical harmonics up to degree 3, in the order and with the signs of 3DGS.

Band l holds the orders m = -l..l. Each function is the orthonormal real harmonic with the Condon-Shortley phase
(-1)^m, written out as a polynomial in the unit direction (x, y, z).
"""

from __future__ import annotations

from math import pi, sqrt

import numpy as np
import numpy.typing as npt

from gsseg_core.errors import SceneValueError

MAX_DEGREE = 3
C0 = sqrt(1 / (4 * pi))
_C1 = sqrt(3 / (4 * pi))
_C2 = sqrt(15 / (4 * pi))


def basis(directions: npt.NDArray[np.floating], degree: int) -> npt.NDArray[np.float32]:  # (N, 3)
    """Evaluate all harmonics up to `degree`, 0 to 3, for unit vectors: (N, (degree + 1)^2) float32, band after band.

    Raises
    ------
    SceneValueError
        There are no such harmonics.
    """
    if not 0 <= degree <= MAX_DEGREE:
        raise SceneValueError(f"spherical harmonics: degree is {degree}; expected 0 to {MAX_DEGREE}")
    x, y, z = np.asarray(directions, np.float32).T
    columns = [np.full_like(x, C0)]
    if degree >= 1:
        columns += [-_C1 * y, _C1 * z, -_C1 * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        middle = sqrt(5 / (16 * pi)) * (2 * zz - xx - yy)
        columns += [_C2 * x * y, -_C2 * y * z, middle, -_C2 * x * z, _C2 / 2 * (xx - yy)]
    if degree >= 3:
        a, b, c = sqrt(35 / (32 * pi)), sqrt(105 / (4 * pi)), sqrt(21 / (32 * pi))
        columns += [
            -a * y * (3 * xx - yy),
            b * x * y * z,
            -c * y * (4 * zz - xx - yy),
            sqrt(7 / (16 * pi)) * z * (2 * zz - 3 * xx - 3 * yy),
            -c * x * (4 * zz - xx - yy),
            b / 2 * z * (xx - yy),
            -a * x * (xx - 3 * yy),
        ]
    return np.stack(columns, axis=1)


def to_rgb(
    sh: npt.NDArray[np.float32],  # (N, (d + 1)^2, 3)
    directions: npt.NDArray[np.floating],  # (N, 3)
) -> npt.NDArray[np.float32]:
    """Colours (N, 3) seen along `directions`, as 3DGS defines them: 0.5 + sum, RGB float32 clipped to [0, 1].

    The directions are unit vectors from the camera to each Gaussian; coefficients go band after band, RGB last.
    """
    degree = round(sqrt(sh.shape[1])) - 1
    rgb: npt.NDArray[np.float32] = np.matmul(basis(directions, degree)[:, None, :], sh)[:, 0]
    return (rgb + np.float32(0.5)).clip(0, 1)


def turned(turn: npt.NDArray[np.float64], degree: int) -> npt.NDArray[np.float64]:  # (3, 3) orthogonal
    """Matrix that turns coefficients along with a scene, (B, B) with B = (degree + 1)^2, block by block of a band.

    The colour that was seen along a direction is seen along the turned one afterwards. Raises `SceneValueError` as
    `basis` does.
    """
    directions = np.random.default_rng(0).normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    # A function of the turned scene along d is that of the scene before along turn^T d.
    now, before = (basis(along, degree).astype(np.float64) for along in (directions, directions @ turn))
    matrix = np.linalg.lstsq(now, before, rcond=None)[0]
    whole = matrix.round()
    return np.where(np.abs(matrix - whole) < 1e-5, whole, matrix)
