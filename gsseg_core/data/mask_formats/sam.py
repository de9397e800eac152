"""Automatic masks of Segment Anything, as its `scripts/amg.py` writes them: a JSON list or a folder per image.

Ids hold in their own view: mask i is i + 1. Where masks overlap, the smaller one is on top, so that a part shows on its
whole. Where masks cover most of the images, the background has some, too, and pixels in none are unknown: what there
was fell short of what the generator asks for. Else they are background.
"""

from __future__ import annotations

import csv
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path

import numpy as np

from gsseg_core.data.mask_formats.images import drawing_of_objects, read_object
from gsseg_core.data.mask_formats.masks import MaskSet, ViewMask
from gsseg_core.data.mask_formats.place import Place
from gsseg_core.data.mask_formats.record import records
from gsseg_core.data.mask_formats.rle import run_lengths
from gsseg_core.data.mask_formats.shapes import Drawing, Nested, Runs, Shape
from gsseg_core.errors import GssegError, MaskFormatError
from gsseg_core.files.input_files import check_pixels
from gsseg_core.scene.camera import Camera
from gsseg_core.text import quoted

METADATA = "metadata.csv"
_MARKS = ("predicted_iou", "stability_score")
_SOME = 9  # images, at most, that tell how much of all has masks


def is_sam_json(place: Place) -> bool:
    """Recognise masks in JSON: objects with RLE in `segmentation`, and `predicted_iou` or `stability_score`."""
    first = next(iter(_listed(place.sample[1])), None)
    return isinstance(first, dict) and "segmentation" in first and any(mark in first for mark in _MARKS)


def read_sam_json(place: Place) -> MaskSet:
    """Read masks in JSON, a file per image: a list, or an object with the list `annotations`, as SA-1B has it."""
    files, size = place.by_view(".json"), _drawing(*place.sample)[:2]
    return _masks(files, partial(_read_json, place), partial(_share_of_json, place), size)


def is_sam_folder(place: Place) -> bool:
    """Recognise masks in PNGs: a folder per image, with `metadata.csv`."""
    return any(place.holds(path / METADATA, rb"id,area,bbox_x0,") for path in _folders(place).values())


def read_sam_folder(place: Place) -> MaskSet:
    """Read masks in PNGs, with their areas from `metadata.csv`."""
    return _masks(_folders(place), partial(_read_folder, place), partial(_share_of_folder, place))


def _masks(
    places: dict[str, Path],  # files or folders by view
    read: Callable[[Path, Camera], Nested],
    share_of: Callable[[Path], float],
    size: tuple[int, int] | None = None,
) -> MaskSet:
    """Make masks of all views by how one is read, and by how much of its image has masks."""
    covered = _Covered(tuple(places.values()), share_of)
    reads = {view: partial(_nested, read, covered, path) for view, path in places.items()}
    return MaskSet({view: ViewMask(str(places[view]), reads[view], size) for view in places}, per_view=True)


def _nested(read: Callable[[Path, Camera], Nested], covered: _Covered, path: Path, camera: Camera) -> Nested:
    return read(path, camera)._replace(of_everything=covered.most)


@dataclass(frozen=True)
class _Covered:
    """How much of the images has masks, by some of the files or folders of them."""

    places: tuple[Path, ...]
    share_of: Callable[[Path], float]

    @cached_property
    def most(self) -> bool:
        """Whether masks cover more than half of the median image; what is broken does not count."""
        shares = []
        for path in self.places[:: max(-(-len(self.places) // _SOME), 1)]:
            with suppress(GssegError, RecursionError):  # Who reads that mask is told.
                shares.append(self.share_of(path))
        return bool(np.median(shares or [0.0]) > 0.5)


def _read_json(place: Place, path: Path, camera: Camera) -> Nested:
    return (_opened(place, path) or Drawing(*camera.image_size, [])).nested(camera, str(path))


def _share_of_json(place: Place, path: Path) -> float:
    drawing = _opened(place, path)
    return 0.0 if drawing is None else drawing.covered(str(path))


def _opened(place: Place, path: Path) -> Drawing | None:
    """Read the masks of an image; None where nothing was found in it."""
    content = place.json(path)
    return None if content == [] else _drawing(path, content)


def _listed(content: object) -> list[object]:
    """Return the masks in a JSON file; none of another kind of file."""
    if isinstance(content, dict) and "image" in content:
        content = content.get("annotations")
    return content if isinstance(content, list) else []


def _drawing(path: Path, content: object) -> Drawing:
    regions: list[Runs] = []
    sizes: set[tuple[int, int]] = set()
    for mask in records(_listed(content), str(path), f"{path}, mask"):
        if isinstance(mask.value("segmentation"), list):
            raise MaskFormatError(
                f"{mask.where}: 'segmentation' lists pixels or points; expected RLE (output_mode='coco_rle' of SAM's "
                "generator, not 'binary_mask')"
            )
        runs = mask.record("segmentation")
        size = runs.value("size")
        if not isinstance(size, list) or len(size) != 2 or any(type(side) is not int or side < 1 for side in size):
            raise MaskFormatError(f"{mask.where}: 'size' is {quoted(size)}; expected the height and width of the image")
        sizes.add((size[1], size[0]))
        regions.append(Runs(run_lengths(runs.value("counts"), mask.where), mask.where))
    if len(sizes) != 1:
        found = "no masks" if not sizes else f"masks for images of {len(sizes)} sizes"
        raise MaskFormatError(f"{path}: has {found}; expected masks of one image")
    ((width, height),) = sizes
    check_pixels(width, height, str(path), MaskFormatError)
    shapes = [Shape(i, region) for i, region in enumerate(regions, 1)]
    return Drawing(width, height, sorted(shapes, key=lambda shape: -shape.region.area))  # type: ignore[attr-defined]


def _folders(place: Place) -> dict[str, Path]:
    """Folders with metadata by view; the place itself, if it is the folder of one view."""
    folders = [path for path in (*place.folders, place.path) if (path / METADATA).is_file()]
    return place.views(((path.name, path) for path in folders), place.path)


def _read_folder(place: Place, folder: Path, camera: Camera) -> Nested:
    return drawing_of_objects(_listed_in(place, folder), camera, place.within).nested(camera, str(folder))


def _share_of_folder(place: Place, folder: Path) -> float:
    found = None
    for _, path in _listed_in(place, folder):
        inside = read_object(path, None, place.within)
        found = inside if found is None or found.shape != inside.shape else found | inside
    return 0.0 if found is None else float(found.mean())


def _listed_in(place: Place, folder: Path) -> list[tuple[int, Path]]:
    """List the masks in a folder with their labels, the largest first."""
    try:
        rows = list(csv.DictReader(place.text(folder / METADATA).splitlines()))
    except csv.Error as cause:
        raise MaskFormatError(f"{folder / METADATA}: is not CSV ({cause}); expected a row for each mask") from cause
    masks: list[tuple[float, int, Path]] = []
    for row in rows:
        number, area = str(row.get("id")), str(row.get("area"))
        if not number.isdecimal() or not area.isdecimal() or len(number) > 6 or len(area) > 12:
            raise MaskFormatError(
                f"{folder / METADATA}: has a mask {quoted(number)} of {quoted(area)} pixels; expected whole numbers"
            )
        masks.append((-int(area), int(number) + 1, folder / f"{int(number)}.png"))
    return [(label, path) for _, label, path in sorted(masks)]
