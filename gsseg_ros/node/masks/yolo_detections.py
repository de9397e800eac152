"""Adapter of yolo_msgs/DetectionArray, which yolo_ros publishes: detections with polygons for masks.

Messages are only looked at by the names of their fields, so that yolo_msgs is needed for the topic alone.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gsseg_core.data.class_names import BACKGROUND_NAME
from gsseg_core.data.mask_formats.shapes import Polygons, Shape, paint
from gsseg_core.errors import MaskFormatError
from gsseg_core.files.limits import LIMITS
from gsseg_ros.conversions import require_size
from gsseg_ros.node.masks.detections import Beside, NamedMask, check_count, checked_name


class Size(NamedTuple):
    """Size of an image in pixels."""

    width: int
    height: int


def named_mask(message: Any, topic: str, beside: Beside) -> NamedMask:
    """Paint polygons (DetectionArray), the surest on top; label k is the k-th detection, 0 where there is none.

    Where nothing was detected, the mask has the size of `beside`. Raises `TooManyPixelsError`: the image has more
    pixels than allowed; `MaskFormatError`: they have boxes alone, or polygons that are none, or are of images of
    different sizes.
    """
    detections = list(message.detections)
    check_count(len(detections), topic)
    sizes = {(int(d.mask.width), int(d.mask.height)) for d in detections if len(d.mask.data)}
    if detections and not sizes:
        raise MaskFormatError(
            f"{topic}: {len(detections)} detections have boxes but no masks; expected polygons in mask.data, as a "
            "segmentation model gives them (such as yolo11n-seg.pt)"
        )
    if len(sizes) > 1 or min(min(sizes, default=(1, 1))) < 1:
        raise MaskFormatError(f"{topic}: masks are of images of {sorted(sizes)} pixels; expected one size")
    size = Size(*(sizes.pop() if sizes else beside.size))
    require_size(size, beside.max_pixels, topic)
    names = {0: BACKGROUND_NAME}
    shapes = []
    for k in sorted(range(len(detections)), key=lambda k: float(detections[k].score)):
        detection = detections[k]
        names[k + 1] = checked_name(str(detection.class_name), detection.class_id, topic)
        shapes.append(Shape(k + 1, Polygons([_outline(detection.mask.data, topic)], topic)))
    return NamedMask(paint(shapes, *size), names)


def _outline(points: Any, topic: str) -> npt.NDArray[np.float64]:  # (P, 2): x, y
    outline = np.array([(point.x, point.y) for point in points], np.float64).reshape(-1, 2)
    if not (np.abs(outline) <= LIMITS.max_value).all():
        raise MaskFormatError(f"{topic}: a polygon has points that are not finite; expected pixels of an image")
    return outline
