"""Formats with shapes that name their class, as a rule in a JSON file per image: what they have in common.

Classes are numbered from 1 in alphabetical order. A file is read once for its names, and again when its view is asked
for, so that no more than one is in memory.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gsseg_core.data.mask_formats.masks import MaskSet, ViewMask, names_of, number_names
from gsseg_core.data.mask_formats.place import Place
from gsseg_core.data.mask_formats.record import Record
from gsseg_core.data.mask_formats.shapes import Drawing, Region, Shape
from gsseg_core.errors import MaskFormatError
from gsseg_core.scene.camera import Camera


class NamedShape(NamedTuple):
    """A region with the name of its class; of a higher layer, it is on top."""

    name: str
    region: Region
    layer: float = 0.0


class NamedDrawing(NamedTuple):
    """Shapes of one image, and its width and height."""

    size: tuple[int, int]
    shapes: Iterable[NamedShape]

    def numbered(self, numbers: Mapping[str, int]) -> Drawing:
        """Give the shapes the ids of their classes; the highest layer is on top, and of one layer the last shape."""
        ordered = sorted(self.shapes, key=lambda shape: shape.layer)
        return Drawing(*self.size, [Shape(numbers[name], region) for name, region, _ in ordered])


Parser = Callable[[Record], NamedDrawing]


def read_named(place: Place, parse: Parser) -> MaskSet:
    """Read the files of all views with a parser of their JSON; raises what that raises."""
    files = place.by_view(".json")
    names: set[str] = set()
    sizes = {}
    for view, path in files.items():
        sizes[view], shapes = parse(_open(place, path))
        names.update(shape.name for shape in shapes)
    numbers = number_names(sorted(names), str(place.path))
    views = {
        view: ViewMask(str(path), partial(_read, place, path, parse, numbers), sizes[view])
        for view, path in files.items()
    }
    return MaskSet(views, names_of(numbers))


def _open(place: Place, path: Path) -> Record:
    return Record.of(place.json(path), str(path))


def _read(place: Place, path: Path, parse: Parser, numbers: dict[str, int], camera: Camera) -> npt.NDArray[np.int32]:
    try:
        drawing = parse(_open(place, path)).numbered(numbers)
    except KeyError as cause:
        raise MaskFormatError(
            f"{path}: has other classes than when it was first read; expected a file that stays"
        ) from cause
    return drawing.labels(camera, str(path))
