"""Reads the masks that segmenters publish, whichever way they send them."""

from __future__ import annotations

from typing import Any

from sensor_msgs.msg import CompressedImage

from gsseg_core.data.soft_masks import SeenLabels
from gsseg_ros.node.masks.compressed import decompress_mask
from gsseg_ros.node.masks.encodings import mask_from_image
from gsseg_ros.node.parameters import Settings
from gsseg_ros.node.size_limits import require_size


class MaskReader:
    """Reads masks by the node's parameters.

    Parameters
    ----------
    settings : Settings
        Of the node.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings

    def read(self, message: Any, topic: str) -> SeenLabels:
        """Read the labels (H, W) of a mask, an Image or a CompressedImage, with their evidence where it is soft.

        Raises
        ------
        MaskFormatError
            It is of another encoding, or broken.
        TooManyPixelsError
            It has more pixels than the parameter max_pixels allows.
        """
        settings = self._settings
        if isinstance(message, CompressedImage):
            message = decompress_mask(message, topic, settings.max_pixels)
        require_size(message, settings.max_pixels, topic)
        return mask_from_image(message, topic, settings.palette)
