"""Rigid motions, quaternions, and the similarity between a scene and the map that the robot drives in.

Rigid motions are (4, 4) float64. Quaternions are x, y, z, w, as in ROS messages; those of Gaussians are w, x, y, z.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from gsseg_core.errors import SettingsError
from gsseg_core.files.limits import LIMITS
from gsseg_core.objects.oriented_boxes import OrientedBox
from gsseg_core.scene import similarity
from gsseg_core.scene.camera import rigid_motion
from gsseg_core.scene.quaternions import rotations

Array: TypeAlias = npt.NDArray[np.float64]
Quaternion: TypeAlias = tuple[float, float, float, float]


class Similarity(similarity.Similarity):
    """Where the scene lies in the map, in metres: map = scale * rotation @ scene + translation."""

    @classmethod
    def from_parameters(
        cls,
        scale: float,
        translation: Sequence[float],  # (3,)
        quaternion_xyzw: Sequence[float],  # (4,)
    ) -> Similarity:
        """Build it from the parameters `scene_to_map.scale`, `.translation` (metres) and `.rotation` (any length).

        Raises `SettingsError`: a number is missing, NaN or infinite, the scale is not positive, or the quaternion is
        zero.
        """
        if not (np.isfinite(scale) and scale > 0):
            raise SettingsError(f"scene_to_map.scale is {scale:g}; expected a positive number of metres per scene unit")
        pose = pose_from_parameters("scene_to_map", translation, quaternion_xyzw)
        return cls(float(scale), pose[:3, :3], pose[:3, 3])

    def points_to_map(
        self,
        points: npt.ArrayLike,  # (M, 3)
    ) -> npt.NDArray[np.float32]:
        """Move points (M, 3) of the scene, in scene units, into the map: (M, 3) float32, in metres."""
        return self.points(np.asarray(points, np.float64)).astype(np.float32)

    def box_to_map(self, box: OrientedBox) -> OrientedBox:
        """Move the box of an object in the scene, in scene units, into the map, in metres."""
        return box.moved(self.rotation, self.translation, self.scale)

    def world_to_camera(
        self,
        camera_in_map: npt.ArrayLike,  # (4, 4)
    ) -> Array:
        """Turn a camera's pose in the map, in metres, into its `world_to_camera` (4, 4) in the scene, in scene units.

        The rotation stays one: the scale goes into the translation alone.
        """
        pose = np.asarray(camera_in_map, np.float64)
        center = self.rotation.T @ (pose[:3, 3] - self.translation) / self.scale
        return inverse(rigid_motion(self.rotation.T @ pose[:3, :3], center))

    def camera_in_map(
        self,
        world_to_camera: npt.ArrayLike,  # (4, 4)
    ) -> Array:
        """Turn a camera of the scene into its pose (4, 4) in the map, in metres: undoes `world_to_camera`."""
        pose = inverse(np.asarray(world_to_camera, np.float64))
        return rigid_motion(self.rotation @ pose[:3, :3], self.points(pose[:3, 3]))


def pose_from_parameters(
    name: str,
    translation: Sequence[float],  # (3,)
    quaternion_xyzw: Sequence[float],  # (4,)
) -> Array:
    """Build a rigid motion (4, 4) from the parameters `<name>.translation` (metres) and `<name>.rotation` (any length).

    Raises `SettingsError`: a number is missing, NaN or infinite, the quaternion zero, or the translation too large; the
    message names the parameter.
    """
    for part, values, size in (("translation", translation, 3), ("rotation", quaternion_xyzw, 4)):
        if len(values) != size or not np.isfinite(values).all():
            raise SettingsError(f"{name}.{part} is {list(values)}; expected {size} finite numbers")
    if np.abs(translation).max() > LIMITS.max_value:
        raise SettingsError(f"{name}.translation is {list(translation)}; expected metres, at most {LIMITS.max_value:g}")
    if not any(quaternion_xyzw):
        raise SettingsError(f"{name}.rotation is all zeros; expected a quaternion x y z w, [0, 0, 0, 1] for none")
    x, y, z, w = quaternion_xyzw
    return rigid_motion(rotation_from_quaternion(x, y, z, w), translation)


def inverse(
    pose: Array,  # (4, 4)
) -> Array:
    """Invert a rigid motion (4, 4)."""
    return rigid_motion(pose[:3, :3].T, -pose[:3, :3].T @ pose[:3, 3])


def rotation_from_quaternion(x: float, y: float, z: float, w: float) -> Array:
    """Turn a quaternion of any length but zero into a rotation matrix (3, 3)."""
    q = np.array([x, y, z, w], np.float64)
    q /= abs(q).max()  # First, so that no square over- or underflows.
    rotation: Array = rotations(np.roll(q / np.linalg.norm(q), 1)[None])[0]  # w comes first there
    return rotation


def quaternion_from_rotation(
    rotation: npt.ArrayLike,  # (3, 3)
) -> Quaternion:
    """Turn a rotation matrix (3, 3) into its unit quaternion x, y, z, w with w >= 0."""
    (a, b, c), (d, e, f), (g, h, i) = np.asarray(rotation, np.float64)
    # Four times the outer product of the quaternion with itself. Every row is the quaternion up to its length; the one
    # with the largest diagonal loses no digits.
    products = np.array(
        [
            [1 + a - e - i, b + d, c + g, h - f],
            [b + d, 1 - a + e - i, f + h, c - g],
            [c + g, f + h, 1 - a - e + i, d - b],
            [h - f, c - g, d - b, 1 + a + e + i],
        ]
    )
    q = products[np.diagonal(products).argmax()]
    x, y, z, w = (q / np.copysign(np.linalg.norm(q), q[3])).tolist()
    return x, y, z, w


def interpolate(
    pose_a: Array,  # (4, 4)
    pose_b: Array,  # (4, 4)
    share: float,
) -> Array:
    """Interpolate between two rigid motions (4, 4): `share` 0 gives the first, 1 the second.

    The translation moves along a line, the rotation about one axis at constant speed (slerp), the shorter way round.
    """
    a, b = (np.array(quaternion_from_rotation(pose[:3, :3])) for pose in (pose_a, pose_b))
    if a @ b < 0:
        b = -b  # The same rotation, and the shorter way to it.
    angle = 2 * np.arctan2(np.linalg.norm(b - a), np.linalg.norm(b + a))
    # np.sinc(t) is sin(pi t) / (pi t), which stays exact where the angle is zero.
    share_a, share_b = ((s * np.sinc(s * angle / np.pi) / np.sinc(angle / np.pi)) for s in (1 - share, share))
    x, y, z, w = share_a * a + share_b * b
    translation = (1 - share) * pose_a[:3, 3] + share * pose_b[:3, 3]
    return rigid_motion(rotation_from_quaternion(x, y, z, w), translation)
