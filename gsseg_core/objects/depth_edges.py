"""Where the surface of a scene ends in a view, and how much of the border between two segments runs along such edges.

Parts of one object meet on its surface; different objects meet where one hides the other, or stands on it. So depth
edges help to tell which segments are one object, wherever masks cut objects up.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.ndimage import distance_transform_edt, gaussian_filter, maximum_filter

from gsseg_core.raster.depth import surface
from gsseg_core.raster.view_operator import ViewOperator
from gsseg_core.raster.view_renderer import PixelGrid
from gsseg_core.scene.gaussian_scene import GaussianScene

_LONG_SIDE = 400  # px, at most, of the image that edges are looked for in: what generators see is no finer
_BLUR = 0.7  # px, standard deviation
_REACH = 2  # px to either side, over which the surface bends
_NEAR = 5  # px, the width of the square around a pixel in which an edge counts for it, as masks miss edges by some
_SHARP = 8.0  # bend of an edge that is certain
_SEAM = 3  # px of unknown between two segments that still border on each other


class DepthEdges(NamedTuple):
    """Edges of the surface that a view sees."""

    strength: np.ndarray  # (R, C) float32: 0 where the surface goes on, 1 where it ends
    grid: PixelGrid  # the pixels of the view that these are


class Borders(NamedTuple):
    """Borders between L segments of one view, symmetric."""

    length: sparse.csr_matrix  # (L, L) float32: in px of the grid
    edges: sparse.csr_matrix  # (L, L) float32: the strength of the depth edges along them, added up

    @classmethod
    def empty(cls, num: int) -> Borders:
        """Segments of which nobody knows whether they border on each other."""
        return cls(*(sparse.csr_matrix((num, num), dtype=np.float32) for _ in range(2)))


def depth_edges(scene: GaussianScene, operator: ViewOperator) -> DepthEdges:
    """Find where the surface that a view, given by its operator, sees of a scene ends, or has a crease.

    With u the inverse depth, which is linear in the image wherever the surface is flat, the surface bends in direction
    d by f (u(p + d) + u(p - d) - 2 u(p)) / u(p), f being the focal length: positive on its far side where it ends, and
    in the crease where an object stands on something.
    """
    grid = PixelGrid(0, -(-max(operator.camera.width, operator.camera.height) // _LONG_SIDE))
    depth = surface(scene, operator, grid).depth
    focal = np.sqrt(operator.camera.fx * operator.camera.fy) / grid.step
    inverse = gaussian_filter(1 / np.maximum(depth, 1e-9).astype(np.float64), _BLUR)
    rows, columns = inverse.shape
    padded = np.pad(inverse, _REACH, mode="edge")

    def moved(down: int, right: int) -> np.ndarray:
        return padded[_REACH + down :, _REACH + right :][:rows, :columns]

    bend = np.zeros_like(inverse)
    for down, right in ((0, _REACH), (_REACH, 0), (_REACH, _REACH), (_REACH, -_REACH)):
        np.maximum(bend, moved(down, right) + moved(-down, -right) - 2 * inverse, out=bend)
    sharp = maximum_filter(bend * focal / np.maximum(inverse, 1e-9), _NEAR) / _SHARP
    return DepthEdges(np.minimum(sharp, 1).astype(np.float32), grid)


def borders(
    labels: np.ndarray,  # (H, W) integers, negative where unknown
    ids: np.ndarray,  # (L,): the labels that count
    edges: DepthEdges,
) -> Borders:
    """Measure the borders between the segments of a mask, and how much depth edges go along with them."""
    sampled = edges.grid.of(labels)
    if not (sampled >= 0).any():
        return Borders.empty(len(ids))
    distance, nearest = distance_transform_edt(sampled < 0, return_indices=True)
    row = np.full(max(int(sampled.max()), int(ids.max(initial=0))) + 2, -1)  # The last one is for unknown pixels.
    row[ids] = np.arange(len(ids))
    segment = row[np.where(distance <= _SEAM, sampled[tuple(nearest)], -1)]
    sides = []
    for one, other in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
        a, b = segment[one], segment[other]
        border = (a != b) & (a >= 0) & (b >= 0)
        sides.append((a[border], b[border], np.maximum(edges.strength[one], edges.strength[other])[border]))
    a, b, strength = (np.concatenate(part) for part in zip(*sides, strict=True))
    at, shape = (np.concatenate([a, b]), np.concatenate([b, a])), (len(ids), len(ids))
    values = (np.ones_like(strength), strength)
    return Borders(*(sparse.coo_matrix((np.tile(value, 2), at), shape=shape).tocsr() for value in values))
