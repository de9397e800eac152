"""Where the masks of a dataset are, and reading those that are no label images: probabilities and detections.

`<stem>.npz` holds what one segmenter says, `<stem>/<class id>.png` (or .tif) what detectors of one class each say, and
`supervises.json` which classes label images say something of. docs/masks.md has examples.
"""

from __future__ import annotations

import re
import struct
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image, UnidentifiedImageError

from gsseg_core.confined_files import open_input, require_folder_below
from gsseg_core.errors import MaskFormatError, MaskSizeError, SupervisesFileError, UnknownLabelError
from gsseg_core.json_files import kind_of, read_json
from gsseg_core.masks import MAX_LABEL
from gsseg_core.soft_masks import SeenLabels, combine_detections, quantise

SUPERVISES = "supervises.json"
_PROBABILITIES, _CLASSES, _UNKNOWN = "probabilities", "classes", "unknown"
_IMAGES = (".png", ".tif", ".tiff")
_ANY = "*"

# What NumPy, zipfile and zlib raise on damaged bytes; RuntimeError where a flipped bit says "encrypted".
_DAMAGED = (OSError, ValueError, TypeError, EOFError, KeyError, RuntimeError, MemoryError, SyntaxError, struct.error,
            zipfile.BadZipFile, zlib.error)  # fmt: skip


def mask_files(folder: Path, stems: Iterable[str], within: Path | None = None) -> dict[str, Path]:
    """Find the masks of views: `<stem>.png`, `<stem>.npz` or the folder `<stem>`.

    Raises
    ------
    MaskFormatError
        A view has masks of two kinds.
    PathNotAllowedError
        The folder lies outside `within`.
    """
    if not folder.is_dir():
        return {}
    require_folder_below(folder, within)
    found: dict[str, Path] = {}
    wanted = set(stems)
    for path in sorted(folder.iterdir()):
        is_folder = path.is_dir()
        if not is_folder and path.suffix.lower() not in (".png", ".npz"):
            continue
        stem = path.name if is_folder else path.stem
        if stem not in wanted:
            continue
        if stem in found:
            raise MaskFormatError(f"{folder}: has {found[stem].name} and {path.name}; expected one mask per view")
        found[stem] = path
    return found


def read_supervises(
    path: Path,
    masks: Mapping[str, Path],
    stems: Iterable[str],
    class_names: Mapping[int, str] | None,
    within: Path | None = None,
) -> dict[str, tuple[int, ...]]:
    """Read which classes each label image says something of: `{"*": [1, 3], "frame_0007": [2]}`; none if there is none.

    A stem's own entry goes before that of "*", which is for all label images without one.

    Raises
    ------
    SupervisesFileError
        The file is broken, or names a view without a camera, a mask that is no label image, or a class that there is
        not.
    PathNotAllowedError
        It lies outside `within`.
    """
    if not path.is_file():
        return {}
    content = read_json(path, SupervisesFileError, within)
    if not isinstance(content, dict):
        raise SupervisesFileError(f'{path}: holds {kind_of(content)}; expected {{"*": [ids]}} or stems and ids')
    known, entries = set(stems), {}
    for stem, ids in content.items():
        if stem != _ANY and stem not in known:
            raise SupervisesFileError(f"{path}: names the view {stem!r}, which has no camera; expected stems, or '*'")
        if stem in masks and masks[stem].suffix.lower() != ".png":
            raise SupervisesFileError(
                f"{path}: names {masks[stem].name}, which says itself what it supervises; expected label images (.png)"
            )
        if not isinstance(ids, list) or not ids or any(type(i) is not int or not 0 <= i <= MAX_LABEL for i in ids):
            raise SupervisesFileError(f"{path}: {stem!r} has {str(ids)[:60]}; expected a list of ids 0 to {MAX_LABEL}")
        strangers = [i for i in ids if class_names is not None and i not in class_names]
        if strangers:
            raise SupervisesFileError(f"{path}: {stem!r} has the class {strangers[0]}; expected ids of classes.json")
        entries[stem] = tuple(sorted(set(ids)))
    pngs = [stem for stem, mask in masks.items() if mask.suffix.lower() == ".png"]
    return {stem: entries.get(stem, entries.get(_ANY, ())) for stem in pngs if stem in entries or _ANY in entries}


