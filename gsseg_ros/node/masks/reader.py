"""Reads what segmenters publish, whichever way, into masks of the classes of a session."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from gsseg_core.data.label_images import PER_VIEW, UNKNOWN
from gsseg_core.data.soft_masks import SeenLabels
from gsseg_core.live.session import LiveSession
from gsseg_ros.camera_infos import image_size
from gsseg_ros.conversions import require_size
from gsseg_ros.node.masks.compressed import decompress_mask
from gsseg_ros.node.masks.detections import Beside, Detected
from gsseg_ros.node.masks.encodings import mask_from_image
from gsseg_ros.node.masks.label_space import LabelSpace
from gsseg_ros.node.parameters import Settings


def read_image(message: Image | CompressedImage, topic: str, settings: Settings) -> SeenLabels:
    """Read a mask as it was sent, by the node's parameters; its labels are the segmenter's.

    Raises `MaskFormatError`: it is of another encoding, or broken; `TooManyPixelsError`: it has more pixels than the
    parameter max_pixels allows.
    """
    if isinstance(message, CompressedImage):
        message = decompress_mask(message, topic, settings.max_pixels)
    require_size(message, settings.max_pixels, topic)
    return mask_from_image(message, topic, settings.palette)


class MaskReader:
    """Reads masks by the node's parameters; `say` is told what a person should know."""

    def __init__(self, settings: Settings, label_space: LabelSpace, say: Callable[[str], None]) -> None:
        self._settings, self._label_space, self._say = settings, label_space, say

    def read(self, message: Any, topic: str, session: LiveSession, info: CameraInfo) -> SeenLabels:
        """Read a mask, an Image, a CompressedImage or `Detected`; (H, W), with evidence where it is soft.

        The session, whose classes it gets, may get new ones. Raises `MaskFormatError`, `UnknownLabelError`,
        `LabelMapError`: it is of another encoding, broken, or its labels have no meaning; `TooManyPixelsError`: it has
        more pixels than the parameter max_pixels allows.
        """
        if isinstance(message, Detected):
            return self._read_detections(message, topic, session, info)
        seen = read_image(message, topic, self._settings)
        if self._settings.ids == PER_VIEW:
            return seen
        return self._label_space.classes_of(seen, None, session, topic, self._say)

    def _read_detections(self, found: Detected, topic: str, session: LiveSession, info: CameraInfo) -> SeenLabels:
        labels = None if found.mask is None else read_image(found.mask[1], found.mask[0], self._settings).named()
        heard, size = self._label_space.heard or {}, image_size(info, "camera_info")
        beside = Beside(size, self._settings.max_pixels, labels, heard)
        labels, names = found.adapter.named_mask(found.message, topic, beside)
        if self._settings.ids == PER_VIEW:
            ignored = sorted(self._label_space.ignored(names))
            return SeenLabels(np.where(np.isin(labels, ignored), np.int32(UNKNOWN), labels))
        return self._label_space.classes_of(SeenLabels(labels), names, session, topic, self._say)
