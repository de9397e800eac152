"""Camera poses from TF, for a camera that hangs on a tree of frames. Needs tf2_ros, which comes with ROS from apt."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import numpy.typing as npt

from gsseg_core.errors import GssegError, SettingsError
from gsseg_ros.conversions import matrix_from_transform


class TfPoses:
    """Poses of the frames that masks are stamped with, looked up in TF at the mask's stamp, never the latest.

    It listens from the first question on.

    Parameters
    ----------
    node : rclpy.node.Node
        Listens to `/tf` and `/tf_static`.
    map_frame : str
        Frame in which poses are wanted.

    Attributes
    ----------
    knows_frames : bool
        True: every camera has a pose of its own.
    problem : str
        Why the last lookup found nothing; empty if it found a pose.

    Raises
    ------
    SettingsError
        tf2_ros cannot be imported.
    """

    knows_frames = True

    def __init__(self, node: Any, map_frame: str) -> None:
        try:
            from rclpy.time import Time
            from tf2_ros import Buffer, TransformException, TransformListener
        except ImportError as error:
            raise SettingsError(
                f"parameter pose_source is 'tf', but TF cannot be used here ({error}); expected the apt package "
                "ros-jazzy-tf2-ros-py to be installed, or pose_source 'topic' or 'odometry'"
            ) from error
        self.problem = ""
        self._map_frame = map_frame
        self._buffer = Buffer()
        self._listening, self._listener = threading.Lock(), None
        self._listen = lambda: TransformListener(self._buffer, node)
        self._time, self._not_found = Time, TransformException

    @classmethod
    def if_here(cls, node: Any, map_frame: str) -> TfPoses | None:
        """Make them; None where tf2_ros cannot be imported."""
        try:
            return cls(node, map_frame)
        except SettingsError:
            return None

    def listen(self) -> None:
        """Begin to listen, if it does not yet."""
        with self._listening:
            self._listener = self._listener or self._listen()

    def at(
        self, stamp: int, frame_id: str = "", last_chance: bool = False, several: bool = False
    ) -> npt.NDArray[np.float64] | None:
        """Look up the pose (4, 4) of `frame_id` in the map frame at `stamp` (ns); None if TF does not know it (yet)."""
        if stamp <= 0 or not frame_id:
            # To TF a stamp of zero means "the latest", which belongs to another image.
            self.problem = f"a mask has the stamp {stamp} and the frame_id '{frame_id}'; expected both to be filled in"
            return None
        return self.look_up(frame_id, stamp)

    def look_up(self, frame_id: str, stamp: int, within: str = "") -> npt.NDArray[np.float64] | None:
        """Look up the pose (4, 4) of a frame in another (unless named, the map) at `stamp` (ns), 0 being the latest.

        Returns None if TF does not know it (yet).
        """
        within = within or self._map_frame
        self.listen()
        try:
            found = self._buffer.lookup_transform(within, frame_id, self._time(nanoseconds=stamp))
            pose = matrix_from_transform(found.transform, f"TF from '{frame_id}' to '{within}'")
        except (self._not_found, GssegError) as error:
            self.problem = str(error)
            return None
        self.problem = ""
        return pose

    def too_late(self, stamp: int) -> bool:
        """Tell nothing: any transform of a chain may still come, so that a mask waits for its time to be over."""
        return False

    def clear(self) -> None:
        """Forget all transforms but the static ones."""
        self._buffer.clear()

    def close(self) -> None:
        """Stop listening."""
        if self._listener is not None:
            self._listener.unregister()
