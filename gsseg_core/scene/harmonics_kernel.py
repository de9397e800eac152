"""Kernels of spherical harmonics, in a module of their own, so that reading a scene does not load numba."""

from __future__ import annotations

from math import pi, sqrt

import numba as nb
import numpy as np

from gsseg_core.kernels.compiler import called_by_kernels, kernel
from gsseg_core.simd import AHEAD, prefetch

_C0, _C1, _C2 = np.float32(sqrt(1 / (4 * pi))), np.float32(sqrt(3 / (4 * pi))), np.float32(sqrt(15 / (4 * pi)))
_C2_MIDDLE, _C2_HALF = np.float32(sqrt(5 / (16 * pi))), np.float32(sqrt(15 / (16 * pi)))
_C3_SIDE, _C3_INNER = np.float32(sqrt(35 / (32 * pi))), np.float32(sqrt(21 / (32 * pi)))
_C3_MIDDLE = np.float32(sqrt(7 / (16 * pi)))
_C3_ALL, _C3_HALF = np.float32(sqrt(105 / (4 * pi))), np.float32(sqrt(105 / (16 * pi)))
_TWO, _THREE, _FOUR = np.float32(2), np.float32(3), np.float32(4)
_LEAST = np.finfo(np.float32).tiny  # of a length
_CHUNKS = 64


@called_by_kernels
def _evaluate(x: np.float32, y: np.float32, z: np.float32, degree: int, out: np.ndarray) -> None:
    """Evaluate all harmonics up to a degree for a unit vector, into (B,) float32."""
    out[0] = _C0
    if degree >= 1:
        out[1], out[2], out[3] = -_C1 * y, _C1 * z, -_C1 * x
    xx, yy, zz = x * x, y * y, z * z
    if degree >= 2:
        out[4], out[5], out[7] = _C2 * x * y, -_C2 * y * z, -_C2 * x * z
        out[6], out[8] = _C2_MIDDLE * (_TWO * zz - xx - yy), _C2_HALF * (xx - yy)
    if degree >= 3:
        out[9], out[15] = -_C3_SIDE * y * (_THREE * xx - yy), -_C3_SIDE * x * (xx - _THREE * yy)
        out[10], out[14] = _C3_ALL * x * y * z, _C3_HALF * z * (xx - yy)
        out[11], out[13] = -_C3_INNER * y * (_FOUR * zz - xx - yy), -_C3_INNER * x * (_FOUR * zz - xx - yy)
        out[12] = _C3_MIDDLE * z * (_TWO * zz - _THREE * xx - _THREE * yy)


@kernel(parallel=True)
def evaluate(directions: np.ndarray, degree: int) -> np.ndarray:  # (N, 3) float32
    """Evaluate all harmonics up to a degree for unit vectors: (N, B) float32, band after band."""
    out = np.empty((directions.shape[0], (degree + 1) ** 2), np.float32)
    for i in nb.prange(directions.shape[0]):
        _evaluate(directions[i, 0], directions[i, 1], directions[i, 2], degree, out[i])
    return out


@kernel(parallel=True)
def seen_colors(
    coefficients: np.ndarray, means: np.ndarray,  # (N, 3 B) as in a PLY; (N, 3)
    ids: np.ndarray, center: np.ndarray, degree: int,  # (M,) int32; (3,) float32; up to which harmonics count
) -> np.ndarray:  # fmt: skip
    """Colours of some Gaussians seen from a point, (M, 3) float32 in [0, 1]: 0.5 and what their harmonics add up to."""
    bands, others, count = (degree + 1) ** 2, (coefficients.shape[1] - 3) // 3, ids.shape[0]
    out = np.empty((count, 3), np.float32)
    second, third = coefficients[:, 16:], coefficients[:, 32:]
    for chunk in nb.prange(_CHUNKS):
        harmonics = np.empty(bands, np.float32)
        for m in range(chunk * count // _CHUNKS, (chunk + 1) * count // _CHUNKS):
            # A row of coefficients is up to four cache lines, anywhere in memory: it is asked for before it is needed.
            i, later = ids[m], ids[min(m + AHEAD, count - 1)]
            prefetch(means, later)
            prefetch(coefficients, later)
            prefetch(second, later)
            prefetch(third, later)
            x, y, z = means[i, 0] - center[0], means[i, 1] - center[1], means[i, 2] - center[2]
            inverse = np.float32(1) / max(np.sqrt(x * x + y * y + z * z), _LEAST)
            _evaluate(x * inverse, y * inverse, z * inverse, degree, harmonics)
            red, green, blue = (
                harmonics[0] * coefficients[i, 0], harmonics[0] * coefficients[i, 1], harmonics[0] * coefficients[i, 2]
            )  # fmt: skip
            for b in range(1, bands):
                red += harmonics[b] * coefficients[i, 2 + b]
                green += harmonics[b] * coefficients[i, 2 + others + b]
                blue += harmonics[b] * coefficients[i, 2 + 2 * others + b]
            for c, total in enumerate((red, green, blue)):
                out[m, c] = min(max(total + np.float32(0.5), np.float32(0)), np.float32(1))
    return out
