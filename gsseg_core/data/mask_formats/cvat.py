"""CVAT for images 1.1: one XML file with polygons and masks of all images.

Classes are numbered from 1 in the order of the task's labels. Shapes of a higher `z_order` are on top, and of those of
one the last. Tags say nothing of pixels and are left out; boxes and other shapes that are no outline are refused.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple
from xml.parsers import expat

from gsseg_core.data.mask_formats.masks import MaskSet, ViewMask, check_name, names_of, number_names
from gsseg_core.data.mask_formats.place import Place
from gsseg_core.data.mask_formats.record import Record
from gsseg_core.data.mask_formats.rle import run_lengths, runs_to_mask
from gsseg_core.data.mask_formats.shapes import Bitmap, Drawing, Polygons, Region, Shape
from gsseg_core.errors import MaskFormatError
from gsseg_core.text import clipped, quoted

_REFUSED = ("box", "ellipse", "polyline", "points", "cuboid", "skeleton", "track")


class _Annotation(NamedTuple):
    z_order: int
    name: str
    region: Region


class _Image(NamedTuple):
    where: str
    size: tuple[int, int]
    annotations: list[_Annotation]


def is_cvat(place: Place) -> bool:
    """Recognise CVAT: XML whose first element is `annotations`."""
    path = place.only(".xml")
    return path is not None and place.holds(path, rb"(?:\xef\xbb\xbf)?\s*(?:<\?[^>]*>|<!--[^>]*>|\s)*<annotations[\s>]")


def read_cvat(place: Place) -> MaskSet:
    """Read CVAT for images."""
    path = place.only(".xml")
    assert path is not None
    reader = _Reader(path, place)
    parser = expat.ParserCreate()
    parser.StartDoctypeDeclHandler = reader.refuse_doctype  # With it, all entities are refused.
    parser.StartElementHandler, parser.EndElementHandler = reader.start, reader.end
    parser.CharacterDataHandler = reader.text
    try:
        parser.Parse(place.read(path), True)
    except (expat.ExpatError, ValueError, LookupError) as cause:  # The others are of encodings that expat has not.
        raise MaskFormatError(f"{path}: not valid XML ({cause}); expected an export as CVAT for images 1.1") from cause
    names = dict.fromkeys(reader.names)
    names |= dict.fromkeys(found.name for image in reader.images.values() for found in image.annotations)
    numbers = number_names(names, str(path))
    views = {}
    for view, image in reader.images.items():
        ordered = sorted(image.annotations, key=lambda annotation: annotation.z_order)
        shapes = [Shape(numbers[annotation.name], annotation.region) for annotation in ordered]
        views[view] = ViewMask.of(Drawing(*image.size, shapes), image.where)
    return MaskSet(views, names_of(numbers))


class _Reader:
    """What is read of the XML, element by element: names of labels, and images by view."""

    def __init__(self, path: Path, place: Place) -> None:
        self.names: list[str] = []
        self.images: dict[str, _Image] = {}
        self._path, self._place = path, place
        self._open: list[str] = []  # elements that are open, the innermost last
        self._text: list[str] = []  # of the name of a label
        self._image: _Image | None = None

    def refuse_doctype(self, *_: object) -> None:
        raise MaskFormatError(f"{self._path}: has a document type declaration; expected XML without, as CVAT writes it")

    def start(self, element: str, attributes: dict[str, str]) -> None:
        self._open.append(element)
        where = self._image.where if self._image else str(self._path)
        if element in _REFUSED and self._open[1:-1] in ([], ["image"]):
            raise MaskFormatError(
                f"{where}: has a {element}, which is no outline in one image; "
                "expected polygons and masks, exported as CVAT for images 1.1"
            )
        if element == "image":
            self._start_image(attributes)
        elif self._image is not None and element in ("polygon", "mask") and self._open[-2] == "image":
            count = len(self._image.annotations)
            self._image.annotations.append(_annotation(element, attributes, f"{self._image.where}, {element} {count}"))

    def end(self, element: str) -> None:
        if self._open[-3:] == ["labels", "label", "name"]:
            self.names.append(check_name("".join(self._text), str(self._path)))
        self._open.pop()
        self._text.clear()
        if element == "image":
            self._image = None

    def text(self, text: str) -> None:
        if self._open[-3:] == ["labels", "label", "name"]:
            self._text.append(text)

    def _start_image(self, attributes: dict[str, str]) -> None:
        name = attributes.get("name", "")
        view, where = self._place.view_of(name), f"{self._path}, image {quoted(name)}"
        width, height = (_whole(attributes, key, where) for key in ("width", "height"))
        self._image = _Image(where, Record(where, {"width": width, "height": height}).size("width", "height"), [])
        if view in self.images:
            raise MaskFormatError(f"{self._path}: has two images for view '{view}'; expected one for each")
        if view is not None:
            self.images[view] = self._image


def _annotation(element: str, attributes: dict[str, str], where: str) -> _Annotation:
    name = check_name(attributes.get("label"), where)
    z_order = _whole(attributes, "z_order", where, "0")
    if element == "polygon":
        points = [_numbers(point, where) for point in attributes.get("points", "").split(";")]
        return _Annotation(z_order, name, Polygons.of(points, where))
    left, top, width, height = (_whole(attributes, key, where) for key in ("left", "top", "width", "height"))
    size = Record(where, {"width": width, "height": height}).size("width", "height")
    rle = attributes.get("rle", "").split(",")
    runs = run_lengths([_whole({"rle": run.strip()}, "rle", where) for run in rle], where)
    return _Annotation(z_order, name, Bitmap(left, top, runs_to_mask(runs, *size, where, order="C")))


def _numbers(text: str, where: str) -> list[float]:
    try:
        return [float(number) for number in text.split(",")]
    except ValueError as cause:
        raise MaskFormatError(f"{where}: has {clipped(repr(text[:200]))}; expected numbers") from cause


def _whole(attributes: dict[str, str], key: str, where: str, default: str = "") -> int:
    text = attributes.get(key, default)
    if not re.fullmatch(r"-?[0-9]{1,18}", text):
        raise MaskFormatError(f"{where}: '{key}' is {quoted(text[:200])}; expected a whole number")
    return int(text)
