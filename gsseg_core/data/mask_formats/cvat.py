"""CVAT for images 1.1: one XML file with polygons and masks of all images.

Classes are numbered from 1 in the order of the task's labels. Shapes of a higher `z_order` are on top, and of those of
one the last. Tags say nothing of pixels and are left out; boxes and other shapes that are no outline are refused.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

from gsseg_core.data.mask_formats.masks import MaskSet, ViewMask, check_name, names_of, number_names
from gsseg_core.data.mask_formats.named import NamedDrawing, NamedShape
from gsseg_core.data.mask_formats.place import Place
from gsseg_core.data.mask_formats.record import Record
from gsseg_core.data.mask_formats.rle import run_lengths, runs_to_mask
from gsseg_core.data.mask_formats.shapes import Bitmap, Polygons
from gsseg_core.errors import MaskFormatError
from gsseg_core.text import clipped, quoted

_REFUSED = ("box", "ellipse", "polyline", "points", "cuboid", "skeleton", "track")


def is_cvat(place: Place) -> bool:
    """Recognise CVAT: XML whose first element is `annotations`."""
    path = place.only(".xml")
    return path is not None and place.holds(path, rb"(?:\xef\xbb\xbf)?\s*(?:<\?[^>]*>|<!--[^>]*>|\s)*<annotations[\s>]")


def read_cvat(place: Place) -> MaskSet:
    """Read CVAT for images."""
    path = place.only(".xml")
    assert path is not None
    root = _parsed(place.read(path), path)
    _check_outlines(root, str(path))
    names = [check_name(name.text, str(path)) for name in root.iterfind(".//labels/label/name")]
    images = place.views(((image.get("name", ""), image) for image in root.iterfind("image")), path)
    drawings = {}
    for view, image in images.items():
        where = f"{path}, image {quoted(image.get('name'))}"
        drawings[view] = where, _drawing(image, where)
    names += [shape.name for _, drawing in drawings.values() for shape in drawing.shapes]
    numbers = number_names(names, str(path))
    views = {view: ViewMask.of(drawing.numbered(numbers), where) for view, (where, drawing) in drawings.items()}
    return MaskSet(views, names_of(numbers))


def _parsed(content: bytes, path: Path) -> ElementTree.Element:
    class Builder(ElementTree.TreeBuilder):
        def doctype(self, *_: object) -> None:  # With it, all entities are refused.
            raise MaskFormatError(f"{path}: has a document type declaration; expected XML without, as CVAT writes it")

    try:
        return ElementTree.fromstring(content, ElementTree.XMLParser(target=Builder()))
    except (ElementTree.ParseError, ValueError, LookupError) as cause:  # The last two: of encodings.
        raise MaskFormatError(f"{path}: not valid XML ({cause}); expected an export as CVAT for images 1.1") from cause


def _check_outlines(shapes: ElementTree.Element, where: str) -> None:
    """Raise `MaskFormatError` if an element holds shapes that are no outline in one image."""
    if refused := next((shape.tag for shape in shapes if shape.tag in _REFUSED), None):
        raise MaskFormatError(
            f"{where}: has a {refused}, which is not an outline in one image; "
            "expected polygons and masks, exported as CVAT for images 1.1"
        )


def _drawing(image: ElementTree.Element, where: str) -> NamedDrawing:
    _check_outlines(image, where)
    shapes = [shape for shape in image if shape.tag in ("polygon", "mask")]
    named = [_shape(shape, f"{where}, {shape.tag} {i}") for i, shape in enumerate(shapes)]
    return NamedDrawing(_size(image.attrib, where), named)


def _shape(shape: ElementTree.Element, where: str) -> NamedShape:
    attributes = shape.attrib
    name = check_name(attributes.get("label"), where)
    z_order = _whole(attributes, "z_order", where, "0")
    if shape.tag == "polygon":
        points = [_numbers(point, where) for point in attributes.get("points", "").split(";")]
        return NamedShape(name, Polygons.of(points, where), z_order)
    left, top = (_whole(attributes, key, where) for key in ("left", "top"))
    rle = attributes.get("rle", "").split(",")
    runs = run_lengths([_whole({"rle": run.strip()}, "rle", where) for run in rle], where)
    inside = runs_to_mask(runs, *_size(attributes, where), where, order="C")
    return NamedShape(name, Bitmap(left, top, inside), z_order)


def _size(attributes: Mapping[str, str], where: str) -> tuple[int, int]:
    sides = {key: _whole(attributes, key, where) for key in ("width", "height")}
    return Record(where, sides).size("width", "height")


def _numbers(text: str, where: str) -> list[float]:
    try:
        return [float(number) for number in text.split(",")]
    except ValueError as cause:
        raise MaskFormatError(f"{where}: has {clipped(repr(text[:200]))}; expected numbers") from cause


def _whole(attributes: Mapping[str, str], key: str, where: str, default: str = "") -> int:
    text = attributes.get(key, default)
    if not re.fullmatch(r"-?[0-9]{1,18}", text):
        raise MaskFormatError(f"{where}: '{key}' is {quoted(text[:200])}; expected a whole number")
    return int(text)
