"""Masks in the encodings of images: labels, probabilities of classes, or colours of a palette."""

from __future__ import annotations

import re

import numpy as np
import numpy.typing as npt
from sensor_msgs.msg import Image

from gsseg_core.data.soft_masks import SeenLabels, quantise
from gsseg_core.errors import MaskFormatError
from gsseg_core.text import counted
from gsseg_ros.conversions import MASK_ENCODINGS, color_from_image, labels_from_image, pixels_of
from gsseg_ros.node.masks.palette import Palette

COLORS = ("rgb8", "bgr8")
_PROBABILITIES = re.compile(r"32FC([1-9][0-9]{0,4})")


def mask_from_image(message: Image, topic: str, palette: Palette | None = None) -> SeenLabels:
    """Read a mask: labels as `labels_from_image` reads them, probabilities (32FC2 and up) or colours of a palette.

    Channel k of 32FC(K) is the probability of class k, from 0 to 1, and what the K of a pixel lack to 1 is unknown.
    Raises `MaskFormatError`: another encoding, a size of zero, data too short, a label out of range, numbers that are
    no probabilities, or a colour that is not in the palette.
    """
    encoding = message.encoding
    if probabilities := _PROBABILITIES.fullmatch(encoding):
        return _from_probabilities(message, int(probabilities[1]), topic)
    if encoding in COLORS:
        if palette is None:
            raise MaskFormatError(
                f"{topic}: encoding is '{encoding}'; expected labels as one of {', '.join(MASK_ENCODINGS)}, "
                "probabilities as 32FC2 and up, or, for colours, the parameter palette"
            )
        return SeenLabels(palette.labels(color_from_image(message, topic), topic))
    if encoding not in MASK_ENCODINGS:
        raise MaskFormatError(
            f"{topic}: encoding is '{encoding}'; expected labels as one of {', '.join(MASK_ENCODINGS)}, "
            f"probabilities as 32FC2 and up, or colours as {' or '.join(COLORS)}"
        )
    return SeenLabels(labels_from_image(message, topic))


def _from_probabilities(message: Image, channels: int, topic: str) -> SeenLabels:
    if channels == 1:
        raise MaskFormatError(
            f"{topic}: encoding is '32FC1', one number in each pixel, which does not say of what; expected a "
            "channel for each class, the background first, thus 32FC2 and up"
        )
    numbers = pixels_of(message, np.dtype(np.float32), topic, channels)
    probabilities: npt.NDArray[np.float32] = numbers.reshape(message.height, message.width, channels)
    return quantise(np.moveaxis(probabilities, -1, 0), source=f"{topic} ({counted(channels, 'class', 'classes')})")
