"""Messages as drivers send them, for the tests of conversions."""

from __future__ import annotations

import array
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header

from gsseg_core.errors import GssegError
from gsseg_ros.frames import Similarity

HEADER = Header(stamp=Time(sec=7, nanosec=8), frame_id="camera")
K = np.array([[100.0, 0, 31.5], [0, 120.0, 20.25], [0, 0, 1]])
IDENTITY = Similarity()


def as_bytes(values: np.ndarray) -> array.array[int]:
    return array.array("B", values.tobytes())


def image(values: np.ndarray, encoding: str, padding: int = 0, big: bool = False) -> Image:
    """An image message as a driver may send it: rows padded with noise, either byte order."""
    height, width = values.shape
    raw = values.astype(values.dtype.newbyteorder(">" if big else "<")).view(np.uint8).reshape(height, -1)
    rows = np.pad(raw, ((0, 0), (0, padding)), constant_values=0xAB)
    message = Image(header=HEADER, height=height, width=width, encoding=encoding, step=rows.shape[1])
    message.is_bigendian = int(big)
    message.data = as_bytes(rows)
    return message


def info(**changes: Any) -> CameraInfo:
    values: dict[str, Any] = {"header": HEADER, "width": 64, "height": 48, "k": K.ravel(), "d": [0.0] * 5}
    return CameraInfo(**(values | changes))


def refusal(kind: type[GssegError], call: Any, *arguments: Any) -> str:
    """Message of the error, which names its topic and says what was expected."""
    with pytest.raises(kind) as caught:
        call(*arguments)
    message = str(caught.value)
    assert type(caught.value) is kind
    assert "\n" not in message
    assert "/some/topic" in message
    assert "expected" in message
    return message
