"""Camera poses from TF, for a camera that hangs on a tree of frames. Needs tf2_ros, which comes with ROS from apt."""

from __future__ import annotations

import threading
import time
from collections import defaultdict, deque
from typing import Any

import numpy as np
import numpy.typing as npt

from gsseg_core.errors import GssegError, SettingsError
from gsseg_ros.conversions import matrix_from_transform, stamp_ns
from gsseg_ros.node.pose_sources import PoseSource
from gsseg_ros.node.timeline import BEHIND_NS

_BEHIND_KEPT = 2000  # Transforms of a frame; at 200 Hz, those of ten seconds.
_PROBLEMS_KEPT, _LONG_AGO_S = 16, 10.0
_UNDER_WAY = 100  # Transforms from before time was set back that may come after it: as deep as tf2_ros subscribes.


class TfPoses(PoseSource):
    """Poses of the frames that masks are stamped with, looked up in TF at the mask's stamp, never the latest.

    It listens from the first question on. It cannot tell that a pose will not come: any transform of a chain still may,
    and TF does not hand on what it refuses. Raises `SettingsError`: tf2_ros cannot be imported.
    """

    knows_frames = True  # Every camera has a pose of its own.

    def __init__(self, node: Any, map_frame: str) -> None:
        try:
            from rclpy.time import Time
            from tf2_ros import Buffer, TransformException, TransformListener
        except ImportError as error:
            raise SettingsError(
                f"parameter pose_source is 'tf', but TF cannot be used here ({error}); expected the apt package "
                "ros-jazzy-tf2-ros-py to be installed, or pose_source 'topic' or 'odometry'"
            ) from error
        # By frame, and frame within which: when (s, `time.monotonic`) and why the last lookup of it found nothing.
        self._problems: dict[tuple[str, str], tuple[float, str]] = {}
        self._map_frame = map_frame
        self._buffer = Buffer()
        self._heard = _Heard(self._buffer)
        self._listening, self._listener = threading.Lock(), None
        self._listen = lambda: TransformListener(self._heard, node)
        self._time, self._not_found = Time, TransformException

    @classmethod
    def if_here(cls, node: Any, map_frame: str) -> TfPoses | None:
        """Make them; None where tf2_ros cannot be imported."""
        try:
            return cls(node, map_frame)
        except SettingsError:
            return None

    @property
    def problem(self) -> str:
        """Why the newest lookup failed that has not succeeded since; empty if there is none, or it was long ago."""
        when, why = [(0.0, ""), *self._problems.values()][-1]
        return why if time.monotonic() - when < _LONG_AGO_S else ""

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
            why = f"a mask has the stamp {stamp} and the frame_id '{frame_id}'; expected both to be filled in"
            self._note(frame_id, self._map_frame, why)
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
            self._note(frame_id, within, str(error))
            return None
        self._problems.pop((frame_id, within), None)
        return pose

    def _note(self, frame_id: str, within: str, why: str) -> None:
        """Note why a lookup failed: those of other cameras, and of the rest of a chain, may succeed all the same."""
        self._problems.pop((frame_id, within), None)
        self._problems[frame_id, within] = time.monotonic(), why
        for oldest in list(self._problems)[:-_PROBLEMS_KEPT]:
            self._problems.pop(oldest, None)

    def set_back(self, before: int, began: int) -> None:
        """Forget the transforms from before time was set back from `before` to `began` (ns), but not the static ones.

        Those of the time since, which may have come before that was known, stay.
        """
        self._heard.set_back(before, began)

    def close(self) -> None:
        """Stop listening."""
        if self._listener is not None:
            self._listener.unregister()


class _Heard:
    """Hands transforms on to a buffer of tf2, and lets it follow when time is set back.

    TF notices nothing of that by itself: a buffer refuses what is ten seconds older than the newest, and `clear` takes
    what has come of the new time along. So transforms that are no newer than the newest of their child frame are kept
    until a newer one shows that they were late.
    """

    def __init__(self, buffer: Any) -> None:
        self._buffer, self._lock = buffer, threading.Lock()  # The listener calls from several threads.
        # By child frame: the newest stamp (ns), and what has come since that is no newer.
        self._newest: dict[str, int] = {}
        self._behind: dict[str, deque[Any]] = defaultdict(lambda: deque(maxlen=_BEHIND_KEPT))
        self._began = self._under_way = 0

    def set_transform(self, transform: Any, authority: str) -> None:
        """Take in a transform."""
        with self._lock:
            child, stamp = transform.child_frame_id, stamp_ns(transform.header.stamp)
            if self._is_straggler(child, stamp):
                return
            if stamp > self._newest.get(child, -1):
                self._newest[child] = stamp
                self._behind.pop(child, None)
            else:
                self._behind[child].append(transform)
            self._buffer.set_transform(transform, authority)

    def set_transform_static(self, transform: Any, authority: str) -> None:
        """Take in a static transform."""
        self._buffer.set_transform_static(transform, authority)

    def set_back(self, before: int, began: int) -> None:
        """Forget what is from before time was set back; nothing, where another camera has shown that already."""
        middle = (before + began) // 2
        with self._lock:
            if all(newest < middle for newest in self._newest.values()):
                return
            kept = [t for behind in self._behind.values() for t in behind if stamp_ns(t.header.stamp) < middle]
            self._buffer.clear()
            self._newest.clear()
            self._behind.clear()
            self._began, self._under_way = began, _UNDER_WAY
        for transform in kept:
            self.set_transform(transform, "")

    def _is_straggler(self, child: str, stamp: int) -> bool:
        """Whether a transform is from before time was set back: far ahead of all since, its frame not heard since."""
        if not self._under_way or child in self._newest:
            return False
        ahead = stamp >= max([self._began, *self._newest.values()]) + BEHIND_NS
        self._under_way -= ahead
        return ahead
