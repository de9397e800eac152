"""Surfaces as views see them: how much the Gaussians of a scene, or of one object alone, cover, and how deep."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gsseg_core.raster.view_operator import Blended, ViewOperator
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene

COVERED = 0.5  # accumulated alpha above which a pixel belongs to a silhouette
BEHIND = 1.02  # what is deeper than the surface of the scene by more than this factor is hidden
_EMPTY = 1e-3  # accumulated alpha below which a ray meets nothing


class Surface(NamedTuple):
    """What the rays of a view meet."""

    coverage: np.ndarray  # (H, W) float32: accumulated alpha, 0 to 1
    depth: np.ndarray  # (H, W) float32: mean depth by weight, scene units; infinite where there is nothing


def surface(scene: GaussianScene, operator: ViewOperator) -> Surface:
    """Render coverage and depth of a scene, or of an object alone, from the view of its operator."""
    codes = np.zeros((len(scene), 1), np.float32)
    codes[operator.ids, 0] = depths(scene, operator.camera, operator.ids)
    image, left_over = operator.blend(codes)
    coverage = 1 - left_over
    depth = np.divide(image[..., 0], coverage, out=np.full_like(coverage, np.inf), where=coverage > _EMPTY)
    return Surface(coverage, depth)


def colours_and_depth(scene: GaussianScene, operator: ViewOperator) -> Blended:
    """Blend the colours of a scene and the depths of its centres into a view: (H, W, 4) float32, and what is left."""
    codes, seen = np.zeros((len(scene), 4), np.float32), np.sort(operator.ids)  # once through memory
    codes[seen, :3] = scene.colors(operator.camera.center, seen)
    codes[seen, 3] = depths(scene, operator.camera, seen)
    return operator.blend(codes)


def depths(scene: GaussianScene, camera: Camera, ids: np.ndarray | None = None) -> np.ndarray:
    """Depth of each centre, or of some of them, (M,) float32 in scene units, from a camera; 0 for those behind it."""
    row, means = camera.world_to_camera[2], scene.means if ids is None else scene.means[ids]
    depth: np.ndarray = np.maximum(means @ row[:3] + row[3], 0).astype(np.float32)
    return depth
