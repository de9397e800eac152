"""YOLO segmentation: a text file per image, in each line a class and a polygon in shares of the image's size.

Class c is id c + 1, since its 0 is an object. Names come from `data.yaml` or else `classes.txt`, beside the texts or up
to two folders above. The last line is on top. Predictions may end a line with a confidence, or with
the id of a track, which are left out; of an object of a pixel or two they have one or two points, which cover nothing.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gsseg_core.data.class_names import BACKGROUND_NAME
from gsseg_core.data.mask_formats.masks import MaskSet, ViewMask, check_id, check_name
from gsseg_core.data.mask_formats.place import Place
from gsseg_core.data.mask_formats.shapes import Drawing, Polygons, Shape
from gsseg_core.errors import MaskFormatError
from gsseg_core.files.yaml_files import read_yaml
from gsseg_core.scene.camera import Camera
from gsseg_core.text import quoted

_NUMBER, _END = r"(?:[ \t]+[-+0-9.eE]+)", r"[ \t]*(?:[\r\n]|$)"
_LINE = rf"(?:\xef\xbb\xbf)?\s*(?:(?:[0-9]+{_NUMBER}{{0,3}}[ \t]*[\r\n]+)*[0-9]+{_NUMBER}{{4,}}{_END}|$)".encode()
_BOX = 4


def is_yolo(place: Place) -> bool:
    """Recognise YOLO: the texts of views begin with lines of a class and numbers, one of four or more, or are empty."""
    files = place.by_view(".txt").values()
    return bool(files) and all(place.holds(path, _LINE) for path in files)


def read_yolo(place: Place) -> MaskSet:
    """Read YOLO; each file is read once for its classes, and again when its view is asked for."""
    files = place.by_view(".txt")
    ids = {label for path in files.values() for label, _ in _lines(place, path)}
    names = _names(place)
    views = {view: ViewMask(str(path), partial(_read, place, path)) for view, path in files.items()}
    if names is None:
        names = {label - 1: f"class_{label - 1:02d}" for label in sorted(ids)}
    elif lacking := sorted(ids - {c + 1 for c in names}):
        raise MaskFormatError(
            f"{place.path}: has the class {lacking[0] - 1}, which has no name in data.yaml or classes.txt"
        )
    return MaskSet(views, {0: BACKGROUND_NAME, **{c + 1: name for c, name in sorted(names.items())}})


def _read(place: Place, path: Path, camera: Camera) -> npt.NDArray[np.int32]:
    size = camera.image_size
    shapes = []
    for i, (label, points) in enumerate(_lines(place, path), 1):
        shapes.append(Shape(label, Polygons.of((points * np.array(size)).tolist(), f"{path}, outline {i}")))
    return Drawing(*size, shapes).labels(camera, str(path))


def _lines(place: Place, path: Path) -> list[tuple[int, npt.NDArray[np.float64]]]:
    """Label and polygon (P, 2), in shares of width and height, of each line."""
    lines = [(f"{path}, line {i}", line.split()) for i, line in enumerate(place.text(path).splitlines(), 1)]
    are_boxes = all(len(words) <= 2 + _BOX for _, words in lines)  # With a confidence, or without.
    found = []
    for where, words in lines:
        if not words:
            continue
        try:
            values = np.array(words[1:], np.float64)
        except ValueError:
            values = None
        if values is None or not re.fullmatch(r"[0-9]{1,5}", words[0]):
            line = quoted(" ".join(words)[:60])
            raise MaskFormatError(f"{where}: is {line}; expected a class and pairs x y from 0 to 1")
        values = values[: len(values) // 2 * 2]
        if are_boxes and len(values) == _BOX:
            raise MaskFormatError(f"{where}: is a box; expected a class and the points of an outline")
        if not (np.abs(values - 0.5) <= 1).all():
            odd = values[~(np.abs(values - 0.5) <= 1)][0]
            raise MaskFormatError(f"{where}: has the coordinate {odd:g}; expected shares of the image, from 0 to 1")
        found.append((check_id(int(words[0]), where) + 1, values.reshape(-1, 2)))
    return found


def _names(place: Place) -> dict[int, str] | None:
    """Names by class, if there are any."""
    folder = place.path if place.path.is_dir() else place.path.parent
    for above in (folder, *folder.absolute().parents[:2]):
        for name in ("data.yaml", "data.yml"):
            if (above / name).is_file():
                return _named(read_yaml(above / name, MaskFormatError, place.within), above / name)
        if (path := above / "classes.txt").is_file():
            lines = [line.strip() for line in place.text(path).splitlines()]
            return {c: check_name(line, str(path)) for c, line in enumerate(lines) if line}
    return None


def _named(content: Any, path: Path) -> dict[int, str]:
    names = content.get("names") if isinstance(content, dict) else None
    if isinstance(names, list):
        names = dict(enumerate(names))
    if not isinstance(names, dict):
        raise MaskFormatError(f"{path}: has no 'names' of classes; expected a list, or names by number")
    return {check_id(c, str(path)): check_name(name, str(path)) for c, name in names.items()}
