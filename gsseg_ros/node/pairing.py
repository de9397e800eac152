"""Pairs every mask with the camera_info, the pose and the depth image that belong to its stamp and its camera.

Stamps are whole nanoseconds. The inputs come in any order; a mask waits for its pose, a pose is never replaced by
"the latest". Nothing here knows ROS: messages are passed through unread.
"""

from __future__ import annotations

import threading
from bisect import bisect_left
from collections import Counter, deque
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

from gsseg_ros.node.history import History, too_many
from gsseg_ros.node.pose_sources import GivenPose, MessagePoses, Pose, PoseSource
from gsseg_ros.node.timeline import BEHIND_NS, MASK, SECOND, Message, Timeline
from gsseg_ros.node.view_names import CAMERAS_KEPT, ViewName

_Key: TypeAlias = tuple[int, str]  # stamp and frame_id

_CAMERA_INFOS_KEPT = 600  # Of each camera; at 60 Hz, those of ten seconds.
_STAMPS_KEPT = 1000
_UNCLEAR_NS = 10 * SECOND
_DEPTH_BYTES = 64 << 20  # At 30 Hz, VGA and 16 bit, those of three seconds.
_HELD_BACK = 30  # Messages, by `Timeline`.
_RARE_S = 1.0
_LONG_S = 1.0  # Whoever has waited for longer is looked at by `expire` alone, unless a message of its stamp comes.
_LONGEST_STEP_S = 0.5

MOST_BYTES = 256 << 20
"""Of masks of a camera that wait for what belongs to them."""


class Paired(NamedTuple):
    """A mask with all that belongs to it."""

    name: str  # As `ViewName` says.
    stamp: int
    mask: Any
    camera_info: Any
    pose: Pose  # (4, 4) camera in the map
    era: object = None  # As it was given with the mask.
    depth: Any = None  # If the pairing was to wait for it.
    stream: str = ""  # As it was given to the pairing.
    size: int = 0  # Bytes of the mask.


@dataclass(frozen=True)
class PairingSettings:
    """Limits on how long and how many masks wait.

    What was lost on the way, a reliable publisher sends again only when the middleware next asks for it, three seconds
    later or more.
    """

    wait_s: float = 10.0  # seconds that a mask waits for what belongs to it while that stream is silent
    max_waiting: int = 300  # masks that wait at the same time; one more, and the oldest has to go
    max_bytes: int = MOST_BYTES  # the same, in bytes of theirs
    with_depth: bool = False  # whether a mask waits for the depth image of exactly its stamp, too


