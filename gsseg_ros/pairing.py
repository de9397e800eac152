"""Pairs every mask with the camera_info and the pose that belong to its stamp.

Stamps are whole nanoseconds. The three inputs come in any order; a mask waits for its pose, a pose is never replaced by
"the latest". Nothing here knows ROS: messages are passed through unread.
"""

from __future__ import annotations

import threading
from bisect import bisect_left, insort
from collections import Counter
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, Protocol, TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt

from gsseg_ros.frames import interpolate

Pose: TypeAlias = npt.NDArray[np.float64]  # (4, 4)
T = TypeVar("T")

_NS = 1_000_000_000
# How much older than its predecessors a message may be before time is taken to have been set back.
_JUMP_NS = _NS
_POSES_KEPT = 2000  # At 200 Hz, those of ten seconds.
_CAMERA_INFOS_KEPT = 200
_STAMPS_KEPT = 1000


class PoseSource(Protocol):
    """Where poses of the camera in the map come from."""

    def at(self, stamp: int, frame_id: str = "") -> Pose | None:
        """Pose (4, 4) at exactly `stamp` of the camera whose masks carry `frame_id`; None if it is not known (yet)."""

    def too_late(self, stamp: int) -> bool:
        """Whether no pose for `stamp` can come any more."""

    def clear(self) -> None:
        """Forget everything: time was set back."""


class Paired(NamedTuple):
    """A mask, and what belongs to it."""

    name: str  # Unique: the pairing's prefix, the epoch and the stamp.
    stamp: int
    mask: Any
    camera_info: Any
    pose: Pose  # (4, 4) camera in the map
    era: object = None  # As it was given with the mask.


@dataclass(frozen=True)
class PairingSettings:
    """How long masks wait.

    Attributes
    ----------
    wait_s : float
        Seconds of wall clock that a mask waits for its pose and camera_info.
    max_waiting : int
        Masks that wait at the same time; one more, and the oldest has to go.
    """

    wait_s: float = 1.0
    max_waiting: int = 30


class ExactPoses:
    """Poses that were measured for the masks themselves: only that of exactly a mask's stamp will do."""

    def __init__(self) -> None:
        self._poses: _History[Pose] = _History(_POSES_KEPT)

    def add(self, stamp: int, matrix: Pose) -> None:
        """Keep the pose (4, 4) of a stamp; of two with the same stamp the first stays."""
        self._poses.add(stamp, matrix)

    def at(self, stamp: int, frame_id: str = "") -> Pose | None:
        """Pose (4, 4) of exactly `stamp`, whatever the frame; None if it is not there."""
        return self._poses.values.get(stamp)

    def too_late(self, stamp: int) -> bool:
        """Whether the poses have gone on from `stamp` by more than they come out of order."""
        return bool(self._poses.stamps) and self._poses.stamps[-1] >= stamp + _JUMP_NS

    def clear(self) -> None:
        """Forget all poses."""
        self._poses.clear()


class InterpolatedPoses(ExactPoses):
    """Poses of an odometry, which runs at its own rate: between the two that bracket a mask's stamp.

    Parameters
    ----------
    max_gap_s : float
        The two may be so many seconds apart.
    """

    def __init__(self, max_gap_s: float = 0.2) -> None:
        super().__init__()
        self._max_gap_ns = round(max_gap_s * _NS)

    def at(self, stamp: int, frame_id: str = "") -> Pose | None:
        """Pose (4, 4) at `stamp`, whatever the frame; None without poses before and after it that are close enough."""
        exact = super().at(stamp)
        stamps = self._poses.stamps
        after = bisect_left(stamps, stamp)
        if exact is not None or not 0 < after < len(stamps):
            return exact
        earlier, later = stamps[after - 1], stamps[after]
        if later - earlier > self._max_gap_ns:
            return None
        share = (stamp - earlier) / (later - earlier)
        return interpolate(self._poses.values[earlier], self._poses.values[later], share)


