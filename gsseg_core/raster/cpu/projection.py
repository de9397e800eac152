"""Gaussians seen by one camera: where each lies on the image, how far it reaches, and in which order they are blended.

The projection is the EWA approximation (Zwicker et al. 2001, "EWA volume splatting", eq. 26-31) as 3D Gaussian
Splatting uses it: the camera is linearised at the centre of each Gaussian and 0.3 px^2 is added to the diagonal of the
2D covariance S. The quadratic form d^T S^-1 d is kept as a sum of two squares,

    d^T S^-1 d = (dx - shear dy)^2 / var_x_given_y + dy^2 / S_yy,      shear = S_xy / S_yy,

so that nothing cancels for thin Gaussians, and the columns that a Gaussian reaches in one row follow from one square
root.
"""

from __future__ import annotations

import threading
from functools import partial
from typing import NamedTuple

import numba as nb
import numpy as np

from gsseg_core.kernels.compiler import called_by_kernels, kernel
from gsseg_core.raster.constants import CHUNKS, DILATION, NEAR
from gsseg_core.raster.cpu.depth_sort import sort_keys
from gsseg_core.raster.cpu.splat import HEIGHT, LOG_ALPHA_MIN, LOG_OPACITY, SHEAR, WIDTH, X_TURN, Y_REACH, U, V
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.scene_cache import PerScene

FRUSTUM_MARGIN = 0.3  # of half the image's size, within which around the image the camera is linearised, as in trainers
REACH_MAX = 1e6  # a reach is cut off here, in px: far beyond any image, and safely an integer
LARGEST_REACH = np.sqrt(2.0 * np.log(255.0))  # standard deviations at which a Gaussian of opacity 1 falls to 1/255
HALF_LOG2E = 0.5 / np.log(2.0)
ROOT = np.sqrt(DILATION)

BATCH = 128  # Gaussians that are looked at together before those among them that may be visible are projected
LOW, HIGH, LONGEST = 0, 3, 6  # Where the bounds of a batch lie: of its means, (3,) each, and its longest axis.

# Where numbers of the Gaussians of a batch lie: so many times BATCH.
MEAN, QUAT, SCALES, OPACITY, OUT, DEPTH = 0, 3, 7, 10, 11, 19
NUMBERS = 20


class Projected(NamedTuple):
    """The Gaussians that reach the image, in the order of the scene: where it follows space, neighbours lie together.

    The table has of each: centre u, v in px; shear; WIDTH = log2(e) / (2 var(x|y)) and HEIGHT = log2(e) / (2 S_yy), so
    that log2(alpha) = LOG_OPACITY - WIDTH (dx - shear dy)^2 - HEIGHT dy^2; reach in y in px, where alpha falls to
    1/255; and dy at the rightmost point of that ellipse.
    """

    ids: np.ndarray  # (M,) int32: index of each in the scene, ascending
    table: np.ndarray  # (M, 8) float32
    order: np.ndarray  # (M,) int32: rows of the table, nearest first


def footprints(table: np.ndarray) -> np.ndarray:  # (M, 8) as that of `Projected`
    """Sum of each Gaussian's alphas over an endless image, opacity * 2 pi sqrt(|S|): (M,), in px."""
    # |S| = var(x|y) S_yy, and the table has log2(e) / 2 over each of them.
    area = np.pi / np.log(2.0) / np.sqrt(table[:, WIDTH] * table[:, HEIGHT])
    return np.asarray(np.exp2(table[:, LOG_OPACITY]) * area)


class Pinhole(NamedTuple):
    """A camera as kernels take it."""

    viewmat: np.ndarray  # (4, 4) world to camera
    fx: float  # px, as all that follow but the bounds
    fy: float
    cx: float
    cy: float
    width: float
    height: float
    x_low: float  # between these x / z and these y / z the camera is linearised
    x_high: float
    y_low: float
    y_high: float

    @classmethod
    def of(cls, camera: Camera) -> Pinhole:
        """Take what is needed of a camera; a matrix that lies by columns would have every kernel compiled for it."""
        width, height = float(camera.width), float(camera.height)
        fx, fy, cx, cy = camera.K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
        across, down = FRUSTUM_MARGIN * 0.5 * width / fx, FRUSTUM_MARGIN * 0.5 * height / fy
        return cls(
            np.ascontiguousarray(camera.world_to_camera), fx, fy, cx, cy, width, height,
            -cx / fx - across, (width - cx) / fx + across, -cy / fy - down, (height - cy) / fy + down,
        )  # fmt: skip


