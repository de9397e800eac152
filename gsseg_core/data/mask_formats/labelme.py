"""LabelMe: a JSON file per image, with shapes that name their class: polygons, rectangles, circles and masks.

Rectangles may be turned. `_background_` is 0 and `__ignore__` unknown, as in LabelMe's own converters. The last shape
is on top.
"""

from __future__ import annotations

import base64
import io

import numpy as np
import numpy.typing as npt

from gsseg_core.data.mask_formats.named import NamedDrawing, NamedShape
from gsseg_core.data.mask_formats.place import Place
from gsseg_core.data.mask_formats.record import Record
from gsseg_core.data.mask_formats.shapes import Bitmap, Polygons, Region
from gsseg_core.errors import MaskFormatError
from gsseg_core.files.input_files import decode_image
from gsseg_core.text import quoted

_CORNERS = 90  # of the polygon that stands for a circle
_KINDS = ("rectangle", "circle", "mask")


def is_labelme(place: Place) -> bool:
    """Recognise LabelMe: an object with the list `shapes`, and `imagePath` or `imageHeight`."""
    return any(place.sample_has(shapes=list, **{key: object}) for key in ("imagePath", "imageHeight"))


def parse_labelme(whole: Record) -> NamedDrawing:
    """Read the shapes of an image, as `read_named` has it."""
    size = whole.size("imageWidth", "imageHeight")
    return NamedDrawing(size, (NamedShape(s.class_name("label"), _region(s)) for s in whole.records("shapes", "shape")))


def _region(shape: Record) -> Region:
    kind = shape.fields.get("shape_type") or "polygon"
    outline = Polygons.of(shape.value("points"), shape.where)
    points = outline.rings[0]
    if kind in ("polygon", "oriented_rectangle", "rotation"):  # the last one is X-AnyLabeling's
        return outline
    if kind not in _KINDS:
        raise MaskFormatError(
            f"{shape.where}: is of the kind {quoted(kind)}; expected what has an area: a polygon, {', '.join(_KINDS)}"
        )
    if len(points) != 2 and not (kind == "rectangle" and len(points) == 4):
        raise MaskFormatError(f"{shape.where}: has {len(points):,} points; expected the 2 of a {kind}")
    low, high = points.min(axis=0), points.max(axis=0)
    if kind == "rectangle":
        return Polygons([np.array([low, (high[0], low[1]), high, (low[0], high[1])])], shape.where)
    if kind == "circle":  # Its centre, and a point on it.
        angles = np.linspace(0, 2 * np.pi, _CORNERS, endpoint=False)
        circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        return Polygons([points[0] + np.hypot(*(points[1] - points[0])) * circle], shape.where)
    return Bitmap(int(low[0]), int(low[1]), _bitmap(shape))


def _bitmap(shape: Record) -> npt.NDArray[np.bool_]:
    """Decode the image of a mask, whose upper left corner is its first point."""
    try:
        data = base64.b64decode(shape.text("mask"), validate=True)
    except ValueError as cause:
        raise MaskFormatError(f"{shape.where}: 'mask' is no base64 ({cause}); expected a PNG in base64") from cause
    with decode_image(io.BytesIO(data), shape.where, MaskFormatError, "mask", "a PNG in base64", ("PNG",)) as image:
        values = np.array(image)
    if values.ndim != 2:
        raise MaskFormatError(f"{shape.where}: 'mask' is an image in colours; expected one channel")
    return values > 0
