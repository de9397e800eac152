"""vision_msgs/LabelInfo: names of a segmenter's labels in, on `label_info`, and those of the classes out.

Messages are only looked at by the names of their fields, so that vision_msgs is needed for topics alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from std_msgs.msg import Header

from gsseg_core.data.class_names import flaw_of_class_name
from gsseg_core.files.limits import MAX_LABEL
from gsseg_ros.errors import LabelInfoError

TOPIC = "label_info"


def label_info_class() -> Any | None:
    """Import vision_msgs/LabelInfo; None where it is not installed."""
    try:
        from vision_msgs.msg import LabelInfo
    except ImportError:
        return None
    return LabelInfo


def names_of(message: Any, topic: str) -> dict[int, str]:
    """Read the names of labels.

    Raises `LabelInfoError`: there are none, a label has two names, or a name is no line of text.
    """
    names: dict[int, str] = {}
    for entry in message.class_map:
        k, name = int(entry.class_id), str(entry.class_name)
        if k > MAX_LABEL:
            continue  # 65535 is of pixels without a label.
        if flaw := flaw_of_class_name(name):
            raise LabelInfoError(f"{topic}: label {k} has the name {flaw}")
        if names.setdefault(k, name) != name:
            raise LabelInfoError(f"{topic}: label {k} has two names, {names[k]!r} and {name!r}; expected one")
    if not names:
        raise LabelInfoError(f"{topic}: names no labels; expected a class_map")
    return names


def label_info(names: Mapping[int, str], header: Header) -> Any:
    """Write the names of the classes; vision_msgs is there."""
    from vision_msgs.msg import LabelInfo, VisionClass

    class_map = [VisionClass(class_id=k, class_name=name) for k, name in sorted(names.items())]
    return LabelInfo(header=header, class_map=class_map)
