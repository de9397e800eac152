"""EISeg: a folder with a gray PNG, a JSON list of polygons, or both for each image, and the list of labels.

The PNG `<stem>.png` counts where there is one, with its 0 for the background; else the polygons, the last on top, in
pixels of the camera's image, as no size is stated. Names are those of `autosave_label.txt` and of the polygons.
Pictures for people, `<stem>_pseudo.png` and `<stem>_cutout.png`, are left alone.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from gsseg_core.data.label_images import mask_header
from gsseg_core.data.mask_formats.images import read_label_image
from gsseg_core.data.mask_formats.masks import MaskSet, ViewMask, check_id, check_name
from gsseg_core.data.mask_formats.place import Place
from gsseg_core.data.mask_formats.record import Record, records
from gsseg_core.data.mask_formats.shapes import Drawing, Polygons, Shape
from gsseg_core.errors import MaskFormatError
from gsseg_core.scene.camera import Camera
from gsseg_core.text import quoted

_LABELS = "autosave_label.txt"
_PICTURES = ("_pseudo.png", "_cutout.png")


def is_eiseg(place: Place) -> bool:
    """Recognise EISeg: its list of labels, its pictures, or JSON lists of objects with `labelIdx` and `points`."""
    if any(path.name == _LABELS or path.name.lower().endswith(_PICTURES) for path in place.entries):
        return bool(place.by_view(".png") or place.by_view(".json"))
    content = place.sample[1]
    first = content[0] if isinstance(content, list) and content else None
    return isinstance(first, dict) and "labelIdx" in first and "points" in first


def read_eiseg(place: Place) -> MaskSet:
    """Read EISeg; its JSON files are read once for names, and again when their view is asked for."""
    texts, images = place.by_view(".json"), place.by_view(".png")
    names = _listed(place)
    for path in texts.values():
        names.update({shape.id("labelIdx"): shape.class_name("name") for shape in _shapes(place, path)})
    views = {view: ViewMask(str(path), partial(_read_polygons, place, path)) for view, path in texts.items()}
    for view, path in images.items():
        header = mask_header(path, place.within)
        read = partial(read_label_image, path, within=place.within)
        views[view] = ViewMask(str(path), read, (header.width, header.height))
    return MaskSet(views, names or None)


def _listed(place: Place) -> dict[int, str]:
    """Read the list of labels, with an id, a name and a colour in each line: names by id."""
    path, names = place.path / _LABELS, {}
    if path.is_file():
        for line in place.text(path).splitlines():
            found = re.fullmatch(r"([0-9]{1,5}) (.*?)(?: [0-9]+){0,3}", " ".join(line.split()))
            if line.strip() and found is None:
                raise MaskFormatError(f"{path}: has the line {quoted(line[:60])}; expected an id, a name and a colour")
            if found is not None:
                names[check_id(int(found[1]), str(path))] = check_name(found[2], str(path))
    return names


def _shapes(place: Place, path: Path) -> list[Record]:
    return list(records(place.json(path), str(path), f"{path}, polygon"))


def _read_polygons(place: Place, path: Path, camera: Camera) -> npt.NDArray[np.int32]:
    shapes = [
        Shape(shape.id("labelIdx"), Polygons.of(shape.value("points"), shape.where)) for shape in _shapes(place, path)
    ]
    return Drawing(*camera.image_size, shapes).labels(camera, str(path))