class _Splats(NamedTuple):
    """Gaussians as kernels take them."""

    means: np.ndarray  # (N, 3)
    quats: np.ndarray  # (N, 4) w, x, y, z
    scales: np.ndarray  # (N, 3)
    log_opacities: np.ndarray  # (N,)


Side = tuple[float, float, float, float, float]
"""A plane in the world, a x + b y + c z + d, and how much farther in a Gaussian reaches for each unit of its length."""

_CONTRACTED = {"contract", "nnan", "ninf", "nsz"}
_BOUNDS: PerScene[np.ndarray] = PerScene()


def project(scene: GaussianScene, camera: Camera) -> Projected:
    """Project a scene and sort what is visible by depth.

    Gaussians at exactly the same depth are ordered by their projected shape, so the order in the scene matters only to
    those that are alike in all of it.
    """
    table, depth, ids = _scratch(len(scene))
    splats = _Splats(scene.means, scene.quats, scene.scales, scene.log_opacities)
    bounds = _BOUNDS.of(scene, partial(_bounds_of_batches, scene.means, scene.scales))
    found = _project(splats, bounds, Pinhole.of(camera), table, depth, ids)
    begins = np.arange(CHUNKS) * len(bounds) // CHUNKS * BATCH
    table, depth, ids = (joined(part, begins, found) for part in (table, depth, ids))
    order, keys = sort_keys(depth.view(np.uint32))  # Floats above 0 sort as their bits do.
    _break_ties(order, np.flatnonzero(keys[1:] == keys[:-1]), table)
    return Projected(ids, table, order)


def joined(values: np.ndarray, begins: np.ndarray, counts: np.ndarray) -> np.ndarray:  # (CHUNKS,), (CHUNKS,)
    """Put together what each chunk has written to its own part of the values."""
    return np.concatenate([values[begin : begin + count] for begin, count in zip(begins, counts, strict=True)])


_KEPT = threading.local()