class Pairing:
    """Pairs masks with camera_info and pose by stamp. Its methods may be called from any thread.

    A camera_info belongs to a mask if it has its stamp; otherwise, once a later one has come or the waiting time is
    over, the newest earlier one does. Every mask comes out of `take`, or is counted in `dropped`, or still waits.

    Parameters
    ----------
    poses : PoseSource
        `ExactPoses`, `InterpolatedPoses` or `gsseg_ros.tf_poses.TfPoses`.
    settings : PairingSettings
        How long masks wait.
    prefix : str
        What the names of all pairs begin with: epochs and stamps of another pairing may be the same.

    Attributes
    ----------
    dropped : Counter
        Masks not paired, by reason: "no_pose", "no_camera_info", "repeated_stamp", and "time_jump" for one from before
        time was set back that came after it.
    out_of_order : int
        Masks that were older than one before them, by less than a second; they are paired all the same.
    time_jumps : int
        How often time was set back by a second or more: a bag loops, a simulator starts again. All that was kept is
        dropped then, and the same stamps are new ones.
    """

    def __init__(self, poses: PoseSource, settings: PairingSettings | None = None, prefix: str = "") -> None:
        self.dropped: Counter[str] = Counter()
        self.out_of_order = 0
        self.time_jumps = 0
        self._poses = poses
        self._prefix = prefix
        self._settings = settings or PairingSettings()
        self._lock = threading.Lock()
        self._clock = _Clock(self._settings.max_waiting)
        self._camera_infos: _History[Any] = _History(_CAMERA_INFOS_KEPT)
        self._seen: _History[None] = _History(_STAMPS_KEPT)
        self._waiting: dict[int, _Waiting] = {}
        self._finished: list[Paired] = []

    def add_mask(self, stamp: int, message: Any, frame_id: str = "", era: object = None) -> None:
        """Take in a mask whose header has this stamp and frame; `era` comes out with it."""
        with self._lock:
            newest = self._clock.newest.get("mask", stamp)
            if not self._arrives("mask", stamp):
                self.dropped["time_jump"] += 1
            elif stamp in self._seen.values:
                self.dropped["repeated_stamp"] += 1
            else:
                self.out_of_order += newest - _JUMP_NS < stamp < newest
                self._seen.add(stamp, None)
                self._waiting[stamp] = _Waiting(message, frame_id, era)
                self._pair(stamp)
                if len(self._waiting) > self._settings.max_waiting:
                    self._pair(min(self._waiting), last_chance=True)

    def add_camera_info(self, stamp: int, message: Any) -> None:
        """Take in a camera_info."""
        with self._lock:
            if self._arrives("camera_info", stamp):
                self._camera_infos.add(stamp, message)
                self._pair_all()

    def add_pose(
        self,
        stamp: int,
        matrix: Pose,  # (4, 4)
    ) -> None:
        """Take in a pose of the camera in the map; not for TF, which gets its poses by itself."""
        with self._lock:
            if not isinstance(self._poses, ExactPoses):
                raise TypeError(f"{type(self._poses).__name__} takes no poses")
            if self._arrives("pose", stamp):
                self._poses.add(stamp, matrix)
                self._pair_all()

    def expire(self, now_s: float) -> None:
        """Pair or drop the masks that have waited long enough; call it some ten times a second.

        A mask's time runs from the first call that finds it waiting.

        Parameters
        ----------
        now_s : float
            Seconds of a clock that never goes back, such as `time.monotonic`.
        """
        with self._lock:
            for stamp, waiting in sorted(self._waiting.items()):
                waiting.since = now_s if waiting.since is None else waiting.since
                self._pair(stamp, last_chance=now_s - waiting.since >= self._settings.wait_s)

    def take(self) -> list[Paired]:
        """Hand over what was paired since the last call; call it after each of the others."""
        with self._lock:
            finished, self._finished = self._finished, []
            return finished

    def clear(self) -> int:
        """Forget the masks that wait, but no pose and no camera_info; return how many they were."""
        with self._lock:
            forgotten = len(self._waiting) + len(self._finished)
            self._waiting.clear()
            self._finished.clear()
            return forgotten

    @property
    def waiting(self) -> int:
        """How many masks wait."""
        with self._lock:
            return len(self._waiting)

    def _arrives(self, stream: str, stamp: int) -> bool:
        """Note that time went on, or was set back; return False for a straggler from before that."""
        epoch = self._clock.epoch
        current = self._clock.arrives(stream, stamp)
        if self._clock.epoch > epoch:
            self.time_jumps += 1
            for waiting in sorted(self._waiting):
                self._pair(waiting, last_chance=True, epoch=epoch)
            for kept in (self._poses, self._camera_infos, self._seen):
                kept.clear()
        return current

    def _pair_all(self) -> None:
        for stamp in sorted(self._waiting):
            self._pair(stamp)

    def _pair(self, stamp: int, last_chance: bool = False, epoch: int | None = None) -> None:
        waiting = self._waiting[stamp]
        if waiting.pose is None:
            waiting.pose = self._poses.at(stamp, waiting.frame_id)
        info = self._camera_info(stamp, last_chance)
        if waiting.pose is not None and info is not None:
            name = f"{self._prefix}{self._clock.epoch if epoch is None else epoch}_{stamp}"
            self._finished.append(Paired(name, stamp, waiting.mask, info, waiting.pose, waiting.era))
        elif waiting.pose is None and (last_chance or self._poses.too_late(stamp)):
            self.dropped["no_pose"] += 1
        elif last_chance:
            self.dropped["no_camera_info"] += 1
        else:
            return
        del self._waiting[stamp]

    def _camera_info(self, stamp: int, last_chance: bool) -> Any:
        infos = self._camera_infos
        if stamp in infos.values:
            return infos.values[stamp]
        after = bisect_left(infos.stamps, stamp)
        if after > 0 and (last_chance or after < len(infos.stamps)):
            return infos.values[infos.stamps[after - 1]]
        return None