def read_soft_mask(path: Path, class_names: Mapping[int, str] | None = None, within: Path | None = None) -> SeenLabels:
    """Read probabilities (.npz) or a folder of detections.

    Parameters
    ----------
    path : pathlib.Path
        The file or folder.
    class_names : mapping from id to name, optional
        If given, an npz without `classes` must have a probability for each id up to the largest.
    within : pathlib.Path, optional
        A folder below which it must lie, links followed.

    Raises
    ------
    MaskFormatError, MaskSizeError, UnknownLabelError
        It is missing or broken, or holds something else; see docs/masks.md.
    PathNotAllowedError
        It lies elsewhere.
    """
    return _read_detections(path, within) if path.is_dir() else _read_probabilities(path, class_names, within)


def _read_probabilities(path: Path, class_names: Mapping[int, str] | None, within: Path | None) -> SeenLabels:
    arrays: dict[str, npt.NDArray[np.generic]] = {}
    try:
        # Opened here, since np.load leaves a file open that it cannot read.
        with open_input(path, within) as opened, np.load(opened, allow_pickle=False) as file:
            names = list(file.files)
            for name in (_PROBABILITIES, _CLASSES, _UNKNOWN):
                if name in names:
                    arrays[name] = file[name]
    except FileNotFoundError as error:
        raise MaskFormatError(f"{path}: does not exist; expected an npz with probabilities (K, H, W)") from error
    except (*_DAMAGED, AttributeError) as error:
        raise MaskFormatError(
            f"{path}: broken npz ({error}); expected a whole one with probabilities (K, H, W)"
        ) from error
    if _PROBABILITIES not in arrays:
        raise MaskFormatError(f"{path}: holds {', '.join(names)[:60] or 'nothing'}; expected an array 'probabilities'")
    probabilities, classes = arrays[_PROBABILITIES], arrays.get(_CLASSES)
    if classes is None and class_names is not None and len(probabilities) != max(class_names) + 1:
        raise UnknownLabelError(
            f"{path}: holds probabilities of {len(probabilities)} classes; expected {max(class_names) + 1}, up to the "
            "largest id of classes.json, or an array 'classes' with their ids"
        )
    return quantise(probabilities, classes, unknown=arrays.get(_UNKNOWN), source=str(path))  # type: ignore[arg-type]


def _read_detections(folder: Path, within: Path | None) -> SeenLabels:
    require_folder_below(folder, within)
    detections: dict[int, npt.NDArray[np.generic]] = {}
    unknown = None
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() not in _IMAGES:
            continue
        if path.stem == _UNKNOWN:
            unknown = _read_image(path, within) > 0
            continue
        if not re.fullmatch(r"0|[1-9][0-9]{0,4}", path.stem) or int(path.stem) > MAX_LABEL:
            raise UnknownLabelError(f"{path}: is named {path.stem!r}; expected the id of a class, as in '12.png'")
        if int(path.stem) in detections:
            raise MaskFormatError(f"{folder}: has two images of class {path.stem}; expected one")
        detections[int(path.stem)] = _read_image(path, within)
    shapes = {array.shape for array in detections.values()}
    if unknown is not None and len(shapes) == 1 and unknown.shape not in shapes:
        raise MaskSizeError(f"{folder}: unknown has shape {unknown.shape}; expected {shapes.pop()}, as the others")
    return combine_detections(detections, unknown=unknown, source=str(folder))


def _read_image(path: Path, within: Path | None) -> npt.NDArray[np.float32]:
    """Read an image of one class, as probabilities (H, W) float32."""
    try:
        with open_input(path, within) as file, Image.open(file, formats=["PNG", "TIFF"]) as image:
            mode, values = image.mode, np.array(image)
    except (*_DAMAGED, UnidentifiedImageError) as error:
        raise MaskFormatError(f"{path}: broken image ({error}); expected probabilities of one class") from error
    if mode == "L":
        return values.astype(np.float32) / np.float32(2**8 - 1)
    if mode.startswith("I;16") or (mode == "I" and path.suffix.lower() == ".png"):
        return values.astype(np.float32) / np.float32(2**16 - 1)
    if mode == "1" or mode == "F":
        return values.astype(np.float32)
    raise MaskFormatError(f"{path}: is an image of kind {mode}; expected one channel of 8 or 16 bits, or float")
