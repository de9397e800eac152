"""ISAT, in which the labels of LERF's scenes are published (LERF-OVS): a JSON file per image, polygons with categories.

Objects of a higher layer are on top, and of those of one layer the last.
"""

from __future__ import annotations

from gsseg_core.data.mask_formats.named import NamedDrawing, NamedShape
from gsseg_core.data.mask_formats.place import Place
from gsseg_core.data.mask_formats.record import Record
from gsseg_core.data.mask_formats.shapes import Polygons


def is_isat(place: Place) -> bool:
    """Recognise ISAT: an object with the object `info` and the list `objects`."""
    return place.sample_has(info=dict, objects=list)


def parse_isat(whole: Record) -> NamedDrawing:
    """Read the shapes of an image, as `read_named` has it."""
    return NamedDrawing(whole.record("info").size("width", "height"), map(_shape, whole.records("objects", "object")))


def _shape(entry: Record) -> NamedShape:
    region = Polygons.of(entry.value("segmentation"), entry.where)
    return NamedShape(entry.class_name("category"), region, entry.number("layer", 0.0))
