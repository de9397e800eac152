"""YOLO segmentation: a text file per image, in each line a class and a polygon in shares of the image's size.

Class c is id c + 1, since its 0 is an object. Names come from `data.yaml` or else `classes.txt`, beside the texts or up
to two folders above. The last line is on top. Predictions may end a line with a confidence, the id of a track, or
both, which are left out; of an object of a pixel or two they have one or two points, which cover nothing.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

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
_TRACK = re.compile(r"\s0\.[0-9]+\s+([0-9]{1,9})\s*$")  # a confidence and an id


def is_yolo(place: Place) -> bool:
    """Recognise YOLO: the texts of views begin with lines of a class and numbers, one of four or more, or are empty."""
    files = place.by_view(".txt").values()
    return bool(files) and all(place.holds(path, _LINE) for path in files)


def read_yolo(place: Place) -> MaskSet:
    """Read YOLO; each file is read once for its classes, and again when its view is asked for."""
    files = place.by_view(".txt")
    texts = {path: place.text(path) for path in files.values()}
    tracked = _are_tracked(place.path, texts.values())
    ids = {label for path, text in texts.items() for label, _ in _lines(path, text, tracked)}
    names = _names(place)
    views = {view: ViewMask(str(path), partial(_read, place, path, tracked)) for view, path in files.items()}
    if names is None:
        names = {label - 1: f"class_{label - 1:02d}" for label in ids}
    elif lacking := sorted(ids - {c + 1 for c in names}):
        raise MaskFormatError(
            f"{place.path}: has the class {lacking[0] - 1}, which has no name in data.yaml or classes.txt"
        )
    return MaskSet(views, {c + 1: name for c, name in names.items()})


def _are_tracked(folder: Path, texts: Iterable[str]) -> bool:
    """Whether lines end with a confidence and the id of a track, which together look like a point.

    An id above 1 is no share of an image. Raises `MaskFormatError` where a track of the id 1 is all that there may be.
    """
    lines = [[line for line in text.splitlines() if len(line.split()) % 2] for text in texts]
    ids = [[int(end[1]) if (end := _TRACK.search(line)) else 0 for line in of_view] for of_view in lines]
    every = [one for of_view in ids for one in of_view]
    if len(every) > 1 and set(every) == {1} and max(map(len, ids)) == 1:
        found = quoted(" ".join(next(filter(None, lines))[0].split()[-2:]))
        raise MaskFormatError(
            f"{folder}: lines end with {found} and the like, which may be a point, or a confidence and the id of a "
            "track; expected no confidences (save_conf=False of Ultralytics)"
        )
    return max(every, default=0) > 1


def _read(place: Place, path: Path, tracked: bool, camera: Camera) -> npt.NDArray[np.int32]:
    size = camera.image_size
    shapes = []
    for i, (label, points) in enumerate(_lines(path, place.text(path), tracked), 1):
        shapes.append(Shape(label, Polygons.of((points * np.array(size)).tolist(), f"{path}, outline {i}")))
    return Drawing(*size, shapes).labels(camera, str(path))


def _lines(path: Path, text: str, tracked: bool) -> list[tuple[int, npt.NDArray[np.float64]]]:
    """Label and polygon (P, 2), in shares of width and height, of each line."""
    lines = [(f"{path}, line {i}", line.split()) for i, line in enumerate(text.splitlines(), 1)]
    are_boxes = all(_numbers(words, tracked) <= _BOX for _, words in lines)
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
        values = values[: _numbers(words, tracked)]
        if are_boxes and len(values) == _BOX:
            raise MaskFormatError(f"{where}: is a box; expected a class and the points of an outline")
        if not (np.abs(values - 0.5) <= 1).all():
            odd = values[~(np.abs(values - 0.5) <= 1)][0]
            raise MaskFormatError(f"{where}: has the coordinate {odd:g}; expected shares of the image, from 0 to 1")
        found.append((check_id(int(words[0]), where) + 1, values.reshape(-1, 2)))
    return found


def _numbers(words: list[str], tracked: bool) -> int:
    """Count the numbers of a line that are of points: all but an odd last one, or a confidence and an id."""
    count = len(words) - 1
    return count - (count % 2 or 2 * tracked)


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