@dataclass
class _Waiting:
    mask: Any
    frame_id: str
    era: object
    pose: Pose | None = None
    since: float | None = None


class _History(Generic[T]):
    """Values by stamp, those of the `capacity` newest stamps; `stamps` is sorted."""

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self.stamps: list[int] = []
        self.values: dict[int, T] = {}

    def add(self, stamp: int, value: T) -> None:
        if stamp in self.values:
            return
        insort(self.stamps, stamp)
        self.values[stamp] = value
        if len(self.stamps) > self._capacity:
            del self.values[self.stamps.pop(0)]

    def clear(self) -> None:
        self.stamps.clear()
        self.values.clear()


class _Clock:
    """Sees time being set back, once, though every stream shows it on its own and some still send from before."""

    def __init__(self, max_stragglers: int) -> None:
        self.epoch = 0
        self.newest: dict[str, int] = {}  # Of each stream, in this epoch.
        self._before: dict[str, int] = {}  # Of the streams that have sent nothing in this epoch, in the one before.
        self._stragglers: Counter[str] = Counter()
        self._max_stragglers = max_stragglers

    def arrives(self, stream: str, stamp: int) -> bool:
        """Take in a stamp; return False for one of an earlier epoch."""
        if stream in self._before:
            if self._is_straggler(stream, stamp):
                return False
            del self._before[stream]
        elif stamp <= self.newest.get(stream, stamp) - _JUMP_NS:
            self.epoch += 1
            self._before, self.newest = self.newest, {}
            self._before.pop(stream)
            self._stragglers.clear()
        self.newest[stream] = max(stamp, self.newest.get(stream, stamp))
        return True

    def _is_straggler(self, stream: str, stamp: int) -> bool:
        went_on = stamp > self._before[stream] - _JUMP_NS
        ahead = stamp >= max(self.newest.values()) + _JUMP_NS
        # A single wrong stamp looks like a jump. The other streams then never follow, but only so many of their
        # messages can have been under way.
        self._stragglers[stream] += 1
        return went_on and ahead and self._stragglers[stream] <= self._max_stragglers
