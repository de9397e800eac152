"""Files of masks: found by view, and read where they are no label images but probabilities or detections.

`<stem>.npz` holds what one segmenter says, `<stem>/<class id>.png` (or .tif) what detectors of one class each say, and
`supervises.json` which classes were looked for in label images. docs/masks.md has examples.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt

from gsseg_core.data.mask_formats.place import SUPERVISES, Place, view_of
from gsseg_core.data.soft_masks import SeenLabels, check_forms, combine_detections, quantise
from gsseg_core.errors import MaskFormatError, SupervisesFileError, UnknownLabelError
from gsseg_core.files.input_files import is_there, list_folder, open_image
from gsseg_core.files.json_files import read_object
from gsseg_core.files.limits import MAX_LABEL
from gsseg_core.files.npz_files import NpzArrays, open_arrays
from gsseg_core.scene.camera import Camera
from gsseg_core.text import clipped, composed, quoted

DETECTIONS = (".png", ".tif", ".tiff")
_ORIENTATION, _PHOTOMETRIC = 0x0112, 0x0106  # tags of TIFF, the first of EXIF, too
CLASS_ID = r"0|[1-9][0-9]{0,4}"
_UNKNOWN = "unknown"
_ANY = "*"


def mask_files(place: Place) -> dict[str, Path]:
    """Find the masks of views: `<stem>.png`, `<stem>.npz` or the folder `<stem>`; else a file by `view_of`.

    Raises `MaskFormatError` where a view has two masks, `PathNotAllowedError` where it lies outside `Place.within`.
    """
    found: dict[str, Path] = {}
    others = []
    for path in place.entries:
        is_folder = path.is_dir()
        stem = composed(path.name if is_folder else path.stem)
        if not is_folder and path.suffix.lower() not in (".png", ".npz"):
            continue
        if stem in place.stems:
            _add(found, stem, path)
        elif not is_folder:
            others.append(path)
    longer: dict[str, Path] = {}
    for path in others:
        view = view_of(path.name, place.stems)
        if view is not None and view not in found:
            _add(longer, view, path)
    return found | longer


def masks_below(place: Place) -> dict[str, Path]:
    """Find the masks of views, by `mask_files`, or, where there is none, by `Place.views_below`."""
    return mask_files(place) or place.views_below(".png", ".npz")


def _add(found: dict[str, Path], stem: str, path: Path) -> None:
    if stem in found:
        raise MaskFormatError(f"{path.parent}: has {found[stem].name} and {path.name}; expected one mask per view")
    found[stem] = path


def read_supervises(
    place: Place, masks: Mapping[str, Path], class_names: Mapping[int, str] | None
) -> dict[str, tuple[int, ...]]:
    """Read which classes were looked for in each label image: `{"*": [1, 3], "frame_0007": [2]}`; none without a file.

    The entry of "*" is for all label images without one of their own. Raises `SupervisesFileError` where the file is
    broken, or names a view without a camera, a mask that is no label image, or a class that there is not, and
    `PathNotAllowedError` where it lies outside `Place.within`.
    """
    path = place.path / SUPERVISES
    if not is_there(path, SupervisesFileError):
        return {}
    content = read_object(path, SupervisesFileError, '{"*": [ids]} or stems and ids', place.within)
    known, entries = {*place.stems, _ANY}, {}
    for stem, ids in content.items():
        flaw, of_stem = "", f"{quoted(stem)} has"
        if stem not in known:
            flaw = f"names the view {quoted(stem)}, which has no camera; expected stems, or '*'"
        elif stem in masks and masks[stem].suffix.lower() != ".png":
            flaw = f"names {masks[stem].name}, which lists its own classes; expected label images (.png)"
        elif not isinstance(ids, list) or not ids or any(type(i) is not int or not 0 <= i <= MAX_LABEL for i in ids):
            flaw = f"{of_stem} {clipped(ids)}; expected a list of ids 0 to {MAX_LABEL}"
        elif class_names is not None and (unknown_ids := [i for i in ids if i not in class_names]):
            flaw = f"{of_stem} the class {unknown_ids[0]}; expected ids of classes.json"
        if flaw:
            raise SupervisesFileError(f"{path}: {flaw}")
        entries[stem] = tuple(sorted(set(ids)))
    pngs = [stem for stem, mask in masks.items() if mask.suffix.lower() == ".png"]
    return {stem: entries.get(stem, entries.get(_ANY, ())) for stem in pngs if stem in entries or _ANY in entries}


def read_soft_mask(
    path: Path, class_names: Mapping[int, str] | None, camera: Camera, within: Path | None = None
) -> SeenLabels:
    """Read probabilities (.npz) or a folder of detections, of the size of a camera's image.

    The size is checked before any pixel is read. With `class_names`, an npz without `classes` must have a probability
    for each id up to the largest. With `within`, it must lie below that folder, links followed (else
    `PathNotAllowedError`). Raises `MaskFormatError`, `MaskSizeError` or
    `UnknownLabelError` where it is missing or broken, or not as docs/masks.md says.
    """
    if path.is_dir():
        return _read_detections(path, camera, within)
    with open_arrays(path, "an npz with probabilities (K, H, W)", MaskFormatError, within) as arrays:
        if "probabilities" not in arrays.names:
            found = clipped(", ".join(arrays.names)) or "nothing"
            raise MaskFormatError(
                f"{path}: holds {found}; expected an array 'probabilities'; labels, one for each pixel, are PNGs "
                "(gsseg_core.data.label_images.write_mask)"
            )
        _check_claims(path, arrays, class_names, camera)
        probabilities = arrays.read("probabilities")
        classes, unknown = (arrays.read(name) if name in arrays.names else None for name in ("classes", _UNKNOWN))
    return quantise(probabilities, classes, unknown=unknown, source=str(path))  # type: ignore[arg-type]


def _check_claims(path: Path, arrays: NpzArrays, class_names: Mapping[int, str] | None, camera: Camera) -> None:
    """Check what the headers of the arrays say, before any array is read."""
    probabilities = arrays.header("probabilities")
    classes, unknown = (arrays.header(name) if name in arrays.names else None for name in ("classes", _UNKNOWN))
    shape, size = probabilities.shape, camera.image_size[::-1]
    if len(shape) == 3 and shape[:2] == size != shape[1:]:
        raise MaskFormatError(
            f"{path}: probabilities are {probabilities}, the classes last; expected (K, H, W), the classes first"
        )
    check_forms(probabilities, classes, unknown, str(path))
    count, height, width = shape
    camera.check_mask_size(width, height, str(path), drawn_on_image=True)
    if classes is None and class_names is not None and count != max(class_names) + 1:
        raise UnknownLabelError(
            f"{path}: holds probabilities of {count} classes; expected {max(class_names) + 1}, up to the largest id of "
            "classes.json, or an array 'classes' with their ids"
        )


def _read_detections(folder: Path, camera: Camera, within: Path | None) -> SeenLabels:
    detections: dict[int, npt.NDArray[np.generic]] = {}
    unknown = None
    for path in list_folder(folder, MaskFormatError, within):
        if path.suffix.lower() not in DETECTIONS:
            continue
        if path.stem == _UNKNOWN:
            unknown = _read_image(path, camera, within) > 0
            continue
        if not re.fullmatch(CLASS_ID, path.stem) or int(path.stem) > MAX_LABEL:
            raise UnknownLabelError(f"{path}: is named {path.stem!r}; expected the id of a class, as in '12.png'")
        if int(path.stem) in detections:
            raise MaskFormatError(f"{folder}: has two images of class {path.stem}; expected one")
        detections[int(path.stem)] = _read_image(path, camera, within)
    if not detections:
        there = clipped(", ".join(path.name for path in list_folder(folder, MaskFormatError, within)))
        raise MaskFormatError(
            f"{folder}: holds no detections{there and ', but '}{there}; expected an image of each class that was "
            "looked for, such as '12.png', zeros where it is not seen"
        )
    return combine_detections(detections, unknown=unknown, source=str(folder))


def _read_image(path: Path, camera: Camera, within: Path | None) -> npt.NDArray[np.float32]:
    """Read an image of one class, as probabilities (H, W) float32."""
    expected = "probabilities of one class in 8 or 16 bits, or float32"
    with open_image(path, MaskFormatError, "image", expected, ("PNG", "TIFF"), within) as image:
        tags = getattr(image, "tag_v2", {})
        turned = tags.get(_ORIENTATION, 1)
        if turned != 1:  # Pillow turns a TIFF as this says, and no other file; photos count as they are stored.
            raise MaskFormatError(f"{path}: has the orientation {turned} in its tags; expected 1, or none")
        if tags.get(_PHOTOMETRIC) == 0:  # tifffile writes booleans so, and Pillow reads the opposite of them.
            raise MaskFormatError(
                f"{path}: is a TIFF in which 0 is white, as some write booleans; expected 0 to be black, as in 8 "
                "bits of 0 and 255"
            )
        camera.check_mask_size(*image.size, str(path), drawn_on_image=True)
        mode, values = image.mode, np.array(image)
    if mode == "L":
        return values.astype(np.float32) / np.float32(2**8 - 1)
    if mode.startswith("I;16") or (mode == "I" and path.suffix.lower() == ".png"):
        return values.astype(np.float32) / np.float32(2**16 - 1)
    if mode == "1" or mode == "F":
        return values.astype(np.float32)
    raise MaskFormatError(f"{path}: is an image of kind {mode}; expected one channel of 8 or 16 bits, or float")
