"""Surfaces as views see them: how much the Gaussians of a scene, or of one object alone, cover, and how deep."""

from __future__ import annotations

from typing import NamedTuple

import numba as nb
import numpy as np

from gsseg_core.kernels.compiler import kernel
from gsseg_core.raster.view_operator import ViewOperator
from gsseg_core.raster.view_renderer import EVERY_PIXEL, Blended, PixelGrid
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.simd import AHEAD, prefetch

COVERED = 0.5  # accumulated alpha above which a pixel belongs to a silhouette
BEHIND = 1.02  # what is deeper than the surface of the scene by more than this factor is hidden
_EMPTY = 1e-3  # accumulated alpha below which a ray meets nothing


class Surface(NamedTuple):
    """What the rays of a view meet."""

    coverage: np.ndarray  # (H, W) float32: accumulated alpha, 0 to 1
    depth: np.ndarray  # (H, W) float32: mean depth by weight, scene units; infinite where there is nothing


def surface(scene: GaussianScene, operator: ViewOperator, grid: PixelGrid = EVERY_PIXEL) -> Surface:
    """Render coverage and depth of a scene, or of an object alone, by the operator of a view; or on a grid of it."""
    image, left_over = operator.blend_grid(depths(scene, operator.camera, operator.ids)[:, None], grid)
    return surface_of(image[..., 0], left_over)


def surface_of(depth: np.ndarray, left_over: np.ndarray) -> Surface:  # (H, W), (H, W)
    """Divide blended depths by how much of each ray was blended."""
    coverage = 1 - left_over
    mean = np.divide(depth, coverage, out=np.full_like(coverage, np.inf), where=coverage > _EMPTY)
    return Surface(coverage, mean)


def colours_and_depth(scene: GaussianScene, operator: ViewOperator) -> Blended:
    """Blend the colours of a scene and the depths of its centres into a view: (H, W, 4) float32, and what is left."""
    return operator.blend_seen(with_depths(scene, operator, scene.colors(operator.camera.center, operator.ids)))


def with_depths(scene: GaussianScene, operator: ViewOperator, others: np.ndarray) -> np.ndarray:
    """Append the depths of an operator's Gaussians, as one more channel, to others, (M, C): (M, C + 1) float32."""
    return np.concatenate([others, depths(scene, operator.camera, operator.ids)[:, None]], axis=1)


def depths(scene: GaussianScene, camera: Camera, ids: np.ndarray) -> np.ndarray:  # (M,) int32
    """Depths of some centres, (M,) float32 in scene units, from a camera; 0 for those behind it."""
    return _depths(scene.means, ids, camera.world_to_camera[2].astype(np.float64))


@kernel(parallel=True)
def _depths(means: np.ndarray, ids: np.ndarray, row: np.ndarray) -> np.ndarray:  # (N, 3), (M,), (4,) float64
    depth, last = np.empty(ids.shape[0], np.float32), ids.shape[0] - 1
    for m in nb.prange(ids.shape[0]):
        prefetch(means, ids[min(m + AHEAD, last)])
        i = ids[m]
        depth[m] = max(means[i, 0] * row[0] + means[i, 1] * row[1] + means[i, 2] * row[2] + row[3], 0.0)
    return depth
