"""Boxes around objects, for a planner: they lie as the object does, and a few stray Gaussians do not blow them up.

With weights w_i = opacity times probability of the class, centres x_i and covariances S_i of an object's Gaussians:

1. Floaters go. d_i is the distance from the geometric median (Weiszfeld 1937), d_90 the weighted 90 % quantile of
   these; what is farther away than 3 d_90 is left out of all that follows. The median stays where it is until half of
   the weight floats, the quantile until a tenth does. Of matter spread evenly along a line, over a disc or in a ball
   nothing is left out.
2. The matter: c = sum w_i x_i / sum w_i and S = sum w_i ((x_i - c)(x_i - c)^T + S_i) / sum w_i.
3. Axes: those of S, or a box with a side on one of the three largest faces of the points' convex hull, whichever is
   smaller; and then, about each axis, the turn for which the rectangle around the points is smallest, until none makes
   the box smaller. One side of such a rectangle lies along an edge of the points' hull (Freeman and Shapira 1975). The
   axes of S alone say little of a cube or a round table. Points outside the 0.5 % and 99.5 % quantiles along the axes
   of S do not count for this.
4. Sides: along an axis u a Gaussian reaches from u.x_i - s_i to u.x_i + s_i, where s_i^2 = u^T S_i u. The box begins
   where 0.5 % of the weight has begun, and ends where all but 0.5 % has ended.

All of this turns, moves and scales with the scene, and no direction is taken for up.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from gsseg_core.errors import SceneValueError
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.quaternions import covariances

if TYPE_CHECKING:
    from gsseg_core.segmentation import Segmentation

Array = npt.NDArray[np.float64]

FAR = 3.0  # what is so many times farther away than 90 % of the weight is a floater
TRIM = 0.005  # share of the weight that the box leaves out on each side
ENOUGH = 0.999  # a turn has to make the rectangle smaller than this part of it; else the axes stay
SAMPLE = 8000  # so many Gaussians of an object are looked at, at most, taken at even steps: that bounds the time
_TIED = 1e-9  # areas and volumes that differ by less than this part of them differ by rounding
_STEPS, _PASSES, _SIDES = 50, 4, 3  # of the median, at most; over the axes, at most; faces that a box is tried on
_MOST = 1e100  # of a mean, covariance or weight: products of two of them are finite
_SETTLED = 1e-3  # the median may still move by this part of the largest distance: it only has to lie inside


@dataclass(frozen=True, eq=False)
class OrientedBox:
    """Where an object lies and how large it is, in the units of the scene.

    Attributes
    ----------
    center : ndarray (3,) float64
        Middle of the box.
    axes : ndarray (3, 3) float64
        Columns are the directions of its sides, the longest first; a rotation from the axes of the box to those of the
        scene. Each is one of two opposite directions, and for sides of equal length so is their order: arbitrary.
    size : ndarray (3,) float64
        Lengths of the sides, descending.
    mean : ndarray (3,) float64
        Mean of the object's matter.
    covariance : ndarray (3, 3) float64
        Covariance of its matter about that mean, in squared units: how far it reaches, not how uncertain the mean is.
    """

    center: Array
    axes: Array
    size: Array
    mean: Array
    covariance: Array

    @property
    def corners(self) -> Array:
        """The eight corners (8, 3)."""
        signs = np.array(list(product((-0.5, 0.5), repeat=3)))
        return self.center + (signs * self.size) @ self.axes.T

    def moved(self, rotation: Array, translation: Array, scale: float) -> OrientedBox:
        """Return the box after x -> scale * rotation (3, 3) @ x + translation (3,); its axes stay in their order."""
        turn = scale * rotation
        return OrientedBox(
            turn @ self.center + translation,
            _pointed(rotation @ self.axes),
            scale * self.size,
            turn @ self.mean + translation,
            turn @ self.covariance @ turn.T,
        )

    def as_dict(self) -> dict[str, Any]:
        """Write it in plain lists, as in report.json: `axes` is a list of directions, the longest side's first."""
        places = dict.fromkeys(("center", "mean"), float(self.size[0]))  # However far away, as exact as the size.
        return {
            name: _rounded(value, places.get(name, np.inf))
            for name, value in {**vars(self), "axes": self.axes.T}.items()
        }


