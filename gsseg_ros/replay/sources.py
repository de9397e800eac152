"""Reads a dataset folder or a recorded bag as a stream of messages with the times when they are due.

Time is counted in masks: the message of due time 3.5 belongs halfway between the fourth mask and the fifth. So a
recording can be played at another rate, and what was recorded between two masks still comes between them.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt
from geometry_msgs.msg import PoseStamped
from std_msgs.msg import Header

from gsseg_core.errors import GssegError, MaskSizeError, NoUsableViewsError
from gsseg_core.files.input_files import open_image
from gsseg_core.scene.undistortion import Undistortion
from gsseg_ros.conversions import camera_info, mask_image, pose_from_matrix, rgb_image

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

    from gsseg_core.data.view import View

TYPES = {
    "mask": "sensor_msgs/msg/Image",
    "camera_info": "sensor_msgs/msg/CameraInfo",
    "pose": "geometry_msgs/msg/PoseStamped",
    "image": "sensor_msgs/msg/Image",
}
"""Type of each topic that is replayed; `image` may be missing from a source, the others may not."""


class BagFileError(GssegError):
    """A bag is missing or broken, or does not hold the topics that are to be replayed."""


class PhotoFileError(GssegError):
    """A photo of a dataset is unreadable."""


class Group(NamedTuple):
    """Messages that are published together.

    A message that is bytes was recorded and goes out as it is; a message object gets the stamp of its publication, the
    same for the whole group.
    """

    due: float  # when, in masks since the start of the pass
    messages: tuple[tuple[str, Any], ...]  # each with its topic, a key of `TYPES`


class FolderSource:
    """The views of a dataset folder, each a group of mask, camera_info, pose and, where there is a photo, image.

    The scene's frame is the map frame; `split` is "train", "test" or "all". Views without a label image in the
    sub-folder `labels` are left out. Raises `GssegError`: as `Dataset` does; `NoUsableViewsError`: no view is left.
    While iterating, `MaskFormatError`, `MaskSizeError`, `UnknownLabelError` or `PhotoFileError`: a file is broken.
    """

    def __init__(self, folder: str | os.PathLike[str], labels: str, split: str, frame_id: str, map_frame: str) -> None:
        from gsseg_core.data.dataset import Dataset  # It loads kernels; a bag is played without.

        dataset = Dataset(folder, labels)
        views = dataset.views(split)
        if not views:
            raise NoUsableViewsError(
                f"{folder}: split '{split}' has no view; expected at least one "
                f"(train has {len(dataset.views('train'))}, test has {len(dataset.views('test'))})"
            )
        # What ids are is for the receiver to say: those of a view's own are none of the classes.
        self._views = [replace(view, class_names=None) for view in views if view.has_mask]
        # Names of those that are left out.
        self.without_mask = [view.name for view in views if not view.has_mask]
        if not self._views:
            raise NoUsableViewsError(
                f"{Path(folder) / labels}: no label image for any of the {len(views)} views of split '{split}'; "
                f"expected {views[0].name}.png and so on"
            )
        # What is replayed, in words for the log.
        self.description = f"{len(self._views)} views (split '{split}') of {folder}"
        self._frame_id, self._map_frame = frame_id, map_frame

    def __iter__(self) -> Iterator[Group]:
        """Read one view after the other."""
        for due, view in enumerate(self._views):
            yield Group(float(due), tuple(self._messages(view)))

    def _messages(self, view: View) -> Iterator[tuple[str, Any]]:
        header = Header(frame_id=self._frame_id)
        camera_in_map = np.linalg.inv(view.camera.world_to_camera).astype(np.float64)
        yield "camera_info", camera_info(view.camera, header)
        yield "pose", PoseStamped(header=Header(frame_id=self._map_frame), pose=pose_from_matrix(camera_in_map))
        if view.image_path is not None:
            yield "image", rgb_image(_read_photo(view.image_path, view.camera.undistortion), header)
        # The mask comes last, so that a receiver has all that belongs to it.
        yield "mask", mask_image(view.read_labels(), header, view.mask_bits or 16)


class BagSource:
    """The topics of a recorded bag, mcap or sqlite3; messages go out as the bytes that were recorded.

    `topics` says by key of `TYPES` which topic of the bag it is; "" for the one of its type whose name ends in the key.
    Raises `BagFileError`: the bag is missing or broken, or a topic is missing or ambiguous; also while iterating.
    """

    def __init__(self, path: str | os.PathLike[str], topics: Mapping[str, str]) -> None:
        self._path = Path(path)
        if not self._path.exists():
            raise BagFileError(
                f"{path}: does not exist; expected a bag: a folder with metadata.yaml, a .mcap or a .db3"
            )
        with self._open() as reader:
            found = {role: _choose(self._path, reader.connections, role, topics.get(role, "")) for role in TYPES}
        # As they were found; without "image" if the bag has none.
        self.topics = {role: name for role, name in found.items() if name is not None}
        self.description = f"bag {path} ({', '.join(self.topics.values())})"

    def __iter__(self) -> Iterator[Group]:
        """Read in the order of recording."""
        with self._open() as reader, self._open() as ahead:
            wanted = {c.id: c for c in reader.connections if self._role(c) is not None}
            clock = _MaskClock(
                t for _, t, _ in ahead.messages([c for c in ahead.connections if self._role(c) == "mask"])
            )
            for connection, recorded, data in reader.messages(list(wanted.values())):
                yield Group(clock.due(recorded), ((self._role(connection) or "", bytes(data)),))
            if clock.masks == 0:
                raise BagFileError(f"{self._path}: no message on '{self.topics['mask']}'; expected at least one mask")

    def _role(self, connection: Connection) -> str | None:
        """Tell what a recorded topic is replayed as."""
        for role, name in self.topics.items():
            if connection.topic == name and connection.msgtype == TYPES[role]:
                return role
        return None

    @contextlib.contextmanager
    def _open(self) -> Iterator[Any]:
        try:
            from rosbags.highlevel import AnyReader
        except ImportError as error:
            raise BagFileError(f"{self._path}: to replay a bag, install rosbags") from error
        try:
            with AnyReader([self._path]) as reader:
                if not reader.is2:
                    raise BagFileError(f"{self._path}: is a bag of ROS 1; convert it with rosbags-convert first")
                yield reader
        except GssegError:
            raise
        except Exception as error:  # whatever the readers and decompressors make of a broken file
            reason = " ".join(str(error).split()) or type(error).__name__
            raise BagFileError(f"{self._path}: not a readable bag ({reason}); expected mcap or sqlite3") from error


class _MaskClock:
    """Converts times of recording to masks since the start, linearly between one mask and the next."""

    def __init__(self, masks: Iterator[int]) -> None:
        self._masks = masks
        self._start: int | None = None  # of the interval that runs, ns
        self._end = next(masks, None)
        self._length = 1  # ns
        self._index = 0  # of the interval; 0 is what comes before the first mask
        self.masks = 0  # so far

    def due(self, recorded: int) -> float:
        """Due time of a message; to be asked in the order of recording."""
        if self._start is None:
            self._start = recorded
            self._length = max(1, (self._end or 0) - recorded)
            # Where nothing comes before the first mask, no time is spent on it.
            self._index = -1 if recorded == self._end else 0
        while self._end is not None and recorded >= self._end:
            self._start, self._end = self._end, next(self._masks, None)
            self._index += 1
            self.masks += 1
            if self._end is not None:
                self._length = max(1, self._end - self._start)
        # What comes after the last mask keeps the pace, but for no longer than to the next mask's place.
        return self._index + min(max(0.0, (recorded - self._start) / self._length), 0.999)


def _choose(path: Path, connections: list[Connection], role: str, wanted: str) -> str | None:
    """Find the recorded topic that is replayed as `role`; None for an image that is not there."""
    listing = ", ".join(sorted({f"{c.topic} ({c.msgtype}, {c.msgcount} messages)" for c in connections})) or "none"
    fitting = sorted({c.topic for c in connections if c.msgtype == TYPES[role]})
    if wanted:
        wanted = wanted if wanted.startswith("/") else f"/{wanted}"
        if wanted not in fitting:
            raise BagFileError(
                f"{path}: no topic '{wanted}' of type {TYPES[role]} ({role}_topic); topics in the bag: {listing}"
            )
        return wanted
    fitting = [topic for topic in fitting if topic.endswith(role)]
    if len(fitting) > 1 or (not fitting and role != "image"):
        found = f"{len(fitting)} topics ({', '.join(fitting)})" if fitting else "no topic"
        raise BagFileError(
            f"{path}: {found} of type {TYPES[role]} with a name that ends in '{role}'; expected one, "
            f"or that {role}_topic says which; topics in the bag: {listing}"
        )
    return fitting[0] if fitting else None


def _read_photo(path: Path, undistortion: Undistortion | None) -> npt.NDArray[np.uint8]:  # (H, W, 3)
    with open_image(path, PhotoFileError, "image", "a photo, JPEG or PNG") as picture:
        photo = np.array(picture.convert("RGB"))
    try:
        return photo if undistortion is None else undistortion.photo(photo)
    except MaskSizeError as error:
        raise PhotoFileError(f"{path}: {error}") from error
