"""Conventions of poses: which way axes point, of the world and of cameras, and which way a pose leads.

Trainers and apps disagree on three things that no file says: whether the world's up is y or z, or any other of its 24
right-handed systems of axes; whether a camera looks along its z axis, x right, y down (OpenCV), against it (OpenGL), or
along another; and whether a pose leads from camera to world or back. A pose M, camera-to-world as it was read, is then

    A M B  or  A M^-1 B,    A and B among the 24 rotations that map axes to axes,

and all 1152 are tried. Each is compared with one view after another, and only the best go on to the next view. Those
that differ by a quarter turn about the optical axis share a rendering, which is turned. What counts is how much better
a view agrees than it does upside down: from a wrong place, much agrees equally well both ways.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import permutations, product
from typing import Any

import numpy as np

from gsseg_core.align.agreement import Pictures, Shown, render
from gsseg_core.align.settings import AlignSettings
from gsseg_core.progress import Progress, silent, with_progress
from gsseg_core.scene.camera import Camera, rigid_motion
from gsseg_core.scene.scene_delta import similarity_entry
from gsseg_core.scene.similarity import Similarity

_NAMES = "xyz"
_QUARTER = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # about the optical axis
_LEAST = 6  # conventions that are compared with every view


def _axis_rotations() -> list[np.ndarray]:
    """List the 24 rotations that map axes to axes, those that change least first."""
    signed = (
        np.eye(3)[list(order)] * np.array(signs)[:, None]
        for order, signs in product(permutations(range(3)), product((1, -1), repeat=3))
    )
    return sorted((axes for axes in signed if np.linalg.det(axes) > 0), key=lambda axes: -float(np.trace(axes)))


AXIS_ROTATIONS = _axis_rotations()
OPENGL = np.diag([1.0, -1, -1])
_WAYS = np.concatenate([np.eye(3), -np.eye(3)])[[2, 5, 0, 1, 3, 4]]  # forward and backward first
_LOOKING = [
    next(axes for axes in (np.eye(3), OPENGL, *AXIS_ROTATIONS) if np.array_equal(axes[:, 2], way)) for way in _WAYS
]
"""For each way along an axis, the rotation B of a camera that looks there."""


@dataclass(frozen=True, eq=False)
class Convention:
    """How poses are to be understood; by default, as they were read.

    Columns of A are the cameras' world axes in the scene; those of B are axes x right, y down, z forward in those of
    the cameras as they were read.
    """

    inverted: bool = False  # whether what was read as camera-to-world leads from the world to the camera
    world_axes: np.ndarray = field(default_factory=lambda: np.eye(3))  # (3, 3): A
    camera_axes: np.ndarray = field(default_factory=lambda: np.eye(3))  # (3, 3): B

    def camera(self, camera: Camera) -> Camera:
        """Pose a camera as it was meant."""
        pose = camera.world_to_camera
        if self.inverted:
            pose = rigid_motion(pose[:3, :3].T, camera.center)
        rotation = self.camera_axes.T @ pose[:3, :3] @ self.world_axes.T
        return replace(camera, world_to_camera=rigid_motion(rotation, self.camera_axes.T @ pose[:3, 3]))

    @property
    def parts(self) -> list[str]:
        """What differs from what was read, for people."""
        parts = ["poses lead from the world to the camera, not back"] if self.inverted else []
        if not np.array_equal(self.camera_axes, np.eye(3)):
            known = ", as in OpenGL" if np.array_equal(self.camera_axes, OPENGL) else ""
            x, y, z = _named(self.camera_axes)
            parts.append(f"cameras have x right, y down, z forward along their {x}, {y}, {z}{known}")
        if not np.array_equal(self.world_axes, np.eye(3)):
            parts.append(f"x, y, z of the cameras' world are {', '.join(_named(self.world_axes))} of the scene")
        return parts


@dataclass(frozen=True, eq=False)
class Alignment:
    """How a dataset's cameras come into a scene: the convention of their poses, then a similarity."""

    convention: Convention = field(default_factory=Convention)  # how poses are to be understood
    similarity: Similarity = field(default_factory=Similarity)  # from the frame that they are then in to the scene's

    def camera(self, camera: Camera) -> Camera:
        """Pose a camera of the dataset in the scene."""
        return self.similarity.camera(self.convention.camera(camera))

    @property
    def parts(self) -> list[str]:
        """What was found, for people; nothing where cameras are in the scene's frame as they are."""
        from scipy.spatial.transform import Rotation  # It takes a while to load, and most cameras fit as they are.

        found, parts = self.similarity, self.convention.parts
        turn = Rotation.from_matrix(found.rotation).as_rotvec(degrees=True)
        if abs(found.scale - 1) > 1e-9:
            parts.append(f"scale {found.scale:.6g}")
        if (angle := float(np.linalg.norm(turn))) > 1e-6:
            axis = ", ".join(f"{part:.4f}" for part in turn / angle)
            parts.append(f"rotation by {angle:.4g} degrees about ({axis})")
        if np.abs(found.translation).max() > 1e-9:
            parts.append(f"translation ({', '.join(f'{part:.6g}' for part in found.translation)})")
        return parts

    def as_dict(self) -> dict[str, Any]:
        """Give it as `report.json` does; rotations and axes are 3 x 3, row by row."""
        return {
            "inverted": self.convention.inverted,
            "world_axes": self.convention.world_axes.tolist(),
            "camera_axes": self.convention.camera_axes.tolist(),
            **similarity_entry(self.similarity),
        }


def find_convention(
    pictures: Pictures, shown: Sequence[Shown], settings: AlignSettings, progress: Progress = silent
) -> Convention:
    """Find the convention that agrees best with some views, at least one."""
    every = product(_LOOKING, (False, True), AXIS_ROTATIONS)
    tried = [Convention(inverted, world, looking) for looking, inverted, world in every]
    scores = np.zeros((len(tried), 4))  # by quarter turns of the camera
    left = list(range(len(tried)))
    for number, view in enumerate(shown):
        for i in with_progress(progress, f"try conventions on view {number + 1} of {len(shown)}", left):
            rendered = render(pictures.few, tried[i].camera(view.camera), pictures.device)
            turned = np.array([view.score(rendered.turned(quarters)) for quarters in range(4)])
            scores[i] += turned - np.roll(turned, 2)  # less the score upside down
        kept = max(_LEAST, round(settings.survivors * len(left)))
        left = sorted(left, key=lambda i: -float(scores[i].max()))[:kept]
    best = max(left, key=lambda i: float(scores[i].max()))
    turn = np.linalg.matrix_power(_QUARTER, int(scores[best].argmax()))
    return replace(tried[best], camera_axes=tried[best].camera_axes @ turn)


def _named(axes: np.ndarray) -> list[str]:  # (3, 3)
    """Name the columns of a rotation that maps axes to axes: 'x', '-z' and so on."""
    places = np.abs(axes).argmax(axis=0)
    return [("-" if axes[place, column] < 0 else "") + _NAMES[place] for column, place in enumerate(places)]
