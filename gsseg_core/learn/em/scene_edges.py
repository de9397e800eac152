"""Edges of the scene in a view, of colour and of depth, to which boundaries of masks can be aligned.

Their strength is the gradient of the luminance plus the second differences of the inverse depth, each in units of its
95th percentile, which is that of a sample of the view. Edges are rendered where they are needed alone: near boundaries
of the mask, and in the sample. On a plane, inverse depth is linear in the image, so that its second differences are
those of creases and steps. Depth alone is too blurred to locate boundaries: a scene of one colour has no edges.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from gsseg_core.kernels.compiler import kernel
from gsseg_core.learn.em.block_weights import near_boundaries
from gsseg_core.raster.constants import BLOCK
from gsseg_core.raster.view_operator import ViewOperator
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.scene_cache import PerScene

SQUARE = 4 * BLOCK  # px, side of the squares of the sample, which are tiles of the rasteriser
EVERY = 3  # of rows and columns of squares, one is in the sample
SMALL = 448  # px: of rows or columns of fewer, all are in the sample
STRONGEST = 2.0  # edges count at most so much, in units of the view's 95th percentile

_LIGHT: PerScene[tuple[np.ndarray, bool]] = PerScene()


def luminance(scene: GaussianScene) -> tuple[np.ndarray, bool]:
    """Mean of the channels of each Gaussian's colour, (N,) float32, and whether any differ: else nothing has edges."""

    def measured() -> tuple[np.ndarray, bool]:
        light = scene.colors().mean(axis=1)
        return light, bool(light.min() < light.max())

    return _LIGHT.of(scene, measured)


def scene_edges(operator: ViewOperator, scene: GaussianScene, labels: np.ndarray, distance: int) -> np.ndarray:
    """Strength of the edges of colour and depth of a view, (H, W) float32, at least 0; see above for units.

    It has no meaning farther than so many px from the boundaries of the view's mask, (H, W) int32, but in the sample.
    """
    camera, (light, differs) = operator.camera, luminance(scene)
    if not differs:
        return np.zeros((camera.height, camera.width), np.float32)
    ahead = camera.world_to_camera[2].astype(np.float32)
    channels = _luminance_and_inverse_depth(scene.means, light, operator.ids, ahead)
    wanted = _near_or_sampled(near_boundaries(labels, -(-distance // BLOCK)), camera.height, camera.width)
    light_edges, depth_edges = _differences(*operator.blend_seen(channels, wanted))
    return _in_units(light_edges) + _in_units(depth_edges)


def _in_units(edges: np.ndarray) -> np.ndarray:
    some = sampled(edges)
    rank = rank_of_unit(some.size)
    unit = np.partition(some, rank)[rank]
    return np.minimum(edges / unit, np.float32(STRONGEST)) if unit > 0 else np.zeros_like(edges)


def rank_of_unit(count: int) -> int:
    """Tell which of so many edges, sorted, is the unit."""
    return 95 * (count - 1) // 100


def sampled(image: np.ndarray) -> np.ndarray:
    """Sample a view, (H, W): the pixels of some squares, but for their margins; all pixels of a small one."""
    rows, columns = rows_and_columns_in_sample(*image.shape)
    return image[rows][:, columns].ravel()


def rows_and_columns_in_sample(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Mark those that `sampled` takes, (H,) and (W,) bool."""
    return _in_sample(height, 1), _in_sample(width, 1)


def _in_sample(size: int, margin: int) -> np.ndarray:
    """Mark the rows or columns of an image that meet squares of the sample, less their margins: (size,) bool."""
    if size < SMALL:
        return np.ones(size, bool)
    first = np.arange(size) % (SQUARE * EVERY) - SQUARE
    return (first >= margin) & (first < SQUARE - margin)


def _near_or_sampled(near: np.ndarray, height: int, width: int) -> np.ndarray:
    """Mark the pixels of blocks that are near, and of the squares of the sample, (H, W) bool."""
    wanted: np.ndarray = near.repeat(BLOCK, axis=0).repeat(BLOCK, axis=1)[:height, :width]
    wanted |= np.logical_and.outer(_in_sample(height, 0), _in_sample(width, 0))
    return wanted


@kernel(parallel=True)
def _luminance_and_inverse_depth(
    means: np.ndarray, light: np.ndarray, ids: np.ndarray, ahead: np.ndarray  # (N, 3), (N,), (M,), (4,) row of depths
) -> np.ndarray:  # fmt: skip
    """Luminance and inverse depth of some Gaussians, (M, 2) float32."""
    channels = np.empty((ids.shape[0], 2), np.float32)
    for m in nb.prange(ids.shape[0]):
        i = ids[m]
        depth = means[i, 0] * ahead[0] + means[i, 1] * ahead[1] + means[i, 2] * ahead[2] + ahead[3]
        channels[m, 0] = light[i]
        channels[m, 1] = 1 / max(depth, np.float32(1e-6))  # what is behind the camera is not drawn
    return channels


@kernel(parallel=True)
def _differences(image: np.ndarray, left_over: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Length of the gradient of luminance, and second differences of inverse depth, (H, W) float32 each.

    The image (H, W, 2) holds the two; it is divided in place by what of each ray is not left over, (H, W).
    """
    height, width = left_over.shape
    light_edges, depth_edges = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    for y in nb.prange(height):
        for x in range(width):
            # Means over what is seen; where that is little, the background is dark and far away.
            seen = max(1 - left_over[y, x], np.float32(0.5))
            image[y, x, 0] /= seen
            image[y, x, 1] /= seen
    for y in nb.prange(height):
        up, down = max(y - 1, 0), min(y + 1, height - 1)
        for x in range(width):
            left, right = max(x - 1, 0), min(x + 1, width - 1)
            dy, dx = image[down, x, 0] - image[up, x, 0], image[y, right, 0] - image[y, left, 0]
            light_edges[y, x] = np.sqrt(dx * dx + dy * dy)
            here = 2 * image[y, x, 1]
            across = image[y, left, 1] + image[y, right, 1] - here if left < x < right else np.float32(0)
            along = image[up, x, 1] + image[down, x, 1] - here if up < y < down else np.float32(0)
            depth_edges[y, x] = abs(across) + abs(along)
    return light_edges, depth_edges
