"""Poses of cameras in the map at the stamps of their masks: of exactly that stamp, of those around it, or of TF first.

Nothing here knows ROS; `gsseg_ros.node.tf_poses` has the poses that TF knows.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, replace
from typing import Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

from gsseg_ros.frames import interpolate
from gsseg_ros.node.history import History
from gsseg_ros.node.timeline import BEHIND_NS, SECOND

Pose: TypeAlias = npt.NDArray[np.float64]  # (4, 4)

_POSES_KEPT = 10_000  # At 1 kHz, those of ten seconds.


@dataclass(frozen=True, eq=False)
class GivenPose:
    """A pose as a message gives it."""

    matrix: Pose  # (4, 4): from the child frame to the frame, in metres
    frame_id: str = ""  # frame that it is in; "" for the map
    child_frame_id: str = ""  # frame whose pose it is; "" for one that is not named


class Transforms(Protocol):
    """What TF knows."""

    def look_up(self, frame_id: str, stamp: int, within: str = "") -> Pose | None:
        """Look up the pose (4, 4) of a frame in another, the map if none is named; None if not known (yet)."""

    def set_back(self, before: int, began: int) -> None:
        """Forget what is from before time was set back from `before` to `began` (ns)."""


class PoseFrames:
    """Composes a pose with what lies between its frame and the map, and between its child frame and the camera.

    Without `transforms`, poses must be in the map; without `camera_in_base`, the camera's optical frame in the child
    frame of every pose, poses of another frame than the camera's need them.
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


class PoseSource(Protocol):
    """Source of the poses of cameras in the map."""

    knows_frames: bool  # whether it may tell cameras apart, by the frame_id of their masks

    def at(self, stamp: int, frame_id: str = "", last_chance: bool = False, several: bool = False) -> Pose | None:
        """Find the pose (4, 4) at `stamp` of the camera whose masks carry `frame_id`; None if not known (yet).

        With `last_chance`, nothing more is waited for. With `several`, other cameras have masks of this stamp, and only
        a pose will do that is known to be of this one.
        """

    def too_late(self, stamp: int) -> bool:
        """Whether no pose for `stamp` can come any more; False where that cannot be told."""
        return False

    def refused(self, stamp: int) -> bool:
        """Whether the pose of `stamp` came, and cannot be used; False where that cannot be told."""
        return False

    def set_back(self, before: int, began: int) -> None:
        """Forget what is from before time was set back from `before` to `began` (ns)."""


class MessagePoses:
    """Poses from messages: that of exactly a mask's stamp, or those close enough to it.

    A pose may lie so many seconds before or after the mask. Between one before and one after, it is interpolated; where
    only one of them is as close, that one is taken. Without `frames`, poses are those of cameras in the map.
    """

    knows_frames = False  # A message does not say of which camera it is.

    def __init__(self, tolerance_s: float = 0.0, frames: PoseFrames | None = None) -> None:
        self._poses: History[int, GivenPose] = History(_POSES_KEPT)
        self._refused: History[int, None] = History(_POSES_KEPT)
        self._tolerance_ns, self._frames = round(tolerance_s * SECOND), frames
        self._bridges = self._tolerance_ns > 0  # Whether others may serve where one is missing.

    def add(self, stamp: int, given: GivenPose) -> None:
        """Keep the pose of a stamp; of two with the same stamp the first stays."""
        self._poses.add(stamp, given)

    def refuse(self, stamp: int) -> None:
        """Note that the pose of a stamp cannot be used."""
        self._refused.add(stamp, None)

    def refused(self, stamp: int) -> bool:
        """Whether the pose of `stamp` came, and cannot be used."""
        return stamp in self._refused.values

    def at(self, stamp: int, frame_id: str = "", last_chance: bool = False, several: bool = False) -> Pose | None:
        """Find the pose (4, 4) as `PoseSource` says."""
        given = self._given(stamp, last_chance)
        if given is None or (several and not (self.knows_frames and given.child_frame_id and frame_id)):
            return None
        return given.matrix if self._frames is None else self._frames.camera_in_map(given, stamp, frame_id)

    def too_late(self, stamp: int) -> bool:
        """Whether the poses have gone on from `stamp` by more than they come out of order, or its own was refused."""
        went_on = bool(self._poses.stamps) and self._poses.stamps[-1] >= stamp + BEHIND_NS + self._tolerance_ns
        over = went_on or (self.refused(stamp) and not self._bridges)
        return over and self._given(stamp, True) is None

    def set_back(self, before: int, began: int) -> None:
        """Forget all poses, and what the frames know from before time was set back."""
        self._poses.clear()
        self._refused.clear()
        if self._frames is not None:
            self._frames.set_back(before, began)

    def _given(self, stamp: int, last_chance: bool) -> GivenPose | None:
        """Find the pose of a stamp, as messages gave it; None if it is not there (yet)."""
        exact, stamps = self._poses.values.get(stamp), self._poses.stamps
        after = bisect_left(stamps, stamp)
        if exact is not None or not self._tolerance_ns or not (last_chance or after < len(stamps)):
            return exact
        near = [s for s in stamps[max(after - 1, 0) : after + 1] if abs(s - stamp) <= self._tolerance_ns]
        if len(near) == 2:
            return self._between(near[0], near[1], stamp)
        return self._poses.values[near[0]] if near else None

    def _between(self, earlier: int, later: int, stamp: int) -> GivenPose | None:
        """Interpolate; None between poses in different frames, or of different ones."""
        a, b = self._poses.values[earlier], self._poses.values[later]
        if (a.frame_id, a.child_frame_id) != (b.frame_id, b.child_frame_id):
            return None
        return replace(a, matrix=interpolate(a.matrix, b.matrix, (stamp - earlier) / (later - earlier)))


class InterpolatedPoses(MessagePoses):
    """Poses of an odometry, which runs at its own rate: between the two that bracket a mask's stamp.

    The two may be so many seconds apart.
    """

    def __init__(self, max_gap_s: float = 0.2, frames: PoseFrames | None = None) -> None:
        super().__init__(0.0, frames)
        self._max_gap_ns, self._bridges = round(max_gap_s * SECOND), True
        self.knows_frames = frames is not None and frames.tells_apart

    def _given(self, stamp: int, last_chance: bool) -> GivenPose | None:
        exact, stamps = self._poses.values.get(stamp), self._poses.stamps
        after = bisect_left(stamps, stamp)
        if exact is not None or not 0 < after < len(stamps):
            return exact
        earlier, later = stamps[after - 1], stamps[after]
        return None if later - earlier > self._max_gap_ns else self._between(earlier, later, stamp)


class TfFirst(MessagePoses):
    """Poses that TF knows at the mask's stamp, and else those of messages."""

    knows_frames = True  # TF is asked alone where that matters.

    def __init__(self, tf: PoseSource, tolerance_s: float = 0.0, frames: PoseFrames | None = None) -> None:
        super().__init__(tolerance_s, frames)
        self._tf = tf

    def at(self, stamp: int, frame_id: str = "", last_chance: bool = False, several: bool = False) -> Pose | None:
        """Find the pose (4, 4) as `PoseSource` says."""
        known = self._tf.at(stamp, frame_id)
        return super().at(stamp, frame_id, last_chance) if known is None and not several else known

    def too_late(self, stamp: int) -> bool:
        """Tell nothing, as TF may still come to know it."""
        return False

    def set_back(self, before: int, began: int) -> None:
        """Forget all poses, and the transforms from before time was set back."""
        super().set_back(before, began)
        self._tf.set_back(before, began)
