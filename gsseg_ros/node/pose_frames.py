"""Takes poses from the frames that messages name to those that are wanted: from the map to a camera (REP 105)."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from gsseg_ros.node.pose_sources import GivenPose, Pose


class Transforms(Protocol):
    """What TF knows."""

    def look_up(self, frame_id: str, stamp: int, within: str = "") -> Pose | None:
        """Look up the pose (4, 4) of a frame in another, the map if none is named; None if not known (yet)."""

    def set_back(self, before: int, began: int) -> None:
        """Forget what is from before time was set back from `before` to `began` (ns)."""


class PoseFrames:
    """Composes a pose with what lies between its frame and the map, and between its child frame and the camera.

    Parameters
    ----------
    map_frame : str
        Where poses are wanted.
    transforms : Transforms, optional
        Without, poses must be in the map.
    camera_in_base : ndarray (4, 4), optional
        The camera's optical frame in the child frame of every pose; without, poses of another frame than the camera's
        need `transforms`.
    """

    def __init__(
        self, map_frame: str, transforms: Transforms | None = None, camera_in_base: Pose | None = None
    ) -> None:
        self._map_frame, self._transforms, self._camera_in_base = map_frame, transforms, camera_in_base

    @property
    def tells_apart(self) -> bool:
        """Whether it knows where on the robot each camera is."""
        return self._transforms is not None and self._camera_in_base is None

    def reaches_map(self, frame_id: str) -> bool:
        """Whether poses in a frame can be used, now or once TF knows it."""
        return frame_id in ("", self._map_frame) or self._transforms is not None

    def camera_in_map(self, given: GivenPose, stamp: int, frame_id: str) -> Pose | None:
        """Pose (4, 4) in the map of the camera `frame_id`, of a pose at `stamp` (ns); None if it is not known (yet)."""
        to_map = self._known(given.frame_id, "", stamp) if given.frame_id not in ("", self._map_frame) else np.eye(4)
        camera = self._camera_in(given.child_frame_id, frame_id, stamp)
        return None if to_map is None or camera is None else to_map @ given.matrix @ camera

    def set_back(self, before: int, began: int) -> None:
        """Forget the transforms from before time was set back from `before` to `began` (ns)."""
        if self._transforms is not None:
            self._transforms.set_back(before, began)

    def _camera_in(self, child: str, frame_id: str, stamp: int) -> Pose | None:
        if child and child == frame_id:  # The pose is the camera's own.
            return np.eye(4)
        if self._camera_in_base is not None:
            return self._camera_in_base
        # Without the two names nothing could be looked up: it is meant to be the camera's.
        return self._known(frame_id, child, stamp) if child and frame_id else np.eye(4)

    def _known(self, frame_id: str, within: str, stamp: int) -> Pose | None:
        # To TF a stamp of zero means "the latest", which belongs to another image.
        return self._transforms.look_up(frame_id, stamp, within) if self._transforms is not None and stamp > 0 else None
