"""Lenses: where the ray of a point lands in an image that no pinhole took, and the table of lens models."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from functools import cached_property, lru_cache

import numpy as np
import numpy.typing as npt

from gsseg_core.errors import IntrinsicsError
from gsseg_core.files.input_files import check_pixels
from gsseg_core.text import clipped

Floats = npt.NDArray[np.float64]

_PROFILE_STEPS = 4096
_WIDEST_PERSPECTIVE = math.radians(89)
_NEWTON_STEPS = 12
_DIFFERENCE = 1e-6
_CHECKED = 17  # radii, and directions, of the pixels at which it is checked that a lens can be undone
_TOLERANCE_PX = 1e-3


class Projection(Enum):
    """Distance from the principal point, in focal lengths, of a ray at angle a to the optical axis, undistorted."""

    PERSPECTIVE = "tan a"
    FISHEYE = "a"
    PANORAMA = "longitude and latitude"


@dataclass(frozen=True)
class LensModel:
    """A lens model: its name in COLMAP's and nerfstudio's files, its coefficients in order, its name in ROS, if any.

    With `rational`, k4 and those after it divide; see `Lens`.
    """

    name: str
    projection: Projection
    coefficients: tuple[str, ...] = ()
    ros: str = ""
    rational: bool = False

    def order(self, coefficients: Mapping[str, float]) -> tuple[float, ...]:
        """Put coefficients by name into the model's order; those that are not there are 0.

        Raises `IntrinsicsError` where one that is not 0 does not belong to this model.
        """
        for name, value in coefficients.items():
            if value and name not in self.coefficients:
                expected = ", ".join(self.coefficients) or "no coefficient"
                raise IntrinsicsError(f"lens {self.name}: has {name} = {value:g}; expected {expected}")
        return tuple(coefficients.get(name, 0.0) for name in self.coefficients)


_BROWN = ("k1", "k2", "p1", "p2", "k3", "k4")
LENS_MODELS = (
    LensModel("SIMPLE_PINHOLE", Projection.PERSPECTIVE),
    LensModel("PINHOLE", Projection.PERSPECTIVE),
    LensModel("SIMPLE_RADIAL", Projection.PERSPECTIVE, ("k1",)),
    LensModel("RADIAL", Projection.PERSPECTIVE, ("k1", "k2")),
    LensModel("OPENCV", Projection.PERSPECTIVE, _BROWN, "plumb_bob"),
    LensModel("FULL_OPENCV", Projection.PERSPECTIVE, (*_BROWN, "k5", "k6"), "rational_polynomial", rational=True),
    LensModel("SIMPLE_FISHEYE", Projection.FISHEYE),
    LensModel("FISHEYE", Projection.FISHEYE),
    LensModel("SIMPLE_RADIAL_FISHEYE", Projection.FISHEYE, ("k1",)),
    LensModel("RADIAL_FISHEYE", Projection.FISHEYE, ("k1", "k2")),
    LensModel("OPENCV_FISHEYE", Projection.FISHEYE, ("k1", "k2", "k3", "k4"), "equidistant"),
    LensModel("THIN_PRISM_FISHEYE", Projection.FISHEYE, (*_BROWN, "sx1", "sy1")),
    LensModel("EQUIRECTANGULAR", Projection.PANORAMA),
)
"""All models that are read; ROS lists the coefficients in this order, the files of others name them."""

MODELS_BY_NAME = {model.name: model for model in LENS_MODELS}


@dataclass(frozen=True)
class Lens:
    """A lens before a sensor, in the axes and pixels of `Camera`.

    With (u, v) where a ray lands undistorted (`Projection`), r^2 = u^2 + v^2 and q = 1 + k1 r^2 + k2 r^4 + k3 r^6 +
    k4 r^8, it lands in the pixel: principal point + focal length times

        u q + 2 p1 u v + p2 (r^2 + 2 u^2) + sx1 r^2,   v q + 2 p2 u v + p1 (r^2 + 2 v^2) + sy1 r^2

    Where the model is rational, q = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6). These are the
    models of OpenCV and COLMAP, after Brown (1966), Weng et al. (1992) and Kannala & Brandt (2006). A panorama has the
    forward direction in its middle and covers 360 degrees across and 180 down.

    Raises `IntrinsicsError` where a number is NaN, infinite or impossible, or the distortion cannot be undone: not
    every pixel of the largest circle around the middle of the image has its own ray. In the corners beyond it, that may
    be.
    """

    model: LensModel  # one of `LENS_MODELS`
    width: int  # of the image, in pixels
    height: int
    focal: tuple[float, float] = (1.0, 1.0)  # focal lengths along x and y, in pixels; a panorama has none
    principal: tuple[float, float] = (0.0, 0.0)  # principal point, x and y in pixels; a panorama has none
    coefficients: tuple[float, ...] = ()  # in the order of the model; those that are left out are 0

    def __post_init__(self) -> None:
        """Validate."""
        if flaw := self._flaw():
            given = ", ".join(f"{name} = {value:g}" for name, value in self._named.items()) or "no coefficients"
            raise IntrinsicsError(f"lens {self.model.name} ({clipped(given, 160)}): {flaw}")

    @property
    def reach(self) -> float:
        """Angle to the optical axis, in radians, up to which a ray lands the farther out the larger its angle is."""
        return float(_profile(self)[0][-1])

    def project(self, rays: Floats) -> Floats:  # (..., 3)
        """Find the pixels (..., 2) in which rays of any length land; NaN for those beyond the lens's reach."""
        x, y, z = rays[..., 0], rays[..., 1], rays[..., 2]
        if self.model.projection is Projection.PANORAMA:
            turn, fall = np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))
            # What lies exactly behind is on both edges, and what lies exactly below on the last one: both in the image.
            column, row = (turn / (2 * np.pi) + 0.5) % 1 * self.width, (fall / np.pi + 0.5) * self.height
            return np.stack([column, np.minimum(row, np.nextafter(float(self.height), 0))], axis=-1)
        across = np.hypot(x, y)
        angle = np.arctan2(across, z)
        with np.errstate(all="ignore"):
            scale = np.where(across > 0, self._radius(angle) / across, 1 / z)
            landed = self._distorted(rays[..., :2] * scale[..., None])
        return np.where((angle <= self.reach)[..., None], landed * self.focal + self.principal, np.nan)

    def rays(self, pixels: Floats) -> Floats:  # (..., 2)
        """Find the rays (..., 3) of length 1 that land in pixels, by Newton's method; NaN where none does."""
        if self.model.projection is Projection.PANORAMA:
            turn, fall = np.moveaxis((pixels / (self.width, self.height) - 0.5) * (2 * np.pi, np.pi), -1, 0)
            return np.stack([np.cos(fall) * np.sin(turn), np.sin(fall), np.cos(fall) * np.cos(turn)], axis=-1)
        wanted = (pixels - self.principal) / self.focal
        with np.errstate(all="ignore"):
            place = self._undistorted(wanted)
            radius = np.hypot(place[..., 0], place[..., 1])
            angle = radius if self.model.projection is Projection.FISHEYE else np.arctan(radius)
            sideways = place * np.where(radius > 0, np.sin(angle) / radius, 1.0)[..., None]
            off = np.abs(self._distorted(place) - wanted).max(axis=-1) * max(self.focal)
        found = (angle <= self.reach) & (off < _TOLERANCE_PX)
        return np.where(found[..., None], np.concatenate([sideways, np.cos(angle)[..., None]], axis=-1), np.nan)

    @cached_property
    def _named(self) -> dict[str, float]:
        return dict(zip(self.model.coefficients, self.coefficients, strict=False))

    def _radius(self, angle: Floats) -> Floats:
        """Distance from the principal point at which rays land undistorted, in focal lengths."""
        return angle if self.model.projection is Projection.FISHEYE else np.tan(angle)

    def _radial(self, squared: Floats) -> Floats:
        ks = [self._named.get(f"k{i}", 0.0) for i in range(1, 7)]
        above, below = (ks[:3], ks[3:]) if self.model.rational else (ks[:4], [])
        return np.polyval([*above[::-1], 1.0], squared) / np.polyval([*below[::-1], 1.0], squared)

    def _distorted(self, place: Floats) -> Floats:  # (..., 2)
        u, v = place[..., 0], place[..., 1]
        p1, p2, s1, s2 = (self._named.get(name, 0.0) for name in ("p1", "p2", "sx1", "sy1"))
        squared, q = u * u + v * v, self._radial(u * u + v * v)
        du = 2 * p1 * u * v + p2 * (squared + 2 * u * u) + s1 * squared
        dv = 2 * p2 * u * v + p1 * (squared + 2 * v * v) + s2 * squared
        return np.stack([u * q + du, v * q + dv], axis=-1)

    def _undistorted(self, wanted: Floats) -> Floats:  # (..., 2)
        angles, radii = _profile(self)
        out = np.hypot(wanted[..., 0], wanted[..., 1])
        start = self._radius(np.interp(out, radii, angles))
        place = wanted * np.where(out > 0, start / out, 1.0)[..., None]
        for _ in range(_NEWTON_STEPS):
            here = self._distorted(place)
            a, b = ((self._distorted(place + step) - here) / _DIFFERENCE for step in np.eye(2) * _DIFFERENCE)
            off, area = here - wanted, _cross(a, b)
            place = place - np.stack([_cross(off, b) / area, _cross(a, off) / area], axis=-1)
        return place

    def _flaw(self) -> str:
        """Say what is wrong with the numbers, or "" if the lens can be undone."""
        if not np.isfinite([*self.focal, *self.principal, *self.coefficients]).all():
            return f"focal lengths {self.focal}, principal point {self.principal}; expected finite numbers everywhere"
        if min(self.focal) <= 0:
            return f"focal lengths are {self.focal[0]:g} and {self.focal[1]:g}; expected positive pixels"
        size = np.array([self.width, self.height])
        if size.min() < 1:
            return f"images are {self.width} x {self.height} pixels; expected at least 1 x 1"
        check_pixels(self.width, self.height, f"lens {self.model.name}", IntrinsicsError)
        turns = np.linspace(0, 2 * np.pi, _CHECKED)
        spokes = np.stack([np.cos(turns), np.sin(turns)], axis=-1) * np.linspace(0, 1, _CHECKED)[:, None, None]
        checked = size / 2 + spokes * size.min() / 2  # (radii, turns, 2)
        undone = (np.abs(self.project(self.rays(checked)) - checked) < 2 * _TOLERANCE_PX).all(axis=(1, 2))
        if not undone.all():
            radius = size.min() / 2
            return (
                f"its distortion cannot be undone {np.argmin(undone) / (_CHECKED - 1) * radius:.0f} pixels from the "
                f"middle of images of {self.width} x {self.height}; expected to within {radius:g} pixels: is it "
                "calibrated for this size?"
            )
        return ""


@lru_cache(maxsize=64)
def _profile(lens: Lens) -> tuple[Floats, Floats]:
    """Angles from 0 to the reach of a lens, and the radii, in focal lengths, at which radial distortion puts them."""
    widest = math.pi if lens.model.projection is Projection.FISHEYE else _WIDEST_PERSPECTIVE
    angles = np.linspace(0, widest, _PROFILE_STEPS)
    with np.errstate(all="ignore"):
        radii = lens._radius(angles) * lens._radial(lens._radius(angles) ** 2)
        shrinks = np.flatnonzero(~(np.diff(radii) > 0))
    count = int(shrinks[0]) + 1 if len(shrinks) else _PROFILE_STEPS
    return angles[:count], radii[:count]


def _cross(a: Floats, b: Floats) -> Floats:  # (..., 2)
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
