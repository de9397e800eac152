"""Gaussians seen by one camera: where each lies on the image, how far it reaches, and in which order they are blended.

The projection is the EWA approximation (Zwicker et al. 2001, "EWA volume splatting", eq. 26-31) as 3D Gaussian
Splatting uses it: the camera is linearised at the centre of each Gaussian and 0.3 px^2 is added to the diagonal of the
2D covariance S. The quadratic form d^T S^-1 d is kept as a sum of two squares,

    d^T S^-1 d = (dx - shear dy)^2 / var_x_given_y + dy^2 / S_yy,      shear = S_xy / S_yy,

so that nothing cancels for thin Gaussians, and the columns that a Gaussian reaches in one row follow from one square
root.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba as nb
import numpy as np

from gsseg_core.cameras import Camera
from gsseg_core.scene import GaussianScene

NEAR = 0.01
"""Centres nearer than this to the camera plane are not drawn, in scene units."""

DILATION = 0.3
"""Added to both variances on the image, in px^2 (the low-pass filter of 3DGS trainers)."""

ALPHA_MIN = 1.0 / 255.0
"""Opacities below this count as zero."""

FRUSTUM_MARGIN = 0.3
"""The linearisation point is kept within the image widened by this fraction of half its width, as trainers do."""

REACH_MAX = 1e6
"""A reach is cut off here, in px: far beyond any image, and safely an integer."""

# Columns of the table of projected Gaussians.
U, V, SHEAR, WIDTH, HEIGHT, LOG_OPACITY, X_REACH, Y_REACH, X_TURN = range(9)

HALF_LOG2E = 0.5 / np.log(2.0)


@dataclass(frozen=True)
class Projected:
    """The Gaussians that reach the image, nearest first.

    Attributes
    ----------
    ids : (M,) int32
        Index of each in the scene.
    table : (M, 9) float32
        Per Gaussian: centre u, v in px; shear; WIDTH = log2(e) / (2 var(x|y)) and HEIGHT = log2(e) / (2 S_yy), so that
        log2(alpha) = LOG_OPACITY - WIDTH (dx - shear dy)^2 - HEIGHT dy^2; reach in x and y in px, where alpha falls to
        1/255; and dy at the rightmost point of that ellipse.
    """

    ids: np.ndarray
    table: np.ndarray


def project(scene: GaussianScene, camera: Camera) -> Projected:
    """Project a scene and sort what is visible by depth.

    Gaussians at exactly the same depth are ordered by their projected shape, so the order in the scene matters only to
    those that are alike in all of it.
    """
    table = np.empty((len(scene), 9), np.float32)
    depth = np.empty(len(scene), np.float32)
    _project(
        scene.means, scene.quats, scene.scales, scene.opacities, camera.world_to_camera, camera.K,
        float(camera.width), float(camera.height), table, depth,
    )  # fmt: skip
    visible = np.flatnonzero(depth > 0)
    order = np.argsort(depth[visible], kind="stable")
    ids = _break_ties(visible[order], depth, table)
    return Projected(ids.astype(np.int32), table[ids])


def _break_ties(
    ids: np.ndarray,  # (M,) sorted by depth
    depth: np.ndarray,  # (N,)
    table: np.ndarray,  # (N, 9)
) -> np.ndarray:
    equal = np.flatnonzero(np.diff(depth[ids]) == 0)
    if len(equal) == 0:
        return ids
    tied = np.union1d(equal, equal + 1)
    group = ids[tied]
    keys = (*table[group].T[::-1], depth[group])
    ids[tied] = group[np.lexsort(keys)]
    return ids


@nb.njit(parallel=True, nogil=True, cache=True, error_model="numpy")
def _project(
    means: np.ndarray,  # (N, 3)
    quats: np.ndarray,  # (N, 4) w, x, y, z
    scales: np.ndarray,  # (N, 3)
    opacities: np.ndarray,  # (N,)
    viewmat: np.ndarray,  # (4, 4)
    K: np.ndarray,  # (3, 3)
    width: float,
    height: float,
    table: np.ndarray,  # (N, 9) out
    depth: np.ndarray,  # (N,) out, 0 where not visible
) -> None:
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    margin_x, margin_y = FRUSTUM_MARGIN * 0.5 * width / fx, FRUSTUM_MARGIN * 0.5 * height / fy
    x_low, x_high = -cx / fx - margin_x, (width - cx) / fx + margin_x
    y_low, y_high = -cy / fy - margin_y, (height - cy) / fy + margin_y
    for i in nb.prange(means.shape[0]):
        depth[i] = 0.0
        opacity = np.float64(opacities[i])
        mx, my, mz = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
        z = viewmat[2, 0] * mx + viewmat[2, 1] * my + viewmat[2, 2] * mz + viewmat[2, 3]
        if z < NEAR or opacity < ALPHA_MIN:
            continue
        x = (viewmat[0, 0] * mx + viewmat[0, 1] * my + viewmat[0, 2] * mz + viewmat[0, 3]) / z
        y = (viewmat[1, 0] * mx + viewmat[1, 1] * my + viewmat[1, 2] * mz + viewmat[1, 3]) / z
        u, v = fx * x + cx, fy * y + cy

        # A bound of the reach by the longest axis throws out most of what is off the image before the costly part.
        xc, yc = min(max(x, x_low), x_high), min(max(y, y_low), y_high)
        cut = 2.0 * np.log(opacity * 255.0)
        longest = np.float64(max(scales[i, 0], max(scales[i, 1], scales[i, 2]))) / z
        bound_x = np.sqrt(cut * (longest * longest * fx * fx * (1.0 + xc * xc) + DILATION))
        bound_y = np.sqrt(cut * (longest * longest * fy * fy * (1.0 + yc * yc) + DILATION))
        if u + bound_x < 0.0 or u - bound_x > width or v + bound_y < 0.0 or v - bound_y > height:
            continue

        # Rows of J R_view, with J the Jacobian of the pinhole projection.
        ax = (fx / z) * (viewmat[0, 0] - xc * viewmat[2, 0])
        ay = (fx / z) * (viewmat[0, 1] - xc * viewmat[2, 1])
        az = (fx / z) * (viewmat[0, 2] - xc * viewmat[2, 2])
        bx = (fy / z) * (viewmat[1, 0] - yc * viewmat[2, 0])
        by = (fy / z) * (viewmat[1, 1] - yc * viewmat[2, 1])
        bz = (fy / z) * (viewmat[1, 2] - yc * viewmat[2, 2])
        qw, qx, qy, qz = (
            np.float64(quats[i, 0]), np.float64(quats[i, 1]), np.float64(quats[i, 2]), np.float64(quats[i, 3]),
        )  # fmt: skip
        s0, s1, s2 = np.float64(scales[i, 0]), np.float64(scales[i, 1]), np.float64(scales[i, 2])
        r00, r01, r02 = 1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy - qw * qz), 2 * (qx * qz + qw * qy)
        r10, r11, r12 = 2 * (qx * qy + qw * qz), 1 - 2 * (qx * qx + qz * qz), 2 * (qy * qz - qw * qx)
        r20, r21, r22 = 2 * (qx * qz - qw * qy), 2 * (qy * qz + qw * qx), 1 - 2 * (qx * qx + qy * qy)
        a0, a1, a2 = (
            s0 * (ax * r00 + ay * r10 + az * r20),
            s1 * (ax * r01 + ay * r11 + az * r21),
            s2 * (ax * r02 + ay * r12 + az * r22),
        )
        b0, b1, b2 = (
            s0 * (bx * r00 + by * r10 + bz * r20),
            s1 * (bx * r01 + by * r11 + bz * r21),
            s2 * (bx * r02 + by * r12 + bz * r22),
        )
        sxx = a0 * a0 + a1 * a1 + a2 * a2 + DILATION
        sxy = a0 * b0 + a1 * b1 + a2 * b2
        syy = b0 * b0 + b1 * b1 + b2 * b2 + DILATION
        reach_x, reach_y = min(np.sqrt(cut * sxx), REACH_MAX), min(np.sqrt(cut * syy), REACH_MAX)
        if not (
            u + reach_x >= 0.5 and u - reach_x <= width - 0.5 and v + reach_y >= 0.5 and v - reach_y <= height - 0.5
        ):
            continue
        table[i, U] = u
        table[i, V] = v
        table[i, SHEAR] = sxy / syy
        # var(x|y) = S_xx - S_xy^2 / S_yy is at least the dilation; rounding must not bring it below.
        table[i, WIDTH] = HALF_LOG2E / max(sxx - sxy * sxy / syy, DILATION)
        table[i, HEIGHT] = HALF_LOG2E / syy
        table[i, LOG_OPACITY] = np.log2(opacity)
        table[i, X_REACH] = reach_x
        table[i, Y_REACH] = reach_y
        table[i, X_TURN] = min(max(sxy * np.sqrt(cut / sxx), -REACH_MAX), REACH_MAX)
        depth[i] = z
