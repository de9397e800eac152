"""Meshes to collide with: what a simulator takes for the solid shape of an object.

All three kinds are made from the object's opaque Gaussians whose centres its box contains, which
`gsseg_core.objects.oriented_boxes` makes: a few that float make it no larger. Each is an ellipsoid of one standard
deviation.

- The hull is the convex hull of the ends of their axes.
- The surface is watertight, follows hollows, and has no cavity. The ellipsoids fill voxels; gaps between these are
  closed and what they enclose is filled; marching cubes at half of the smoothed filling make the triangles.
- The Poisson surface is closed also where no camera looked: `gsseg_core.export.poisson_surface`.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gsseg_core.errors import SettingsError
from gsseg_core.export.poisson_surface import Ellipsoids, Voxels, poisson_surface, sphere
from gsseg_core.objects.occupied_cells import OPAQUE, samples
from gsseg_core.objects.oriented_boxes import class_box
from gsseg_core.progress import Progress, silent
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.quaternions import half_axes
from gsseg_core.scene.triangle_mesh import TriangleMesh
from gsseg_core.several_at_once import each_with_made
from gsseg_core.spatial.row_order import rows_by_label

HULL, SURFACE, POISSON = "hull", "surface", "poisson"
KINDS = (HULL, SURFACE, POISSON)

VOXELS = 64  # along the longest side of the object
_MARGIN = 4  # voxels around the ellipsoids, for closing and smoothing
_CLOSED = 2  # voxels to either side, by which what is filled is dilated to close gaps, and then eroded
_SAMPLES = 128  # points of an ellipsoid, by which it fills voxels
_WIDE, _APART = 3, 0.5  # voxels: width from which on it has gaps between these, and how far apart more of them are
_AT_ONCE = 1 << 14  # ellipsoids at a time, to keep memory small
_POISSON_MARGIN = 16  # voxels around a Poisson surface, whose grid is periodic


def check_collision(kind: str | None) -> None:
    """Raise `SettingsError` if there is no such kind of mesh, or the library that makes it is not installed."""
    if kind is not None and kind not in KINDS:
        raise SettingsError(f"collision is {kind!r}; expected one of {', '.join(KINDS)}")
    if kind in (SURFACE, POISSON):
        try:
            import skimage.measure  # noqa: F401
        except ImportError as error:
            raise SettingsError(
                f"collision {kind}: needs scikit-image, which is not installed; expected: pip install 'gsseg[usd]'"
            ) from error


def collision_meshes(
    scene: GaussianScene,
    labels: npt.NDArray[np.integer],  # (N,): the object of each Gaussian; 0 and below for none
    confidence: npt.NDArray[np.floating],  # (N,)
    kind: str | None,
    progress: Progress = silent,
) -> dict[int, TriangleMesh]:
    """Make a mesh of a kind for every object, by its label, ascending; none where the kind is None.

    There is none for objects without an opaque Gaussian or a volume. Raises what `check_collision` does.
    """
    check_collision(kind)
    if kind is None:
        return {}
    members = {k: ids for k, ids in rows_by_label(labels).items() if k > 0}

    def make(k: int) -> TriangleMesh | None:
        return collision_mesh(scene, members[k], confidence, kind)

    made = each_with_made(make, members, "cpu", progress, "mesh")
    return {k: mesh for k, mesh in made if mesh is not None}


def collision_mesh(
    scene: GaussianScene,
    ids: npt.NDArray[np.integer],  # (M,)
    confidence: npt.NDArray[np.floating],  # (N,)
    kind: str,
) -> TriangleMesh | None:
    """Make the mesh of one object, whose Gaussians are `ids`; None where it has no opaque Gaussian or no volume."""
    kept = ids[scene.opacities[ids] >= OPAQUE]
    if len(kept):
        box = class_box(scene, ids, confidence[ids])
        kept = kept[(np.abs((scene.means[kept] - box.center) @ box.axes) <= box.size / 2).all(axis=1)]
    if not len(kept):
        return None
    make = {HULL: _hull, SURFACE: _surface, POISSON: _poisson}[kind]
    return make(Ellipsoids(scene.means[kept], half_axes(scene.quats[kept], scene.scales[kept])))


def _hull(solid: Ellipsoids) -> TriangleMesh | None:
    """Convex hull of the ends of all axes; None where they have no volume."""
    if (hull := solid.hull()) is None:
        return None
    triangles = np.searchsorted(hull.vertices, hull.simplices).astype(np.int32)
    points = hull.points[hull.vertices].astype(np.float32)
    a, b, c = (points[triangles[:, i]] for i in range(3))
    inwards = (np.cross(b - a, c - a) * hull.equations[:, :3]).sum(axis=1) < 0
    triangles[inwards] = triangles[inwards][:, ::-1]
    return TriangleMesh(points, triangles, convex=True)


def _surface(solid: Ellipsoids) -> TriangleMesh | None:
    """Watertight surface around ellipsoids; None where they have no extent."""
    from scipy import ndimage

    voxels = _filled(solid)
    if voxels is None:
        return None
    filled = ndimage.binary_fill_holes(ndimage.binary_closing(voxels.filled, iterations=_CLOSED))
    smooth = ndimage.gaussian_filter(filled.astype(np.float32), 1.0)
    level = 0.5 * float(smooth.max())
    # Smoothing may close the mouth of a hollow.
    return voxels.mesh(ndimage.binary_fill_holes(smooth > level), smooth, level)


def _poisson(solid: Ellipsoids) -> TriangleMesh | None:
    """Poisson surface of ellipsoids, and where they have no inside, the surface around them."""
    voxels = _filled(solid, _POISSON_MARGIN)
    mesh = None if voxels is None else poisson_surface(solid, voxels)
    return mesh or _surface(solid)


def _filled(solid: Ellipsoids, margin: int = _MARGIN) -> Voxels | None:
    """Voxels that ellipsoids fill; None where they have no extent."""
    means, half_axes = solid
    reach = np.linalg.norm(half_axes, axis=2)  # (M, 3): of an ellipsoid along x, y, z
    low, high = (means - reach).min(axis=0), (means + reach).max(axis=0)
    voxel = float((high - low).max()) / VOXELS
    if not voxel > 0:
        return None
    shape = np.ceil((high - low) / voxel).astype(np.int64) + 1 + 2 * margin
    voxels = Voxels(np.zeros(shape, bool), low, voxel, margin)
    for first in range(0, len(means), _AT_ONCE):
        own = slice(first, first + _AT_ONCE)
        voxels.filled[voxels.cells(means[own, None] + np.einsum("sk,mjk->msj", _BALL, half_axes[own]))] = True
    wide = 2 * np.linalg.norm(half_axes, axis=1).max(axis=1) > _WIDE * voxel
    for points in samples(means[wide], half_axes[wide], _APART * voxel):
        voxels.filled[voxels.cells(points)] = True
    return voxels


def _ball(count: int) -> npt.NDArray[np.float32]:
    """Points (count, 3) spread evenly over the unit ball: even directions, with even radii in a fixed random order."""
    radius = (np.random.default_rng(0).permutation(np.arange(count) + 0.5) / count) ** (1 / 3)
    return (sphere(count) * radius[:, None]).astype(np.float32)


_BALL = _ball(_SAMPLES)
