"""Adapter of vision_msgs/Detection2DArray beside a mask: whose pixels are whose, and what the detections are called.

Messages are only looked at by the names of their fields, so that vision_msgs is needed for the topic alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from gsseg_core.data.class_names import BACKGROUND_NAME
from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.errors import MaskFormatError, UnknownLabelError
from gsseg_core.files.limits import MAX_LABEL
from gsseg_core.text import clipped, counted
from gsseg_ros.node.masks.detections import Beside, NamedMask, check_count, checked_name


def named_mask(message: Any, topic: str, beside: Beside) -> NamedMask:
    """Name the labels (H, W) of a mask by detections (Detection2DArray), each by its likeliest hypothesis.

    Where the ids of all detections are whole numbers from 1 on, a mask holds these; else label k is the k-th detection.
    Hypotheses whose class_id is a number are called as `beside.heard` has it. Raises `UnknownLabelError`: the mask has
    labels that are no detections; `MaskFormatError`: detections have no hypothesis, or their names are no line of text.
    """
    if beside.labels is None:
        raise AssertionError("this adapter takes a mask")
    detections = list(message.detections)
    check_count(len(detections), topic)
    ids = [_number(str(detection.id)) for detection in detections]
    if len(set(ids)) < len(ids) or not all(ids):
        ids = list(range(1, len(detections) + 1))
    names = {0: BACKGROUND_NAME}
    for k, detection in zip(ids, detections, strict=True):
        names[k] = _name(detection, topic, beside.heard)
    strange = sorted(set(np.unique(beside.labels).tolist()) - {UNKNOWN, *names})
    if strange:
        raise UnknownLabelError(
            f"{topic}: its mask holds the labels {clipped(strange, 60)}, but there are "
            f"{counted(len(detections), 'detection')}; expected their ids, or their numbers from 1 on"
        )
    return NamedMask(beside.labels, names)


def _name(detection: Any, topic: str, heard: Mapping[int, str]) -> str:
    hypotheses = [result.hypothesis for result in detection.results]
    if not hypotheses:
        raise MaskFormatError(f"{topic}: a detection has no results; expected at least one hypothesis of its class")
    name = str(max(hypotheses, key=lambda hypothesis: float(hypothesis.score)).class_id)
    number = 0 if name == "0" else _number(name)
    if number or name == "0":
        return heard[number] if number in heard else checked_name("", number, topic)
    if not name:
        raise MaskFormatError(f"{topic}: a detection's class_id is empty; expected the name of its class")
    return checked_name(name, name, topic)


def _number(text: str) -> int:
    """Read a label, 0 if it is none."""
    number = int(text) if text.isascii() and text.isdecimal() and len(text) < 6 else 0
    return number if number <= MAX_LABEL else 0