def oriented_box(
    means: np.ndarray,  # (M, 3): centres of the Gaussians, at least one
    covariances: np.ndarray,  # (M, 3, 3): in squared units
    weights: np.ndarray,  # (M,): what each counts, from 0; if all are 0, all count the same
) -> OrientedBox:
    """Put a box around some Gaussians; the module says how. Raises `SceneValueError` for other shapes or values."""
    count = len(means)
    shapes = (np.shape(means), np.shape(covariances), np.shape(weights))
    if count == 0 or shapes != ((count, 3), (count, 3, 3), (count,)):
        raise SceneValueError(
            f"box: means, covariances, weights have shapes {shapes}; expected (M, 3), (M, 3, 3), (M,), M at least 1"
        )
    every = -(-count // SAMPLE)
    points, shape, weights = (np.asarray(values[::every], np.float64) for values in (means, covariances, weights))
    if not all(np.abs(values).max() < _MOST for values in (points, shape, weights)) or weights.min() < 0:
        raise SceneValueError(
            f"box: means, covariances or weights are NaN, or beyond {_MOST:g}, or weights are below 0; expected finite "
            "numbers, and weights from 0"
        )
    if not weights.any():
        weights = np.ones(len(points))
    kept = _without_floaters(points, weights)
    points, shape, weights = points[kept], shape[kept], weights[kept]
    share = weights / weights.sum()
    mean = share @ points
    offsets = points - mean
    covariance = (offsets * share[:, None]).T @ offsets + np.einsum("m,mij->ij", share, shape)
    axes = _turned(offsets, share, np.linalg.eigh(covariance)[1])
    reach = np.sqrt(np.maximum(np.einsum("ik,mij,jk->mk", axes, shape, axes, optimize=True), 0))
    along = offsets @ axes
    low, high = _quantile(along - reach, share, TRIM), -_quantile(-along - reach, share, TRIM)
    order = np.argsort(low - high, kind="stable")
    center = mean + axes @ ((low + high) / 2)
    return OrientedBox(center, _pointed(axes[:, order]), (high - low)[order], mean, covariance)


def class_box(scene: GaussianScene, index: np.ndarray, confidence: np.ndarray) -> OrientedBox:
    """Put a box around the Gaussians of one object, (M,) with M > 0, each with its probability to be of it, (M,)."""
    every = -(-len(index) // SAMPLE)
    index, confidence = index[::every], confidence[::every]
    shapes = covariances(scene.quats[index].astype(np.float64), scene.scales[index])
    return oriented_box(scene.means[index], shapes, scene.opacities[index] * confidence)


def object_boxes(scene: GaussianScene, result: Segmentation) -> dict[int, OrientedBox]:
    """Put a box around every object of a segmentation.

    Returns
    -------
    dict of int to OrientedBox
        By class id, ascending; neither the background nor classes without a Gaussian.

    Raises
    ------
    StateMismatchError
        The segmentation belongs to another scene.
    """
    from gsseg_core.spatial.row_order import rows_by_label

    result.require(scene)
    members, confidence = rows_by_label(result.labels), result.confidence
    return {k: class_box(scene, own, confidence[own]) for k, own in members.items() if k > 0}


def _without_floaters(points: Array, weights: Array) -> npt.NDArray[np.bool_]:
    """Mark points (M, 3) that are no farther than `FAR` times 90 % of the weight from the geometric median, (M,)."""
    middle = weights @ points / weights.sum()
    distance = np.linalg.norm(points - middle, axis=1)
    for _ in range(_STEPS):
        # A point that the median comes to lie on must not take all the weight.
        pull = weights / np.maximum(distance, 1e-6 * distance.max() or 1.0)
        before, middle = middle, pull @ points / pull.sum()
        distance = np.linalg.norm(points - middle, axis=1)
        if np.linalg.norm(middle - before) <= _SETTLED * distance.max():
            break
    limit = FAR * _quantile(distance[:, None], weights / weights.sum(), 0.9)
    return (distance <= limit) & (weights > 0)


def _turned(offsets: Array, share: Array, axes: Array) -> Array:
    """Find the axes (3, 3) of the smallest box around points (M, 3), each with its share (M,) of the weight.

    It begins with the axes given, and with the sides of the points' hull.
    """
    from gsseg_core.objects.hulls import hull_faces  # Who reads boxes only, as a client does, starts without.

    along = offsets @ axes
    low, high = _quantile(along, share, TRIM), -_quantile(-along, share, TRIM)
    points = offsets[((along >= low) & (along <= high)).all(axis=1)]
    if len(points) < 4:  # In one plane, so that boxes of no volume contain them: nothing to choose by.
        return axes
    starts, faces = [axes], hull_faces(points)
    if len(faces):  # Not all in one plane.
        corners = points[faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        areas = np.linalg.norm(normals, axis=1)
        points = points[np.unique(faces)]
        for side in np.argsort(-areas, kind="stable")[:_SIDES]:
            starts.append(_turned_about(points, _completed(normals[side] / areas[side], axes), 0))
    sides = np.stack([np.ptp(points @ start, axis=0) for start in starts])
    axes = starts[_least(sides.prod(axis=1), sides.sum(axis=1))]
    for _ in range(_PASSES):
        before = axes
        for k in range(3):
            axes = _turned_about(points, axes, k)
        if axes is before:
            break
    return axes


def _completed(normal: Array, axes: Array) -> Array:
    """Complete a direction (3,) to a rotation (3, 3), with the one of `axes` (3, 3) that lies most across it."""
    other = axes[:, np.abs(normal @ axes).argmin()]
    other = other - normal * (normal @ other)
    other /= np.linalg.norm(other)
    return np.stack([normal, other, _across(normal, other)], axis=1)


def _across(a: Array, b: Array) -> Array:
    """Cross product of two directions (3,) each, of which NumPy's own takes ten times as long."""
    (x, y, z), (u, v, w) = a.tolist(), b.tolist()
    return np.array([y * w - z * v, z * u - x * w, x * v - y * u])


def _least(extent: Array, girth: Array) -> int:
    """Choose the candidate that takes the least area or volume (C,), of those that tie the least girth (C,).

    On all sides of a triangle stand rectangles of one area, on the faces of a tetrahedron often boxes of one volume:
    rounding must not choose.
    """
    return int(np.where(extent <= extent.min() * (1 + _TIED), girth, np.inf).argmin())


def _turned_about(points: Array, axes: Array, k: int) -> Array:
    """Turn axes (3, 3) about the one in column k so that the box around points (M, 3) is smallest."""
    i, j = (k + 1) % 3, (k + 2) % 3
    x, y, gain = _smallest_rectangle(points @ axes[:, [i, j]])
    if gain >= ENOUGH:
        return axes
    turned = axes.copy()
    turned[:, [i, j]] = axes[:, [i, j]] @ np.array([[x, -y], [y, x]])
    return turned


def _smallest_rectangle(points: Array) -> tuple[float, float, float]:
    """Direction x, y of a side of the smallest rectangle around points (M, 2); its area by that of the upright one."""
    from gsseg_core.objects.hulls import rectangles_around

    spans = np.ptp(points, axis=0)
    if spans.min() <= _TIED * spans.max():  # Seen edge on: there is nothing to make smaller.
        return 1.0, 0.0, 1.0
    directions, lengths, widths = rectangles_around(points[np.lexsort(points.T[::-1])])
    areas = lengths * widths
    best = _least(areas, lengths + widths)
    if areas[best] <= _TIED * spans.max() ** 2:  # All on one line.
        return 1.0, 0.0, 1.0
    x, y = directions[best].tolist()
    # A quarter of a turn makes the same rectangle; the least turn keeps the axes in their order.
    if abs(x) < abs(y):
        x, y = y, -x
    gain = float(areas[best] / spans.prod())
    return (x, y, gain) if x > 0 else (-x, -y, gain)


def _quantile(values: Array, share: Array, part: float) -> Array:
    """Least value (C,) of each column of (M, C) up to which `part` of the weight lies; shares (M,) sum to 1."""
    order = np.argsort(values, axis=0)  # Those of one value may come in any order: it is the value that is asked for.
    reached = np.cumsum(share[order], axis=0) >= part * (1 - 1e-9)
    rows = np.where(reached.any(axis=0), reached.argmax(axis=0), len(values) - 1)
    columns = np.arange(values.shape[1])
    return values[order[rows, columns], columns]


def _pointed(axes: Array) -> Array:
    """Choose one of the two directions of each axis (3, 3), the same way for all boxes, so that they are a rotation."""
    first, second = (axis * np.copysign(1.0, axis[np.abs(axis).argmax()]) for axis in axes.T[:2])
    return np.stack([first, second, _across(first, second)], axis=1)


def _rounded(values: Array, unit: float) -> Any:
    """Six significant digits of the largest, or of a unit that is smaller."""
    largest = min(float(np.abs(values).max()), unit)
    return values.round(5 - int(np.floor(np.log10(largest)))).tolist() if largest else values.tolist()
