"""Similarities: how one frame of reference lies in another, by a scale, a rotation and a translation."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from gsseg_core.scene.camera import Camera, rigid_motion


@dataclass(frozen=True, eq=False)
class Similarity:
    """The map x -> scale * rotation @ x + translation from one frame to another; by default the identity.

    Attributes
    ----------
    scale : float
        Units of the second frame per unit of the first, > 0.
    rotation : (3, 3) float64
        Orthonormal, of determinant 1.
    translation : (3,) float64
        Where the first frame's origin lies, in units of the second frame.
    """

    scale: float = 1.0
    rotation: npt.NDArray[np.float64] = field(default_factory=lambda: np.eye(3))  # (3, 3)
    translation: npt.NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))  # (3,)

    def __eq__(self, other: object) -> bool:
        """Whether two are the same, number by number."""
        return self is other or (
            isinstance(other, Similarity)
            and self.scale == other.scale
            and np.array_equal(self.rotation, other.rotation)
            and np.array_equal(self.translation, other.translation)
        )

    def points(self, points: npt.NDArray[Any]) -> npt.NDArray[np.float64]:  # (..., 3)
        """Map points (..., 3) from the first frame to the second."""
        return self.scale * (points @ self.rotation.T) + self.translation

    def camera(self, camera: Camera) -> Camera:
        """Move a camera of the first frame to the second; what it sees of moved points is what it saw of the points."""
        rotation = camera.world_to_camera[:3, :3] @ self.rotation.T
        pose = rigid_motion(rotation, -rotation @ self.points(camera.center))
        return replace(camera, world_to_camera=pose)

    def after(self, first: Similarity) -> Similarity:
        """Compose: map by `first`, and then by this one."""
        return Similarity(self.scale * first.scale, self.rotation @ first.rotation, self.points(first.translation))

    def inverse(self) -> Similarity:
        """Map from the second frame to the first."""
        rotation = self.rotation.T
        return Similarity(1 / self.scale, rotation, -(rotation @ self.translation) / self.scale)
