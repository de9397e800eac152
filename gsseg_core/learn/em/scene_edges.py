"""Edges of colour and depth of the scene in a view, for the alignment of mask boundaries.

The strength of an edge is the luminance gradient plus the second differences of inverse depth, each in units of its
95th percentile in a sample of the view. Only the pixels near boundaries of the mask and those in the sample are
rendered. Inverse depth is linear in the image on a plane, so its second differences respond to creases and steps only.
Depth alone is too blurred to locate boundaries, so a scene of one colour has no edges.
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
EVERY = 3  # the sample takes every third row and column of squares
SMALL = 448  # an image with fewer rows (columns) has all of its rows (columns) in the sample
STRONGEST = 2.0  # edge strengths are clipped to this many 95th percentiles of the view

_LIGHT: PerScene[tuple[np.ndarray, bool]] = PerScene()


def luminance(scene: GaussianScene) -> tuple[np.ndarray, bool]:
    """Return each Gaussian's mean colour channel, (N,) float32, and whether any differ; if not, there are no edges."""

    def measured() -> tuple[np.ndarray, bool]:
        light = scene.colors().mean(axis=1)
        return light, bool(light.min() < light.max())

    return _LIGHT.of(scene, measured)


def scene_edges(operator: ViewOperator, scene: GaussianScene, labels: np.ndarray, distance: int) -> np.ndarray:
    """Compute the strength of the edges of a view, (H, W) float32, at least 0, in the units of this module.

    Values are only valid within `distance` px of the boundaries of the view's mask `labels`, (H, W) int32, and in the
    sample.
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
    """Return the index of the unit, the 95th percentile, among `count` sorted edges."""
    return 95 * (count - 1) // 100


def sampled(image: np.ndarray) -> np.ndarray:
    """Return the sampled pixels of an image, (H, W): some squares without their margins, or all of a small image."""
    rows, columns = rows_and_columns_in_sample(*image.shape)
    return image[rows][:, columns].ravel()


def rows_and_columns_in_sample(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Mark the rows and columns that `sampled` uses, (H,) and (W,) bool."""
    return _in_sample(height, 1), _in_sample(width, 1)


def _in_sample(size: int, margin: int) -> np.ndarray:
    """Mark the rows or columns of an image that cross squares of the sample, without margins: (size,) bool."""
    if size < SMALL:
        return np.ones(size, bool)
    first = np.arange(size) % (SQUARE * EVERY) - SQUARE
    return (first >= margin) & (first < SQUARE - margin)


def _near_or_sampled(near: np.ndarray, height: int, width: int) -> np.ndarray:
    """Mark the pixels of blocks `near` boundaries and of the squares of the sample, (H, W) bool."""
    wanted: np.ndarray = near.repeat(BLOCK, axis=0).repeat(BLOCK, axis=1)[:height, :width]
    wanted |= np.logical_and.outer(_in_sample(height, 0), _in_sample(width, 0))
    return wanted


@kernel(parallel=True)
def _luminance_and_inverse_depth(
    means: np.ndarray, light: np.ndarray, ids: np.ndarray, ahead: np.ndarray  # (N, 3), (N,), (M,), (4,) row of depths
) -> np.ndarray:  # fmt: skip
    """Return luminance and inverse depth of some Gaussians, (M, 2) float32."""
    channels = np.empty((ids.shape[0], 2), np.float32)
    for m in nb.prange(ids.shape[0]):
        i = ids[m]
        depth = means[i, 0] * ahead[0] + means[i, 1] * ahead[1] + means[i, 2] * ahead[2] + ahead[3]
        channels[m, 0] = light[i]
        channels[m, 1] = 1 / max(depth, np.float32(1e-6))  # Gaussians behind the camera are not rendered
    return channels


@kernel(parallel=True)
def _differences(image: np.ndarray, left_over: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the length of the luminance gradient and the second differences of inverse depth, (H, W) float32 each.

    `image`, (H, W, 2), has luminance and inverse depth. It is divided in place by the accumulated opacity of each ray,
    1 - `left_over`, (H, W), but at least by 0.5.
    """
    height, width = left_over.shape
    light_edges, depth_edges = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    for y in nb.prange(height):
        for x in range(width):
            # Mean over the visible Gaussians; where a ray mostly misses them, the background counts as dark and far.
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
