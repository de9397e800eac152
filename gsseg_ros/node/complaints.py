"""Writes warnings to the log, those of one kind at most once in five seconds."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from gsseg_ros.errors import NAMES

PERIOD = 5.0  # s

MISSING = {role: f"no data on {role}" for role in ("mask", "camera_info", "depth", "pose", "odometry", "detections")}
"""Kinds of complaint: an input that is silent."""

REFUSED_POSE, TIME_JUMP, CLOCK, LIVE, OTHER = "refused pose", "time set back", "no clock", "overlay or objects", "other"
OBSTACLES, SCENE_DELTA, NAMESAKES = "obstacles", "scene delta", "other nodes of this name"
REFUSED_LABELS, DETECTIONS_TYPE = "refused label_info", "type of detections"

REASONS = (
    "no_pose", "no_camera_info", "no_depth", "no_detections", "repeated_stamp", "several_cameras", "time_jump",
    "negative_stamp", "queue_full", "lost", "no_scene", "mask_format", "size_mismatch", "unknown_label", "bad_pose",
    "bad_camera_info", "bad_depth", "all_pixels_unknown", "sees_no_Gaussian", "no_mask", "too_large",
    "scene_changed", "unusable", "unexpected",
)  # fmt: skip
"""Kinds of complaint: why a mask became no view."""

_OTHER_KINDS = (
    REFUSED_POSE, TIME_JUMP, CLOCK, LIVE, OBSTACLES, SCENE_DELTA, NAMESAKES, REFUSED_LABELS, DETECTIONS_TYPE, OTHER,
)  # fmt: skip
KINDS = frozenset((*MISSING.values(), *REASONS, *_OTHER_KINDS, *(name for _, name in NAMES)))


@dataclass
class _Said:
    when: float = -PERIOD
    left_out: int = 0
    last: str = ""


class Complaints:
    """Writes warnings to the log at a limited rate, and how many of a kind were left out.

    Its methods may be called from any thread. A kind that is not in `KINDS` counts as `OTHER`, so that there are never
    more of them, whatever a message says.
    """

    def __init__(self, warn: Callable[[str], object], now: Callable[[], float] = time.monotonic) -> None:
        self._warn, self._now = warn, now
        self._lock = threading.Lock()
        self._said = {kind: _Said() for kind in KINDS}

    def add(self, kind: str, message: str) -> None:
        """Warn of an event now; or, where that would be too often, count it."""
        with self._lock:
            said = self._of(kind)
            if self._is_due(said):
                self._write(said, message)
            else:
                said.left_out += 1
                said.last = message

    def remind(self, kind: str, message: str) -> None:
        """Warn of a lasting condition, unless the message is empty or that would be too often: it is not counted."""
        if message and self.due(kind):
            self.add(kind, message)

    def due(self, kind: str) -> bool:
        """Whether a kind may be warned of now."""
        with self._lock:
            return self._is_due(self._of(kind))

    def flush(self) -> None:
        """Write what was counted and is due, the last of each kind; call it once a second."""
        with self._lock:
            for said in self._said.values():
                if said.left_out and self._is_due(said):
                    said.left_out -= 1
                    self._write(said, said.last)

    def _of(self, kind: str) -> _Said:
        return self._said.get(kind, self._said[OTHER])

    def _is_due(self, said: _Said) -> bool:
        return self._now() - said.when >= PERIOD

    def _write(self, said: _Said, message: str) -> None:
        more = f" ({said.left_out} more of this kind since the last such line)" if said.left_out else ""
        said.when, said.left_out = self._now(), 0
        self._warn(message + more)