def _scratch(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Scratch of this thread for so many Gaussians: to touch fresh memory takes longer than to project."""
    kept: tuple[np.ndarray, np.ndarray, np.ndarray] | None = getattr(_KEPT, "scratch", None)
    if kept is None or len(kept[0]) != count:
        kept = np.empty((count, 8), np.float32), np.empty(count, np.float32), np.empty(count, np.int32)
        _KEPT.scratch = kept
    return kept


@kernel
def _break_ties(
    order: np.ndarray,  # (M,) rows of the table, sorted by depth, changed in place
    tied: np.ndarray, table: np.ndarray,  # (Z,) places whose depth is that of the next place, ascending; (M, 8)
) -> None:  # fmt: skip
    """Sort runs of equal depth by their rows of the table, and then by place: insertion sorts of ever closer ones."""
    t = 0
    while t < tied.shape[0]:
        first = last = tied[t]
        while t < tied.shape[0] and tied[t] == last:
            t, last = t + 1, last + 1
        run, step = order[first : last + 1], last + 1 - first
        while step > 1:
            step = max(step * 5 // 11, 1)
            for m in range(step, run.shape[0]):
                moving, free = run[m], m
                while free >= step and _is_before(table, moving, run[free - step]):
                    run[free] = run[free - step]
                    free -= step
                run[free] = moving


@called_by_kernels
def _is_before(table: np.ndarray, one: int, other: int) -> bool:
    for column in range(table.shape[1]):
        if table[one, column] != table[other, column]:
            return bool(table[one, column] < table[other, column])
    return bool(one < other)


@kernel(parallel=True)
def _bounds_of_batches(means: np.ndarray, scales: np.ndarray) -> np.ndarray:  # (N, 3), (N, 3)
    """Bound the Gaussians of each batch: (batches, 7) float32."""
    count = means.shape[0]
    bounds = np.empty(((count + BATCH - 1) // BATCH, 7), np.float32)
    for batch in nb.prange(bounds.shape[0]):
        begin, end = batch * BATCH, min((batch + 1) * BATCH, count)
        bound = bounds[batch]
        bound[LONGEST] = 0
        for axis in range(3):
            low = high = means[begin, axis]
            longest = bound[LONGEST]
            for i in range(begin, end):
                low, high = min(low, means[i, axis]), max(high, means[i, axis])
                longest = max(longest, scales[i, axis])
            bound[LOW + axis], bound[HIGH + axis], bound[LONGEST] = low, high, longest
    return bounds


@kernel(parallel=True, error_model="numpy")
def _project(
    splats: _Splats, bounds: np.ndarray, lens: Pinhole,  # (batches, 7) of `_bounds_of_batches`
    table: np.ndarray, depth: np.ndarray, ids: np.ndarray,  # (N, 8), (N,), (N,) out, where each chunk's part begins
) -> np.ndarray:  # fmt: skip
    """Project what is visible; returns how many Gaussians of each chunk that are, (CHUNKS,)."""
    count, found = splats.means.shape[0], np.zeros(CHUNKS, np.int64)
    for chunk in nb.prange(CHUNKS):
        sides = _sides(lens)
        first, last = chunk * bounds.shape[0] // CHUNKS, (chunk + 1) * bounds.shape[0] // CHUNKS
        near, shown, who = np.empty(BATCH, np.bool_), np.empty(BATCH, np.bool_), np.empty(BATCH, np.int64)
        lanes = np.empty(NUMBERS * BATCH, np.float64)
        n = first * BATCH
        for batch in range(first, last):
            if _is_outside(bounds[batch], sides):
                continue
            begin, end = batch * BATCH, min((batch + 1) * BATCH, count)
            _find_near(splats.means[begin:end], splats.scales[begin:end], splats.log_opacities[begin:end], sides, near)
            close = _collect(begin, near[: end - begin], splats, who, lanes)
            _project_near(close, lanes, shown, lens)
            for j in range(close):  # without a branch: what is not shown is overwritten
                for column in range(8):
                    table[n, column] = lanes[(OUT + column) * BATCH + j]
                depth[n], ids[n] = lanes[DEPTH * BATCH + j], who[j]
                n += shown[j]
        found[chunk] = n - first * BATCH
    return found


@called_by_kernels
def _sides(lens: Pinhole) -> tuple[Side, Side, Side, Side, Side]:
    """Give the sides of what a camera sees, that of depth first: who is beyond one is not seen, by `_within`.

    The reach is bounded by the longest axis and opacity 1, with sqrt(a^2 + b^2) <= |a| + |b|, twice, and with the
    outermost ray at which the camera is linearised. All is multiplied by depth, so nothing is divided.
    """
    fx, fy, cx, cy = lens.fx, lens.fy, lens.cx, lens.cy
    across = LARGEST_REACH * fx * (1.0 + max(abs(lens.x_low), abs(lens.x_high)))
    down = LARGEST_REACH * fy * (1.0 + max(abs(lens.y_low), abs(lens.y_high)))
    margin = LARGEST_REACH * ROOT
    return (
        _side(lens.viewmat, 0.0, 0.0, 1.0, 0.0),
        _side(lens.viewmat, fx, 0.0, cx + margin, across),
        _side(lens.viewmat, -fx, 0.0, lens.width - cx + margin, across),
        _side(lens.viewmat, 0.0, fy, cy + margin, down),
        _side(lens.viewmat, 0.0, -fy, lens.height - cy + margin, down),
    )


@called_by_kernels
def _side(pose: np.ndarray, x: float, y: float, z: float, reach: float) -> Side:
    """Take a side from the camera's axes to those of the world."""
    return (
        x * pose[0, 0] + y * pose[1, 0] + z * pose[2, 0],
        x * pose[0, 1] + y * pose[1, 1] + z * pose[2, 1],
        x * pose[0, 2] + y * pose[1, 2] + z * pose[2, 2],
        x * pose[0, 3] + y * pose[1, 3] + z * pose[2, 3],
        reach,
    )


@called_by_kernels(error_model="numpy", fastmath=_CONTRACTED)
def _within(side: Side, x: float, y: float, z: float, longest: float) -> float:
    """Tell how far a Gaussian may reach to the inner side, in px times depth; below 0 it lies beyond."""
    return side[0] * x + side[1] * y + side[2] * z + side[3] + side[4] * longest


@called_by_kernels(error_model="numpy", fastmath=_CONTRACTED)
def _is_outside(bound: np.ndarray, sides: tuple[Side, ...]) -> bool:
    """Tell whether all of a batch lies beyond one side, by the corner of its box that is farthest within."""
    for side in sides:
        x = bound[HIGH if side[0] > 0.0 else LOW]
        y = bound[1 + (HIGH if side[1] > 0.0 else LOW)]
        z = bound[2 + (HIGH if side[2] > 0.0 else LOW)]
        if _within(side, np.float64(x), np.float64(y), np.float64(z), np.float64(bound[LONGEST])) < 0.0:
            return True
    return False


@called_by_kernels(error_model="numpy", fastmath=_CONTRACTED)
def _find_near(
    means: np.ndarray, scales: np.ndarray, log_opacities: np.ndarray,  # (B, 3), (B, 3), (B,)
    sides: tuple[Side, ...], near: np.ndarray,  # (BATCH,) bool out
) -> None:  # fmt: skip
    """Throw out most of what is off the image before the costly part, by instructions for several Gaussians at once."""
    depth, left, right, top, bottom = sides
    for i in range(means.shape[0]):
        x, y, z = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
        longest = np.float64(max(scales[i, 0], max(scales[i, 1], scales[i, 2])))
        beside = (_within(left, x, y, z, longest) >= 0.0) & (_within(right, x, y, z, longest) >= 0.0)
        beside &= (_within(top, x, y, z, longest) >= 0.0) & (_within(bottom, x, y, z, longest) >= 0.0)
        near[i] = (_within(depth, x, y, z, longest) >= NEAR) & (log_opacities[i] >= LOG_ALPHA_MIN) & beside


@called_by_kernels
def _collect(
    begin: int, near: np.ndarray, splats: _Splats,  # (B,) bool: which of the Gaussians from `begin` on
    who: np.ndarray, lanes: np.ndarray,  # (BATCH,) int64 out; (NUMBERS * BATCH,) out, number after number
) -> int:  # fmt: skip
    """Put those that may be visible side by side, for instructions on several of them; returns how many there are."""
    n = 0
    for j in range(near.shape[0]):
        who[n] = begin + j
        n += near[j]
    for j in range(n):
        i = who[j]
        for axis in range(3):
            lanes[(MEAN + axis) * BATCH + j] = splats.means[i, axis]
            lanes[(SCALES + axis) * BATCH + j] = splats.scales[i, axis]
        for part in range(4):
            lanes[(QUAT + part) * BATCH + j] = splats.quats[i, part]
        lanes[OPACITY * BATCH + j] = splats.log_opacities[i]
    return n


@called_by_kernels(error_model="numpy")
def _project_near(
    count: int,
    lanes: np.ndarray,  # (NUMBERS * BATCH,) in: what `_collect` put there; out: what the table holds, and depth
    shown: np.ndarray, lens: Pinhole,  # (BATCH,) bool out
) -> None:  # fmt: skip
    """Project those that may be visible.

    Divisions and roots cost more than all else here, so each is done once. Nothing may be contracted: the last of a
    batch are projected one by one, and must come out as the others do.
    """
    pose, fx, fy, cx, cy = lens.viewmat, lens.fx, lens.fy, lens.cx, lens.cy
    v00, v01, v02, tx = pose[0, 0], pose[0, 1], pose[0, 2], pose[0, 3]
    v10, v11, v12, ty = pose[1, 0], pose[1, 1], pose[1, 2], pose[1, 3]
    v20, v21, v22, tz = pose[2, 0], pose[2, 1], pose[2, 2], pose[2, 3]
    for j in range(count):
        mx, my, mz = lanes[MEAN * BATCH + j], lanes[(MEAN + 1) * BATCH + j], lanes[(MEAN + 2) * BATCH + j]
        z = v20 * mx + v21 * my + v22 * mz + tz
        inverse = 1.0 / z
        x, y = (v00 * mx + v01 * my + v02 * mz + tx) * inverse, (v10 * mx + v11 * my + v12 * mz + ty) * inverse
        u, v = fx * x + cx, fy * y + cy
        xc, yc = min(max(x, lens.x_low), lens.x_high), min(max(y, lens.y_low), lens.y_high)
        cut = max((lanes[OPACITY * BATCH + j] - LOG_ALPHA_MIN) * (1.0 / HALF_LOG2E), 0.0)
        # Rows of J R_view, with J the Jacobian of the pinhole projection.
        ax, ay, az = fx * inverse * (v00 - xc * v20), fx * inverse * (v01 - xc * v21), fx * inverse * (v02 - xc * v22)
        bx, by, bz = fy * inverse * (v10 - yc * v20), fy * inverse * (v11 - yc * v21), fy * inverse * (v12 - yc * v22)
        qw, qx = lanes[QUAT * BATCH + j], lanes[(QUAT + 1) * BATCH + j]
        qy, qz = lanes[(QUAT + 2) * BATCH + j], lanes[(QUAT + 3) * BATCH + j]
        s0, s1, s2 = lanes[SCALES * BATCH + j], lanes[(SCALES + 1) * BATCH + j], lanes[(SCALES + 2) * BATCH + j]
        r00, r01, r02 = 1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy - qw * qz), 2 * (qx * qz + qw * qy)
        r10, r11, r12 = 2 * (qx * qy + qw * qz), 1 - 2 * (qx * qx + qz * qz), 2 * (qy * qz - qw * qx)
        r20, r21, r22 = 2 * (qx * qz - qw * qy), 2 * (qy * qz + qw * qx), 1 - 2 * (qx * qx + qy * qy)
        a0, b0 = s0 * (ax * r00 + ay * r10 + az * r20), s0 * (bx * r00 + by * r10 + bz * r20)
        a1, b1 = s1 * (ax * r01 + ay * r11 + az * r21), s1 * (bx * r01 + by * r11 + bz * r21)
        a2, b2 = s2 * (ax * r02 + ay * r12 + az * r22), s2 * (bx * r02 + by * r12 + bz * r22)
        sxx = a0 * a0 + a1 * a1 + a2 * a2 + DILATION
        sxy = a0 * b0 + a1 * b1 + a2 * b2
        syy = b0 * b0 + b1 * b1 + b2 * b2 + DILATION
        reach_x, reach_y = min(np.sqrt(cut * sxx), REACH_MAX), min(np.sqrt(cut * syy), REACH_MAX)
        across = (u + reach_x >= 0.5) & (u - reach_x <= lens.width - 0.5)
        shown[j] = across & (v + reach_y >= 0.5) & (v - reach_y <= lens.height - 0.5)
        inverse_syy = 1.0 / syy
        lanes[(OUT + U) * BATCH + j] = u
        lanes[(OUT + V) * BATCH + j] = v
        lanes[(OUT + SHEAR) * BATCH + j] = sxy * inverse_syy
        # var(x|y) = S_xx - S_xy^2 / S_yy is at least the dilation; rounding must not bring it below.
        lanes[(OUT + WIDTH) * BATCH + j] = HALF_LOG2E / max(sxx - sxy * sxy * inverse_syy, DILATION)
        lanes[(OUT + HEIGHT) * BATCH + j] = HALF_LOG2E * inverse_syy
        lanes[(OUT + LOG_OPACITY) * BATCH + j] = lanes[OPACITY * BATCH + j]
        lanes[(OUT + Y_REACH) * BATCH + j] = reach_y
        lanes[(OUT + X_TURN) * BATCH + j] = min(max(sxy * (reach_x / sxx), -REACH_MAX), REACH_MAX)
        lanes[DEPTH * BATCH + j] = z
