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


def basis(directions: npt.NDArray[np.floating], degree: int) -> npt.NDArray[np.float32]:  # (N, 3)
    """Evaluate all harmonics up to `degree`, 0 to 3, for unit vectors: (N, (degree + 1)^2) float32, band after band.

    Raises `SceneValueError` for another degree.
    """
    if not 0 <= degree <= MAX_DEGREE:
        raise SceneValueError(f"spherical harmonics: degree is {degree}; expected 0 to {MAX_DEGREE}")
    from gsseg_core.scene.harmonics_kernel import evaluate  # It loads numba, which reading scenes does without.

    return np.asarray(evaluate(np.ascontiguousarray(directions, np.float32), degree))


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
