"""Gaussians seen by one camera, on a GPU: what `raster.cpu.projection` and `raster.cpu.tiling` find, found there.

Each thread projects one Gaussian, by the formulas and in the units of `raster.cpu.projection`. PyTorch sorts them by
depth, each then lists the tiles that it touches, and a stable sort by tile keeps the nearest first.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch

from gsseg_core.raster.constants import DILATION, NEAR
from gsseg_core.raster.cpu.projection import HALF_LOG2E, LARGEST_REACH, REACH_MAX, ROOT, Pinhole
from gsseg_core.raster.cpu.splat import HEIGHT, LOG_ALPHA_MIN, LOG_OPACITY, SHEAR, WIDTH, X_TURN, Y_REACH, U, V
from gsseg_core.raster.cpu.tiling import TILE, check_entries
from gsseg_core.raster.gpu.device import called_by_kernels, cuda, gpu_kernel, launch_each, on_device
from gsseg_core.raster.gpu.tensors import starts
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.scene_cache import PerScene


class SceneTensors(NamedTuple):
    """A scene on a GPU."""

    means: torch.Tensor  # (N, 3)
    quats: torch.Tensor  # (N, 4) w, x, y, z
    scales: torch.Tensor  # (N, 3)
    log_opacities: torch.Tensor  # (N,) base 2


class TileTensors(NamedTuple):
    """A projected view cut into tiles, on a GPU; compare `raster.cpu.tiling.Tiles`."""

    width: int  # of the image, in px
    height: int
    columns: int  # of tiles
    rows: int
    ids: torch.Tensor  # (M,) int32: Gaussians that reach the image, nearest first
    table: torch.Tensor  # (M, 8) float32: what is projected of each
    start: torch.Tensor  # (columns * rows + 1,) int64: entries of tile t are start[t] to start[t + 1]
    entries: torch.Tensor  # (E,) int32: row of each entry's Gaussian in the table, nearest first in each tile
    gaussian_start: torch.Tensor  # (M + 1,) int64: where the entries of each Gaussian begin, Gaussian by Gaussian
    place: torch.Tensor  # (E,) int64: which of these each entry is

    @property
    def nbytes(self) -> int:
        """Memory that it holds, in bytes."""
        return sum(held.nbytes for held in self if isinstance(held, torch.Tensor))


_KNOWN: dict[torch.device, PerScene[SceneTensors]] = {}


def tensors_of(scene: GaussianScene, device: torch.device) -> SceneTensors:
    """Copy a scene to a device, once: its tensors are kept as long as it."""
    arrays = (getattr(scene, name) for name in SceneTensors._fields)
    known = _KNOWN.setdefault(device, PerScene())
    return known.of(scene, lambda: SceneTensors(*(on_device(array, device) for array in arrays)))


def project(scene: GaussianScene, camera: Camera, device: torch.device) -> TileTensors:
    """Project a scene, sort what is visible by depth, and list the Gaussians of each tile."""
    tensors, columns, rows = tensors_of(scene, device), -(-camera.width // TILE), -(-camera.height // TILE)
    count = len(scene)
    table = torch.empty((count, 8), dtype=torch.float32, device=device)
    depth = torch.empty(count, dtype=torch.float32, device=device)
    touched = torch.empty(count, dtype=torch.int32, device=device)
    lens = on_device(_lens_of(camera), device)
    launch_each(_project, count, *tensors, lens, columns, rows, table, depth, touched)

    seen = touched.nonzero()[:, 0]
    seen = seen[_nearest_first(depth[seen], table, seen)]
    table, touched = table[seen].contiguous(), touched[seen]
    gaussian_start = starts(touched)
    total = int(gaussian_start[-1])
    check_entries(total, camera.width, camera.height)  # PyTorch sorts no more either.
    # Tiles that fit 16 bits are sorted in half the passes.
    small = torch.int16 if columns * rows < 1 << 15 else torch.int32
    tiles = torch.empty(total, dtype=small, device=device)
    owners = torch.empty(total, dtype=torch.int32, device=device)
    launch_each(_list, len(seen), table, gaussian_start, columns, rows, tiles, owners)
    tiles, place = torch.sort(tiles, stable=True)
    start = torch.searchsorted(tiles, torch.arange(columns * rows + 1, dtype=small, device=device))
    return TileTensors(
        camera.width, camera.height, columns, rows, seen.int(), table, start, owners[place], gaussian_start, place
    )


def _nearest_first(
    depth: torch.Tensor, table: torch.Tensor, seen: torch.Tensor  # (M,), (N, 8), (M,) which rows
) -> torch.Tensor:  # fmt: skip
    """Sort by depth, and where that is the same by the rows of the table, as `raster.cpu.projection` does: (M,)."""
    across = table[seen, U].view(torch.int32)  # whose order as numbers is this, for the negative ones too:
    across = torch.where(across < 0, across ^ 0x7FFFFFFF, across)
    key, order = torch.sort((depth.view(torch.int32).long() << 32) + across, stable=True)
    if not bool((key[1:] == key[:-1]).any()):
        return order
    order = torch.arange(len(depth), device=depth.device)
    for key in (*table[seen].unbind(dim=1)[::-1], depth):
        order = order[torch.argsort(key[order], stable=True)]
    return order


def _lens_of(camera: Camera) -> np.ndarray:
    """Write a camera as the kernel takes it: viewmat, fx, fy, cx, cy, size, and where it is linearised, (22,)."""
    pose, *numbers = Pinhole.of(camera)
    return np.array([*pose[:3].ravel(), *numbers], np.float64)


@gpu_kernel
def _project(
    means: np.ndarray, quats: np.ndarray, scales: np.ndarray, log_opacities: np.ndarray, lens: np.ndarray,
    columns: int, rows: int, table: np.ndarray, depth: np.ndarray, touched: np.ndarray,  # (N, 8), (N,), (N,) out
) -> None:  # fmt: skip
    """Project one Gaussian; `touched` tells how many tiles it touches, 0 where it cannot be seen."""
    i = cuda.grid(1)
    if i >= means.shape[0]:
        return
    touched[i] = 0
    fx, fy, cx, cy, width, height = lens[12], lens[13], lens[14], lens[15], lens[16], lens[17]
    mx, my, mz = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
    z = lens[8] * mx + lens[9] * my + lens[10] * mz + lens[11]
    if z < NEAR or log_opacities[i] < LOG_ALPHA_MIN:
        return
    inverse = 1.0 / z
    x = (lens[0] * mx + lens[1] * my + lens[2] * mz + lens[3]) * inverse
    y = (lens[4] * mx + lens[5] * my + lens[6] * mz + lens[7]) * inverse
    u, v = fx * x + cx, fy * y + cy
    # The reach, bounded by the longest axis and opacity 1: most of what is off the image goes no farther.
    longest = max(np.float64(scales[i, 0]), max(np.float64(scales[i, 1]), np.float64(scales[i, 2]))) * inverse
    bound_u = LARGEST_REACH * (longest * fx * (1.0 + max(abs(lens[18]), abs(lens[19]))) + ROOT)
    bound_v = LARGEST_REACH * (longest * fy * (1.0 + max(abs(lens[20]), abs(lens[21]))) + ROOT)
    if u + bound_u < 0.0 or u - bound_u > width or v + bound_v < 0.0 or v - bound_v > height:
        return
    xc, yc = min(max(x, lens[18]), lens[19]), min(max(y, lens[20]), lens[21])
    qw, qx, qy, qz = np.float64(quats[i, 0]), np.float64(quats[i, 1]), np.float64(quats[i, 2]), np.float64(quats[i, 3])
    # Rows of J R_view, with J the Jacobian of the pinhole projection.
    ax, ay, az = lens[0] - xc * lens[8], lens[1] - xc * lens[9], lens[2] - xc * lens[10]
    bx, by, bz = lens[4] - yc * lens[8], lens[5] - yc * lens[9], lens[6] - yc * lens[10]
    sxx, sxy, syy = 0.0, 0.0, 0.0
    for axis in range(3):
        if axis == 0:
            r0, r1, r2 = 1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy + qw * qz), 2 * (qx * qz - qw * qy)
        elif axis == 1:
            r0, r1, r2 = 2 * (qx * qy - qw * qz), 1 - 2 * (qx * qx + qz * qz), 2 * (qy * qz + qw * qx)
        else:
            r0, r1, r2 = 2 * (qx * qz + qw * qy), 2 * (qy * qz - qw * qx), 1 - 2 * (qx * qx + qy * qy)
        length = np.float64(scales[i, axis]) * inverse
        a, b = fx * length * (ax * r0 + ay * r1 + az * r2), fy * length * (bx * r0 + by * r1 + bz * r2)
        sxx, sxy, syy = sxx + a * a, sxy + a * b, syy + b * b
    sxx, syy = sxx + DILATION, syy + DILATION
    cut = (np.float64(log_opacities[i]) - LOG_ALPHA_MIN) / HALF_LOG2E
    reach_x, reach_y = min(math.sqrt(cut * sxx), REACH_MAX), min(math.sqrt(cut * syy), REACH_MAX)
    if u + reach_x < 0.5 or u - reach_x > width - 0.5 or v + reach_y < 0.5 or v - reach_y > height - 0.5:
        return
    table[i, U], table[i, V], table[i, SHEAR] = u, v, sxy / syy
    # var(x|y) = S_xx - S_xy^2 / S_yy is at least the dilation; rounding must not bring it below.
    table[i, WIDTH] = HALF_LOG2E / max(sxx - sxy * sxy / syy, DILATION)
    table[i, HEIGHT] = HALF_LOG2E / syy
    table[i, LOG_OPACITY] = log_opacities[i]
    table[i, Y_REACH] = reach_y
    table[i, X_TURN] = min(max(sxy * (reach_x / sxx), -REACH_MAX), REACH_MAX)
    depth[i] = z
    low, high = _rows_touched(table, i, rows)
    for row in range(low, high):
        first, last = _columns_touched(table, i, row, columns)
        touched[i] += last - first


@called_by_kernels
def _rows_touched(table: np.ndarray, i: int, rows: int) -> tuple[int, int]:
    """First and last row of tiles (exclusive) that a Gaussian may touch."""
    low = (table[i, V] - table[i, Y_REACH] - np.float32(0.5)) / np.float32(TILE)
    high = (table[i, V] + table[i, Y_REACH] - np.float32(0.5)) / np.float32(TILE)
    return int(max(math.floor(low), 0)), int(min(math.floor(high) + 1, rows))


@called_by_kernels
def _columns_touched(table: np.ndarray, i: int, row: int, columns: int) -> tuple[int, int]:
    """First and last column of tiles (exclusive) that a Gaussian touches in one row of them."""
    top = np.float32(row * TILE) + np.float32(0.5) - table[i, V]
    bottom = top + np.float32(TILE - 1)
    if bottom < -table[i, Y_REACH] or top > table[i, Y_REACH]:
        return 0, 0
    cut, narrowness = table[i, LOG_OPACITY] - np.float32(LOG_ALPHA_MIN), np.float32(1) / table[i, WIDTH]
    # The outline x(dy) is concave on the right and convex on the left: its extremes in the band are at the turning
    # points or the ends.
    dy = min(max(table[i, X_TURN], top), bottom)
    root = math.sqrt(max(cut - table[i, HEIGHT] * dy * dy, np.float32(0)) * narrowness)
    right = table[i, U] + table[i, SHEAR] * dy + root
    dy = min(max(-table[i, X_TURN], top), bottom)
    root = math.sqrt(max(cut - table[i, HEIGHT] * dy * dy, np.float32(0)) * narrowness)
    left = table[i, U] + table[i, SHEAR] * dy - root
    # A hundredth of a pixel of slack covers float32 rounding; the blend tests alpha itself.
    first = int(max(math.floor((left - np.float32(0.51)) / np.float32(TILE)), 0))
    last = int(min(math.floor((right - np.float32(0.49)) / np.float32(TILE)) + 1, columns))
    return (first, last) if last > first else (0, 0)


@gpu_kernel
def _list(
    table: np.ndarray, gaussian_start: np.ndarray, columns: int, rows: int,  # (M, 8), (M + 1,)
    tiles: np.ndarray, owners: np.ndarray,  # (E,) out: tile and Gaussian of each entry
) -> None:  # fmt: skip
    """List the tiles that one Gaussian touches."""
    m = cuda.grid(1)
    if m >= table.shape[0]:
        return
    n = gaussian_start[m]
    low, high = _rows_touched(table, m, rows)
    for row in range(low, high):
        first, last = _columns_touched(table, m, row, columns)
        for column in range(first, last):
            tiles[n], owners[n] = row * columns + column, m
            n += 1
