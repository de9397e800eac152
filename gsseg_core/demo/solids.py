"""Solids that rays can be cast at and points drawn from; what the demo scene is made of.

Every solid has a frame of its own, in metres. For a ray beside a surface, or along it, divisions give NaN or infinity,
which never count as a hit; callers silence the warnings.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

WALL = 0.005  # m, thickness of a cup's wall and base


@dataclass(frozen=True)
class Ellipsoid:
    """Centre at the origin; radii along the axes, nearly equal."""

    radii: tuple[float, float, float]

    @cached_property
    def corners(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest corner (3,) of the bounding box."""
        return -np.array(self.radii), np.array(self.radii)

    @cached_property
    def area(self) -> float:
        """Surface of the sphere of the mean radius, in square metres."""
        return 4 * np.pi * float(np.mean(self.radii)) ** 2

    def hit(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Distances (M,) along rays, in lengths of `directions` (M, 3); infinite for rays that miss."""
        o, d = origins / self.radii, directions / self.radii
        near, far = _roots(dot(d, d), dot(o, d), dot(o, o) - 1)
        return _nearest((near, True), (far, True))

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Which points (M, 3) are in its matter, (M,) bool."""
        return dot(points / self.radii, points / self.radii) <= 1

    def sample(self, u: np.ndarray, inset: float) -> tuple[np.ndarray, np.ndarray]:
        """Surface points (M, 3), `inset` metres off sharp edges, and unit normals (M, 3), from (M, 3) in [0, 1)."""
        z, angle = 2 * u[:, 0] - 1, 2 * np.pi * u[:, 1]
        unit = np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], axis=1)
        normals = unit / self.radii
        return unit * self.radii, normals / np.linalg.norm(normals, axis=1, keepdims=True)


@dataclass(frozen=True)
class Box:
    """Standing on the middle of its bottom face, which is the origin."""

    size: tuple[float, float, float]

    @cached_property
    def corners(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest corner."""
        x, y, z = self.size
        return np.array([-x / 2, -y / 2, 0]), np.array([x / 2, y / 2, z])

    @cached_property
    def area(self) -> float:
        """Surface of the six faces."""
        x, y, z = self.size
        return 2 * (x * y + y * z + z * x)

    def hit(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Distances along rays, which start outside."""
        low, high = self.corners
        to_low, to_high = (low - origins) / directions, (high - origins) / directions
        enter, leave = np.minimum(to_low, to_high).max(axis=-1), np.maximum(to_low, to_high).min(axis=-1)
        return _nearest((enter, enter <= leave))

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Which points are inside."""
        low, high = self.corners
        return np.all((points >= low) & (points <= high), axis=-1)

    def sample(self, u: np.ndarray, inset: float) -> tuple[np.ndarray, np.ndarray]:
        """Surface points and normals."""
        low, high = self.corners
        x, y, z = self.size
        face_areas = np.array([y * z, z * x, x * y])
        scaled = u[:, 2] * 2
        axis = np.searchsorted(np.cumsum(face_areas)[:2] / face_areas.sum(), scaled % 1)
        rows, side = np.arange(len(u)), scaled >= 1
        points = np.empty((len(u), 3))
        border = np.minimum(inset / (high - low), 0.4)
        for turn in (1, 2):
            other = (axis + turn) % 3
            points[rows, other] = border[other] + u[:, turn - 1] * (1 - 2 * border[other])
        points[rows, axis] = side
        normals = np.zeros((len(u), 3))
        normals[rows, axis] = np.where(side, 1, -1)
        return low + points * (high - low), normals


@dataclass(frozen=True)
class Cone:
    """Truncated cone standing on the middle of its bottom disc, which is the origin; `hollow` makes it a cup."""

    bottom: float
    top: float
    height: float
    hollow: bool = False

    @cached_property
    def corners(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest corner."""
        r = max(self.bottom, self.top)
        return np.array([-r, -r, 0]), np.array([r, r, self.height])

    @cached_property
    def area(self) -> float:
        """Surface of side and discs, of a cup inside and outside."""
        return float(np.sum(self._areas))

    @cached_property
    def _areas(self) -> np.ndarray:
        """Of the outer side, the base, and the lid or, of a cup, the inner side; m^2."""
        side = np.pi * (self.bottom + self.top) * np.hypot(self.height, self.top - self.bottom)
        return np.array([side, np.pi * self.bottom**2, side if self.hollow else np.pi * self.top**2])

    @cached_property
    def _slope(self) -> float:
        return (self.top - self.bottom) / self.height

    def hit(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Distances along rays."""
        o, oz, d, dz = origins[..., :2], origins[..., 2], directions[..., :2], directions[..., 2]
        radius = self.bottom + self._slope * oz
        rise = self._slope * dz
        hits = []
        for t in _roots(dot(d, d) - rise**2, dot(o, d) - rise * radius, dot(o, o) - radius**2):
            z = oz + t * dz
            hits.append((t, (z >= 0) & (z <= self.height)))
        lids = [(0, self.bottom), (self.height, self.top)]
        for z, r in [(WALL, self.bottom + self._slope * WALL)] if self.hollow else lids:
            t = (z - oz) / dz
            p = o + t[..., None] * d
            hits.append((t, dot(p, p) <= r * r))
        return _nearest(*hits)

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Which points are inside; of a cup, in its wall or its base."""
        z, radius = points[..., 2], np.hypot(points[..., 0], points[..., 1])
        outer = self.bottom + self._slope * z
        inside: np.ndarray = (z >= 0) & (z <= self.height) & (radius <= outer)
        return inside & ((z <= WALL) | (radius >= outer - WALL)) if self.hollow else inside

    def sample(self, u: np.ndarray, inset: float) -> tuple[np.ndarray, np.ndarray]:
        """Surface points and normals."""
        where = np.searchsorted(np.cumsum(self._areas)[:2] / self.area, u[:, 2])
        base, inner = where == 1, (where == 2) & self.hollow
        side = (where == 0) | inner
        share = u[:, 0] * (self.bottom + self.top)
        share /= self.bottom + np.sqrt(self.bottom**2 + u[:, 0] * (self.top**2 - self.bottom**2))  # even per area
        border = min(inset / self.height, 0.4)
        z = self.height * np.where(side, border + share * (1 - 2 * border), ~base)
        z[base & self.hollow] = WALL
        radius = np.where(
            side,
            self.bottom + self._slope * z - WALL * inner,
            np.sqrt(u[:, 0]) * np.maximum(np.where(base, self.bottom, self.top) - inset, 0),
        )
        around = np.stack([np.cos(2 * np.pi * u[:, 1]), np.sin(2 * np.pi * u[:, 1])], axis=1)
        normals = np.zeros((len(u), 3))
        normals[:, 2] = np.where(side, -self._slope, np.where(base & (not self.hollow), -1, 1))
        normals[side, :2] = around[side]
        normals[inner] *= -1
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return np.column_stack([radius[:, None] * around, z]), normals


Solid = Ellipsoid | Box | Cone


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Scalar products along the last axis."""
    return np.einsum("...i,...i->...", a, b)


def _roots(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both solutions of a t^2 + 2 b t + c = 0, NaN where there are none."""
    root = np.sqrt(b * b - a * c)
    return (-b - root) / a, (-b + root) / a


def _nearest(*hits: tuple[np.ndarray, np.ndarray | bool]) -> np.ndarray:
    """Smallest of several distances that is ahead and marked as a hit; infinite where there is none."""
    return np.min([np.where((t > 1e-6) & ok, t, np.inf) for t, ok in hits], axis=0)
