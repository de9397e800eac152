"""Pictures of a camera, in whichever of the usual encodings it sends them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from sensor_msgs.msg import Image

from gsseg_ros.conversions import picture_from_image, require_encoding

_CHANNELS = {"rgb8": [0, 1, 2], "rgba8": [0, 1, 2], "bgr8": [2, 1, 0], "bgra8": [2, 1, 0], "mono8": [0, 0, 0]}
"""Which channels are red, green and blue."""


def color_from_image(message: Image, topic: str) -> npt.NDArray[np.uint8]:
    """Read a camera's picture (H, W, 3) uint8, RGB; encodings are rgb8, bgr8, rgba8, bgra8 and mono8.

    Raises
    ------
    MaskFormatError
        Another encoding, a size of zero, or data too short.
    """
    require_encoding(message, topic, _CHANNELS)
    pixels = picture_from_image(message, topic).reshape(message.height, message.width, -1)
    picture: npt.NDArray[np.uint8] = pixels[..., _CHANNELS[message.encoding]]
    return picture
