"""Grounded SAM 2: a JSON file per image, as its demos write it, with the class and the RLE of each detection.

The smaller mask is on top, so that what stands on a table shows.
"""

from __future__ import annotations

from gsseg_core.data.mask_formats.coco import segmentation
from gsseg_core.data.mask_formats.named import NamedDrawing, NamedShape
from gsseg_core.data.mask_formats.place import Place
from gsseg_core.data.mask_formats.record import Record
from gsseg_core.data.mask_formats.shapes import Runs


def is_grounded_sam(place: Place) -> bool:
    """Recognise Grounded SAM 2: an object with the list `annotations`, and `img_width`."""
    return place.sample_has(annotations=list, img_width=object)


def parse_grounded_sam(whole: Record) -> NamedDrawing:
    """Read the shapes of an image, as `read_named` has it."""
    size = whole.size("img_width", "img_height")
    return NamedDrawing(size, (_shape(found, *size) for found in whole.records("annotations", "annotation")))


def _shape(found: Record, width: int, height: int) -> NamedShape:
    region = segmentation(found, width, height)
    return NamedShape(found.class_name("class_name"), region, -region.area if isinstance(region, Runs) else 0.0)
