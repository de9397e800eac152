"""Video masks of SAM 2 with a folder per object, as its `tools/vos_inference.py --per_obj_png_file` writes them.

`001/<stem>.png` is where object 1 is in a frame. Ids are those of the objects, one more where there is an object 0;
where objects overlap, the smaller id is on top, as in the single images that SAM 2 writes without that option. (Those
are label images with a palette, and read as such.)
"""

from __future__ import annotations

from collections import defaultdict
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from gsseg_core.data.mask_formats.images import drawing_of_objects
from gsseg_core.data.mask_formats.masks import MaskSet, ViewMask
from gsseg_core.data.mask_formats.place import Place
from gsseg_core.errors import MaskFormatError
from gsseg_core.files.limits import MAX_LABEL
from gsseg_core.scene.camera import Camera


def is_sam2(place: Place) -> bool:
    """Recognise video masks: all folders are named by numbers of three digits or more, with PNGs of views in them."""
    return bool(place.folders) and all(_is_object(path) for path in place.folders) and bool(_objects(place))


def read_sam2(place: Place) -> MaskSet:
    """Read video masks."""
    objects = _objects(place)
    shift = 1 if 0 in objects else 0
    if max(objects) + shift >= MAX_LABEL:
        raise MaskFormatError(f"{place.path}: has an object {max(objects)}; expected at most {MAX_LABEL - 2}")
    views: defaultdict[str, dict[int, Path]] = defaultdict(dict)
    for number, files in sorted(objects.items(), reverse=True):
        for view, path in files.items():
            views[view][number + shift] = path
    wheres = {view: f"{place.path}, view '{view}'" for view in views}
    return MaskSet({view: ViewMask(where, partial(_read, place, views[view], where)) for view, where in wheres.items()})


def _read(place: Place, files: dict[int, Path], where: str, camera: Camera) -> npt.NDArray[np.int32]:
    return drawing_of_objects(files.items(), camera, place.within).labels(camera, where)


def _is_object(folder: Path) -> bool:
    name = folder.name
    return name.isascii() and name.isdecimal() and len(name) < 10 and name == f"{int(name):03d}"


def _objects(place: Place) -> dict[int, dict[str, Path]]:
    """Masks by view, by object; without objects that no view shows."""
    found = {}
    for folder in place.folders:
        files = (path for path in place.listed(folder) if path.suffix.lower() == ".png")
        if masks := place.views(((path.name, path) for path in files), folder):
            found[int(folder.name)] = masks
    return found
