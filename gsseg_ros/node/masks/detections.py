"""Detections as masks: each has a label of its own and a name, and pixels without one are background."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gsseg_core.data.class_names import BACKGROUND_NAME, class_name, flaw_of_class_name
from gsseg_core.errors import MaskFormatError

MOST_DETECTIONS = 1000
"""Detections of one image; detectors stop at some hundreds."""


class NamedMask(NamedTuple):
    """Labels of a mask, and what they are called."""

    labels: npt.NDArray[np.int32]  # (H, W)
    names: Mapping[int, str]


class Beside(NamedTuple):
    """What there is beside detections to make a mask of."""

    size: tuple[int, int]  # width and height of the camera's images
    max_pixels: int  # no image may have more
    labels: npt.NDArray[np.int32] | None = None  # (H, W): of the mask that belongs to them, if the adapter takes one
    heard: Mapping[int, str] = {}  # what `label_info` told


class Detected(NamedTuple):
    """Detections of an image as they came; `mask` with the name of its topic, if the adapter takes one."""

    header: Any
    adapter: Adapter
    message: Any
    mask: tuple[str, Any] | None = None


@dataclass(frozen=True)
class Adapter:
    """How messages of one type become masks."""

    package: str  # of the message
    name: str  # of the message
    takes_mask: bool  # whether the pixels of its detections are those of a mask, which comes beside it
    named_mask: Callable[[Any, str, Beside], NamedMask]  # makes a mask of a message and the name of its topic

    @property
    def type(self) -> str:
        """Type of the messages."""
        return f"{self.package}/msg/{self.name}"

    @property
    def message_class(self) -> Any:
        """Class of the messages; raises ImportError where the package is not installed."""
        return getattr(import_module(f"{self.package}.msg"), self.name)


def checked_name(name: str, number: object, topic: str) -> str:
    """Return the name of a detection's class; one after its number where it has none.

    Raises `MaskFormatError`: the name is no line of text.
    """
    if not name:
        return class_name({0: BACKGROUND_NAME}, int(str(number)))
    if flaw := flaw_of_class_name(name):
        raise MaskFormatError(f"{topic}: a detection's class has the name {flaw}")
    return name


def check_count(count: int, topic: str) -> None:
    """Raise `MaskFormatError` if an image has more detections than any detector finds."""
    if count > MOST_DETECTIONS:
        raise MaskFormatError(f"{topic}: has {count:,} detections; expected at most {MOST_DETECTIONS:,}")
