"""COCO: one JSON file with images, annotations and categories; polygons, and RLE as text or numbers."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

from gsseg_core.data.mask_formats.masks import MaskSet, ViewMask, ids_from_zero
from gsseg_core.data.mask_formats.place import Place, view_of
from gsseg_core.data.mask_formats.record import Record
from gsseg_core.data.mask_formats.rle import run_lengths
from gsseg_core.data.mask_formats.shapes import Drawing, Polygons, Region, Runs, Shape
from gsseg_core.errors import MaskFormatError
from gsseg_core.text import quoted


def is_coco(place: Place) -> bool:
    """Recognise COCO: an object with the lists `images` and `annotations`."""
    return place.sample_has(images=list, annotations=list)


def read_coco(place: Place) -> MaskSet:
    """Read COCO: ids are those of the categories, one more where 0 is an object; the last annotation is on top."""
    path, content = place.sample
    whole = Record.of(content, str(path))
    categories = whole.records("categories", "category")
    names = {category.id("id"): category.class_name("name") for category in categories}
    labels = ids_from_zero(names)
    shapes: defaultdict[object, list[Shape]] = defaultdict(list)
    images = _images(whole, place, path)
    annotations = list(whole.records("annotations", "annotation"))
    if annotations and "segments_info" in annotations[0].fields:
        raise MaskFormatError(
            f"{path}: is of COCO's panoptic form, whose masks are images in colours; expected polygons or RLE: export "
            "it as instances"
        )
    _check_meet(whole, annotations)
    for annotation in annotations:
        image_id = annotation.value("image_id")
        if not isinstance(image_id, (int, str)) or image_id not in images:
            continue
        category = annotation.id("category_id")
        if category not in labels:
            raise MaskFormatError(
                f"{annotation.where}: has the category {category}; expected one that 'categories' has"
            )
        width, height = images[image_id][2]
        region = segmentation(annotation, width, height)
        shapes[image_id].append(Shape(labels[category], region))
    views = {
        view: ViewMask.of(Drawing(*size, shapes[image_id]), where) for image_id, (view, where, size) in images.items()
    }
    return MaskSet(views, {labels[i]: name for i, name in names.items() if labels[i] > 0})


def segmentation(annotation: Record, width: int, height: int) -> Region:
    """Read `segmentation` of an annotation: polygons, or runs for an image of this size."""
    value, where = annotation.value("segmentation"), annotation.where
    if isinstance(value, dict):
        runs = Record.of(value, where)
        if runs.value("size") != [height, width]:
            raise MaskFormatError(
                f"{where}: its runs are for {quoted(runs.value('size'))} pixels; expected [{height}, {width}], the "
                "height and width of the image"
            )
        return Runs(run_lengths(runs.value("counts"), where), where)
    if not isinstance(value, list) or not value:
        raise MaskFormatError(f"{where}: has no segmentation, perhaps a box; expected polygons or RLE")
    rings = [ring for polygon in value for ring in Polygons.of(polygon, where).rings]
    return Polygons(rings, where)


def _check_meet(whole: Record, annotations: list[Record]) -> None:
    """Raise `MaskFormatError` if no annotation is of an image of the file: all views would be background."""
    listed = [i for image in whole.records("images", "image") if isinstance(i := image.value("id"), (int, str))]
    named = {i for annotation in annotations if isinstance(i := annotation.value("image_id"), (int, str))}
    if annotations and listed and named.isdisjoint(listed):
        found = annotations[0]
        raise MaskFormatError(
            f"{found.where}: is of the image {quoted(found.value('image_id'))}, and so is none of the "
            f"{len(annotations):,} of an image that 'images' has; expected ids such as {quoted(listed[0])}"
        )


def _images(whole: Record, place: Place, path: Path) -> dict[object, tuple[str, str, tuple[int, int]]]:
    """View, place for messages, and size of each image that is a view, by the id of the image."""
    found: dict[object, tuple[str, str, tuple[int, int]]] = {}
    named = ((_name(image, place), image) for image in whole.records("images", "image"))
    for view, image in place.views(named, path).items():
        image_id = image.value("id")
        if not isinstance(image_id, (int, str)) or image_id in found:
            raise MaskFormatError(f"{image.where}: has the id {quoted(image_id)}; expected another one for each image")
        where = f"{path}, image {quoted(image.text('file_name'))}"
        found[image_id] = (view, where, image.size("width", "height"))
    return found


def _name(image: Record, place: Place) -> str:
    """Name by which an image may be of a view: that of its file, or the one that it had before Roboflow renamed it."""
    name, extra = image.text("file_name"), image.fields.get("extra")
    given = extra.get("name") if isinstance(extra, dict) else None
    return given if isinstance(given, str) and view_of(name, place.stems) is None else name
