"""The Poisson surface of an object: closed also where no camera looked, as on an underside.

Gaussians have no normals, so these are made first. A Gaussian's *free direction* is the mean of the directions from
which it is seen past the others, and its normal is that direction as the Gaussian's shape turns it, towards its thin
axis: Sigma^-1 d. The rest is as in Kazhdan, Bolitho & Hoppe, *Poisson surface reconstruction* (2006), on a regular
grid, where the equation is a division in the frequency domain: the function whose gradient is nearest to the normals is
high inside and low outside, and the surface is where it has the mean of its values at the Gaussians. Where nobody
looked, it may bulge; it ends at the convex hull.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from gsseg_core.scene.triangle_mesh import TriangleMesh

if TYPE_CHECKING:
    from scipy.spatial import ConvexHull

_DIRECTIONS = 96  # from which Gaussians are looked at
_PIXEL, _BEHIND = 1.5, 2.0  # voxels: side of a pixel of these looks; depth behind the front that still counts as seen
_THINNEST = 1e-2  # of the longest half axis: shorter ones turn normals no further
_DISC, _RADIUS = 32, 0.7  # samples of a Gaussian's disc; its radius, of the ellipse's: about half the area
_SMOOTH = 1.0  # voxels, standard deviation by which normals are smoothed
_DENSITY = 2.0  # voxels, standard deviation over which the area of discs is added up, for all to weigh the same
_APART = 1e-2  # of the range of values: no voxel's value is nearer to the level
_SLOPE = 0.1  # of the range of values, per voxel: how they fall towards the convex hull
_HELD = 0.5  # least share of the Gaussians inside a surface; one with fewer is not theirs


class Ellipsoids(NamedTuple):
    """The Gaussians of an object as ellipsoids of one standard deviation."""

    means: npt.NDArray[np.float32]  # (M, 3)
    half_axes: npt.NDArray[np.float32]  # (M, 3, 3): one in each column

    def hull(self) -> ConvexHull | None:
        """Find the convex hull of the ends of all axes; None where they have no volume."""
        from scipy.spatial import ConvexHull, QhullError

        axes = self.half_axes.transpose(0, 2, 1)
        ends = np.concatenate([self.means[:, None] + sign * axes for sign in (1, -1)]).reshape(-1, 3)
        try:
            return ConvexHull(ends.astype(np.float64))
        except QhullError:
            return None


class Voxels(NamedTuple):
    """Voxels that ellipsoids fill; the middle of voxel i is low + (i - margin + 0.5) * size."""

    filled: npt.NDArray[np.bool_]  # (X, Y, Z)
    low: npt.NDArray[np.float32]  # (3,)
    size: float
    margin: int

    def cells(self, points: npt.NDArray[np.floating]) -> tuple[npt.NDArray[np.int64], ...]:
        """Find the voxels that points (..., 3) are in: their indices."""
        found = np.floor((points - self.low) / self.size).astype(np.int64) + self.margin
        return tuple(np.moveaxis(np.clip(found, 0, np.array(self.filled.shape) - 1), -1, 0))

    def middles(self, chosen: npt.NDArray[np.bool_]) -> npt.NDArray[np.floating]:
        """Find the middles (V, 3) of chosen voxels (X, Y, Z)."""
        return (np.argwhere(chosen) - self.margin + 0.5) * self.size + self.low

    def mesh(self, solid: npt.NDArray[np.bool_], values: npt.NDArray[np.floating], level: float) -> TriangleMesh:
        """Make a mesh around solid voxels (X, Y, Z), where values, high inside, cross a level beside them.

        What is not solid ends below the level, and what is above it, hollows too; nothing is so near to it that
        triangles lose their area.
        """
        from skimage.measure import marching_cubes

        away = np.maximum(np.abs(values - level), _APART * float(np.ptp(values)))
        points, triangles, _, _ = marching_cubes(np.where(solid, away, -away), 0.0, gradient_direction="ascent")
        points = (points - self.margin + 0.5) * self.size + self.low
        return TriangleMesh(points.astype(np.float32), triangles.astype(np.int32))


def poisson_surface(ellipsoids: Ellipsoids, voxels: Voxels) -> TriangleMesh | None:
    """Close a surface around ellipsoids; None where they have no inside, as a sheet that is seen from both sides.

    It goes through those ends of ellipsoids that point outwards.
    """
    from scipy import ndimage

    if (hull := ellipsoids.hull()) is None:
        return None
    (means, half_axes), normals = ellipsoids, _normals(ellipsoids, voxels)
    seen = np.flatnonzero(np.abs(normals).max(axis=1) > 0)
    if not len(seen):
        return None
    axes = np.take_along_axis(half_axes, np.argsort(np.linalg.norm(half_axes, axis=1))[:, None], axis=2)[seen]
    # Where each is farthest out, about there.
    reach = np.linalg.norm(np.einsum("mjk,mj->mk", half_axes[seen], normals[seen]), axis=1)
    tips = means[seen] + reach[:, None] * normals[seen]
    discs = tips[:, None] + np.einsum("sk,mjk->msj", _disc(), axes[:, :, 1:])  # (m, samples, 3)
    area = np.prod(np.linalg.norm(axes[:, :, 1:], axis=1), axis=1).repeat(_DISC)
    cells = tuple(axis.ravel() for axis in voxels.cells(discs))
    density = np.zeros(voxels.filled.shape)
    np.add.at(density, cells, area)
    weight = area / np.maximum(ndimage.gaussian_filter(density, _DENSITY)[cells], 1e-30)
    field = np.zeros((3, *voxels.filled.shape))
    for i in range(3):
        np.add.at(field[i], cells, weight * normals[seen, i].repeat(_DISC))
    inside = _potential(field)
    level = float(np.average(inside[cells], weights=weight))
    pieces, _ = ndimage.label(inside > level)
    held = np.unique(pieces[voxels.cells(means)])
    solid = ndimage.binary_fill_holes(np.isin(pieces, held[held > 0]))
    beyond = np.ones(solid.shape, bool)
    beyond[(slice(voxels.margin // 2, -voxels.margin // 2),) * 3] = False
    if solid[beyond].any() or ndimage.binary_dilation(solid)[voxels.cells(means)].mean() < _HELD:
        return None
    places, depth = voxels.middles(solid).T.copy(), np.full(np.count_nonzero(solid), np.inf)  # (3, V), (V,)
    for plane in hull.equations:
        np.minimum(depth, (-plane[:3] @ places - plane[3]) / voxels.size, out=depth)
    inside[solid] = np.minimum(inside[solid], level + _SLOPE * float(np.ptp(inside)) * depth)
    solid[solid] = depth > 0
    return voxels.mesh(solid, inside, level)


def _normals(ellipsoids: Ellipsoids, voxels: Voxels) -> npt.NDArray[np.float64]:
    """Find unit normals (M, 3), outwards; 0 for a Gaussian that is seen from nowhere."""
    means, half_axes = ellipsoids
    solid = voxels.middles(voxels.filled)
    cell, free = _PIXEL * voxels.size, np.zeros(means.shape)
    for direction in sphere(_DIRECTIONS):
        across = np.linalg.svd(direction[None])[2][1:]  # (2, 3)
        # Coordinate by coordinate: NumPy takes several times as long along the points of an (M, 2) array.
        pixel, own = (np.floor(points @ across.T / cell).astype(np.int64).T.copy() for points in (solid, means))
        low, high = pixel.min(axis=1, keepdims=True), pixel.max(axis=1, keepdims=True)
        shape = tuple((high - low + 1).ravel())
        at, own_at = (np.ravel_multi_index(tuple(one), shape) for one in (pixel - low, np.clip(own, low, high) - low))
        front = np.full(shape[0] * shape[1], -np.inf)
        np.maximum.at(front, at, solid @ direction)
        reach = np.linalg.norm(np.einsum("mjk,j->mk", half_axes, direction), axis=1)
        free += (means @ direction + reach >= front[own_at] - _BEHIND * voxels.size)[:, None] * direction
    lengths = np.linalg.norm(half_axes, axis=1)  # (M, 3)
    turned = np.einsum("mjk,mj->mk", half_axes / np.maximum(lengths, 1e-30)[:, None], free)
    turned /= np.maximum(lengths, _THINNEST * lengths.max(axis=1, keepdims=True) + 1e-30) ** 2
    normals = np.einsum("mjk,mk->mj", half_axes / np.maximum(lengths, 1e-30)[:, None], turned)
    norms = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(norms > 0, normals / np.maximum(norms, 1e-300), 0)


def _potential(field: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:  # (3, X, Y, Z)
    """Find the function (X, Y, Z) whose gradient is nearest to minus the field, both smoothed."""
    from scipy import fft

    shape = field.shape[1:]
    waves = [2 * np.pi * fft.fftfreq(n) for n in shape[:2]] + [2 * np.pi * fft.rfftfreq(shape[2])]
    k = np.meshgrid(*waves, indexing="ij", sparse=True)
    squared = k[0] ** 2 + k[1] ** 2 + k[2] ** 2
    divergence = sum(1j * k[i] * fft.rfftn(field[i]) for i in range(3))
    solved = np.where(squared > 0, divergence / np.maximum(squared, 1e-12), 0) * np.exp(-(_SMOOTH**2) * squared / 2)
    return fft.irfftn(solved, shape)


def sphere(count: int) -> npt.NDArray[np.float64]:
    """Directions (count, 3) spread evenly, on a Fibonacci spiral."""
    i = np.arange(count) + 0.5
    z, turn = 1 - 2 * i / count, np.pi * (1 + 5**0.5) * i
    return np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=1)


def _disc() -> npt.NDArray[np.float64]:
    """Points (S, 2) spread evenly over a disc of `_RADIUS`."""
    i = np.arange(_DISC) + 0.5
    turn = np.pi * (1 + 5**0.5) * i
    return _RADIUS * np.sqrt(i / _DISC)[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