class Pairing:
    """Pairs masks with camera_info and pose by stamp and camera. Its methods may be called from any thread.

    A camera_info belongs to a mask if it has its stamp and its frame_id, which names the camera; otherwise, once a
    later one of this camera has come or the waiting time is over, the newest earlier one does. That time is a second
    where camera_infos do not come with each mask: where there is only one, as a latched one, or where the mask before
    went with an earlier one, too. A mask without a frame_id goes with the only camera there is, a camera_info without
    one with every camera that has none of its own. Every mask comes out of `take`, or is counted in `dropped`, or still
    waits.

    A mask is given up when what belongs to it can be told not to come: its stream has gone on from the mask's stamp by
    a second, more than messages come out of order. While a stream is silent, masks wait within the limits of
    `PairingSettings`. Time in which `expire` is not called does not count: then nothing that came was taken in.

    Poses that come from messages do not say of which camera they are. So when masks of two cameras carry one stamp, and
    the poses are not from a source that knows frames, none is paired until ten seconds (of stamps) later. A source that
    may know them is asked for a pose that is this camera's for certain.

    What is late and what shows that time was set back is said in `gsseg_ros.node.timeline.Timeline`.

    Pairs are named by the `activation` and the `stream`, for epochs and stamps of another pairing may be the same; with
    every pair comes `stream`, which says of which camera it is.
    """

    def __init__(
        self, poses: PoseSource, settings: PairingSettings | None = None, activation: str = "", stream: str = ""
    ) -> None:
        # Masks not paired, by reason: "no_pose", "bad_pose" (it came and was refused), "no_camera_info", "no_depth",
        # "repeated_stamp" (and the same frame_id), "several_cameras" (whose poses cannot be told apart),
        # "negative_stamp", and "time_jump" for one from before time was set back that came after it.
        self.dropped: Counter[str] = Counter()
        self.out_of_order = 0  # masks that were older than one before them; they are paired all the same
        self.unmatched_frame: str | None = None  # frame_id of the last mask that was dropped for want of a camera_info
        self.negative_stamp = 0  # that of the last mask that was dropped for it, ns
        self._poses = poses
        self._activation, self._stream = activation, stream
        self._settings = settings or PairingSettings()
        self._lock = threading.Lock()
        self._timeline = Timeline(min(_HELD_BACK, self._settings.max_waiting))
        self._camera_infos: dict[str, _CameraInfos] = {}  # By frame_id, that last heard at the end.
        self._seen: History[int, list[str]] = History(_STAMPS_KEPT)  # Frames of the masks of a stamp.
        self._unclear_until = 0  # Up to this stamp poses may be of another camera.
        # By stamp and frame_id.
        self._depths: History[_Key, Any] = History(_DEPTH_BYTES, lambda image: len(image[1].data))
        self._waiting: dict[_Key, _Waiting] = {}
        self._finished: list[Paired] = []
        self._awake_s, self._called_s = 0.0, float("inf")

    def add_mask(self, stamp: int, message: Any, frame_id: str = "", era: object = None, size: int = 0) -> None:
        """Take in a mask, of so many bytes, whose header has this stamp and frame; `era` comes out with it."""
        self._take_in(Message(MASK, stamp, (message, era, size), frame_id))

    def add_camera_info(self, stamp: int, message: Any, frame_id: str = "") -> None:
        """Take in a camera_info whose header has this stamp and frame."""
        self._take_in(Message("camera_info", stamp, message, frame_id))

    def add_pose(self, stamp: int, given: GivenPose) -> None:
        """Take in a pose; not for TF, which gets its poses by itself."""
        if not isinstance(self._poses, MessagePoses):
            raise TypeError(f"{type(self._poses).__name__} takes no poses")
        self._take_in(Message("pose", stamp, given))

    def refuse_pose(self, stamp: int) -> None:
        """Take in that the pose of a stamp came and cannot be used: a mask that needs just this one goes at once."""
        with self._lock:
            if isinstance(self._poses, MessagePoses):
                self._poses.refuse(stamp)
                for key in [key for key in self._waiting if key[0] == stamp]:
                    self._pair(key)

    def add_depth(self, stamp: int, message: Any, frame_id: str = "") -> None:
        """Take in a depth image whose header has this stamp and frame: the name of its topic and the message."""
        self._take_in(Message("depth", stamp, message, frame_id))

    def set_back(self, stamp: int) -> None:
        """Take in that the clock was set back to `stamp` (ns): nothing of a later time belongs to what comes now."""
        with self._lock:
            epoch = self._timeline.epoch
            self._deliver(epoch, self._timeline.set_back(stamp))

    def expire(self, now_s: float) -> None:
        """Pair or drop the masks that have waited long enough; call it some ten times a second.

        A mask's time runs from the first call that finds it waiting, by a clock that never goes back, such as
        `time.monotonic`.
        """
        with self._lock:
            self._awake_s += min(max(now_s - self._called_s, 0.0), _LONGEST_STEP_S)
            self._called_s = now_s
            epoch = self._timeline.epoch
            self._deliver(epoch, self._timeline.expire(self._awake_s))
            for key, waiting in sorted(self._waiting.items()):
                waiting.since = self._awake_s if waiting.since is None else waiting.since
                waited_s = self._awake_s - waiting.since
                self._pair(key, last_chance=waited_s >= self._settings.wait_s, rare=waited_s >= _RARE_S)

    def take(self) -> list[Paired]:
        """Hand over what was paired since the last call; call it after each of the others."""
        with self._lock:
            finished, self._finished = self._finished, []
            return finished

    def clear(self) -> int:
        """Forget the masks that wait, but no pose and no camera_info; return how many they were."""
        with self._lock:
            forgotten = len(self._waiting) + len(self._finished) + self._timeline.forget_masks()
            self._waiting.clear()
            self._finished.clear()
            return forgotten

    @property
    def waiting(self) -> int:
        """Number of masks that wait for a pose or camera_info, or that `Timeline` holds back."""
        with self._lock:
            return len(self._waiting) + self._timeline.held_masks

    @property
    def waiting_bytes(self) -> int:
        """Bytes of the masks that wait for a pose or camera_info."""
        with self._lock:
            return sum(waiting.size for waiting in self._waiting.values())

    @property
    def stamps(self) -> set[int]:
        """Stamps of the masks that wait, or have not been taken yet."""
        with self._lock:
            waiting = {stamp for stamp, _ in self._waiting} | {paired.stamp for paired in self._finished}
            return waiting | self._timeline.held_stamps

    @property
    def time_jumps(self) -> int:
        """How often time was set back by a second or more: a bag loops, a simulator starts again.

        All that was kept is dropped then, and the same stamps are new ones.
        """
        return self._timeline.epoch

    @property
    def last_jump(self) -> tuple[int, int]:
        """From where to where time was set back last, ns."""
        return self._timeline.last_jump

    @property
    def camera_frames(self) -> list[str]:
        """The frame_ids of the camera_infos."""
        with self._lock:
            return sorted(self._camera_infos)

    def _take_in(self, message: Message) -> None:
        with self._lock:
            if message.stamp < 0:  # No clock is ever there: it must not be taken for time that was set back.
                if message.stream == MASK:
                    self.dropped["negative_stamp"] += 1
                    self.negative_stamp = message.stamp
                return
            epoch = self._timeline.epoch
            self._deliver(epoch, self._timeline.take_in(message))

    def _deliver(self, epoch: int, messages: list[Message]) -> None:
        """Pair messages that `Timeline` has released; `epoch` is that of before the last message."""
        if self._timeline.epoch > epoch:
            for waiting in sorted(self._waiting):
                self._pair(waiting, last_chance=True, epoch=epoch)
            self._poses.set_back(*self._timeline.last_jump)
            for infos in self._camera_infos.values():  # One of earlier may be latched, and not come again.
                infos.clear(self._timeline.last_jump[1])
            self._camera_infos = {frame: infos for frame, infos in self._camera_infos.items() if infos.stamps}
            for kept in (self._seen, self._depths):
                kept.clear()
            self._unclear_until = 0
        if self._timeline.lost_masks:
            self.dropped["time_jump"] = self._timeline.lost_masks
        for stream, stamp, content, frame_id in messages:
            if stream == "camera_info":
                self._add_camera_info(stamp, content, frame_id)
            elif stream == "pose" and isinstance(self._poses, MessagePoses):
                self._poses.add(stamp, content)
            elif stream == "depth":
                self._depths.add((stamp, frame_id), content)
        for stream, stamp, content, frame_id in messages:
            if stream == MASK:
                self._await(stamp, content, frame_id)
        if messages:
            came = {message.stamp for message in messages}
            for key in sorted(self._waiting):
                since = self._waiting[key].since
                # Where TF is missing hundreds wait, and to look up all with each message would take half a core.
                if key[0] in came or since is None or self._awake_s - since < _LONG_S:
                    self._pair(key)
            most = self._settings.max_waiting, self._settings.max_bytes
            while too_many([waiting.size for waiting in self._waiting.values()], *most):
                self._pair(min(self._waiting), last_chance=True)

    def _await(self, stamp: int, content: tuple[Any, object, int], frame_id: str) -> None:
        frames = self._seen.values.get(stamp, [])
        if frame_id in frames or len(frames) >= CAMERAS_KEPT:
            self.dropped["repeated_stamp"] += 1
            return
        self.out_of_order += bool(self._seen.stamps) and stamp < self._seen.stamps[-1]
        self._seen.add(stamp, frames)
        frames.append(frame_id)
        if len(frames) > 1:
            self._unclear_until = max(self._unclear_until, stamp + _UNCLEAR_NS)
        self._waiting[stamp, frame_id] = _Waiting(*content, str(len(frames)) if len(frames) > 1 else "")

    def _add_camera_info(self, stamp: int, message: Any, frame_id: str) -> None:
        infos = self._camera_infos.pop(frame_id, None) or _CameraInfos(_CAMERA_INFOS_KEPT)
        self._camera_infos[frame_id] = infos
        if len(self._camera_infos) > CAMERAS_KEPT:
            del self._camera_infos[next(iter(self._camera_infos))]
        infos.add(stamp, message)

    def _pair(self, key: _Key, last_chance: bool = False, epoch: int | None = None, rare: bool = False) -> None:
        """Pair or drop a mask, or let it wait on; `rare`: it has waited long enough where camera_infos are rare."""
        waiting, (stamp, frame_id) = self._waiting[key], key
        several = stamp < self._unclear_until
        if waiting.pose is None or several:
            waiting.pose = self._poses.at(stamp, frame_id, last_chance, several)
        info = self._camera_info(stamp, frame_id, last_chance, rare)
        depth = self._depth(stamp, frame_id, last_chance)
        if several and not self._poses.knows_frames:
            self.dropped["several_cameras"] += 1
        elif waiting.pose is not None and info is not None and (depth or not self._settings.with_depth):
            times = str(self._timeline.epoch if epoch is None else epoch), str(stamp)
            name = ViewName(self._activation, self._stream, *times, waiting.number)
            mask, era, size = waiting.mask, waiting.era, waiting.size
            self._finished.append(Paired(str(name), stamp, mask, info, waiting.pose, era, depth, self._stream, size))
            if (infos := self._infos_of(frame_id)) is not None:
                infos.found.append(stamp in infos.values)
        elif waiting.pose is None:
            if not (last_chance or self._poses.too_late(stamp)):
                return
            self.dropped["bad_pose" if self._poses.refused(stamp) else "no_pose"] += 1
        elif info is None:
            if not (last_chance or self._info_too_late(stamp, frame_id)):
                return
            self.dropped["no_camera_info"] += 1
            self.unmatched_frame = frame_id
        else:
            if not (last_chance or self._depth_too_late(stamp, frame_id)):
                return
            self.dropped["no_depth"] += 1
        del self._waiting[key]

    def _camera_info(self, stamp: int, frame_id: str, last_chance: bool, rare: bool) -> Any:
        infos = self._infos_of(frame_id)
        if infos is None:
            return None
        if stamp in infos.values:
            return infos.values[stamp]
        after = bisect_left(infos.stamps, stamp)
        if after > 0 and (last_chance or (rare and infos.rare) or after < len(infos.stamps)):
            return infos.values[infos.stamps[after - 1]]
        return None

    def _info_too_late(self, stamp: int, frame_id: str) -> bool:
        """Whether the camera_infos of a camera have gone on from `stamp` by more than they come out of order."""
        infos = self._infos_of(frame_id)
        return infos is not None and infos.stamps[-1] >= stamp + BEHIND_NS

    def _depth_too_late(self, stamp: int, frame_id: str) -> bool:
        """Whether the depth images of a camera have gone on from `stamp` by more than they come out of order."""
        newest = (s for s, frame in reversed(self._depths.stamps) if frame in (frame_id, ""))
        return next(newest, stamp) >= stamp + BEHIND_NS

    def _depth(self, stamp: int, frame_id: str, last_chance: bool) -> Any:
        """Find the depth image of a mask; at last one of another frame, whose reader says what is wrong with it."""
        depths, stamps = self._depths.values, self._depths.stamps
        for key in ((stamp, frame_id), (stamp, "")):
            if key in depths:
                return depths[key]
        if last_chance or not frame_id or len(self._camera_infos) == 1:
            first = bisect_left(stamps, (stamp, ""))
            if first < len(stamps) and stamps[first][0] == stamp:
                return depths[stamps[first]]
        return None

    def _infos_of(self, frame_id: str) -> _CameraInfos | None:
        if not frame_id and len(self._camera_infos) == 1:
            return next(iter(self._camera_infos.values()))
        return self._camera_infos.get(frame_id) or self._camera_infos.get("")


class _CameraInfos(History[int, Any]):
    """Those of one camera; `found` says of the last two masks that were paired whether there was one of their stamp."""

    def __init__(self, capacity: int) -> None:
        super().__init__(capacity)
        self.found = deque([True, True], 2)

    @property
    def rare(self) -> bool:
        """Whether there are fewer than masks, as far as is known."""
        return len(self.stamps) == 1 or not all(self.found)

    def add(self, stamp: int, value: Any) -> None:
        """Keep a camera_info; of two with the same stamp the later one, as a driver may leave all stamps at zero."""
        super().add(stamp, value)
        if stamp in self.values:
            self.values[stamp] = value


@dataclass
class _Waiting:
    mask: Any
    era: object
    size: int  # bytes
    number: str  # As in its `ViewName`.
    pose: Pose | None = None
    since: float | None = None
