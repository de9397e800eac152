"""Hints at the end of error messages: where the cameras or masks are that a dataset folder lacks, and what to type.

The folder was refused already; a hint tells of cameras or masks that lie near the place where they were looked for.
"""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Callable, Collection
from contextlib import suppress
from itertools import product
from pathlib import Path

from gsseg_core.data.camera_formats.table import CAMERA_FORMATS
from gsseg_core.data.label_images import mask_header
from gsseg_core.data.mask_files import mask_files, masks_below
from gsseg_core.data.mask_formats.place import SUPERVISES, Place
from gsseg_core.data.mask_formats.table import open_masks
from gsseg_core.errors import GssegError
from gsseg_core.files.input_files import READABLE_IMAGES, list_folder
from gsseg_core.text import counted

# Camera files of other programs, and how one gets from each to one that is read.
_FOREIGN_CAMERAS = {
    "poses_bounds.npy": "it is LLFF's: run nerfstudio's ns-process-data, or COLMAP, on the photos",
    "cameras.xml": "it is Metashape's: run nerfstudio's ns-process-data metashape on it",
    "sfm_data.json": "it is OpenMVG's: run openMVG_main_openMVG2Colmap -i sfm_data.json -o sparse",
    "reconstruction.json": "it is OpenSfM's: run opensfm export_colmap on its folder",
    "mesh_info.json": "it is Polycam's raw data: run nerfstudio's ns-process-data polycam on it",
    "database.db": "it is COLMAP's database without a model: run `colmap mapper`, and give the folder with its sparse/",
    "metadata.json": "if it is Record3D's, run nerfstudio's ns-process-data record3d on the folder",
}
_MODELS = (("cameras.bin", "images.bin"), ("cameras.txt", "images.txt"))  # COLMAP's, what is read of them
FRAME_HINT = (
    "; cameras and scene may be in different frames: try --align, or gsseg doctor DATASET --scene SCENE. Or all of the "
    "scene is nearer to the cameras than 0.01 of its units, where nothing is drawn"
)
_MASKS = READABLE_IMAGES | {".npy", ".npz", ".json"}
_OF_MASKS = re.compile("mask|label|seg|^ann", re.IGNORECASE)  # what people call folders of masks
_MORE = "docs/masks.md has all forms"
_DEPTH = 3
_MOST_FOLDERS, _MOST_FILES = 200, 20


def camera_hint(folder: Path) -> str:
    """Hint at cameras near a dataset folder that has none; "" where there are none."""
    if folder.is_file():
        return f"; it is a file: type --data {_quoted(folder.parent)}"
    if not folder.is_dir():
        near = [path for path in _subfolders(folder.parent) if _has_cameras(path)]
        return f"; {near[0]} has cameras: type --data {_quoted(near[0])}" if near else ""
    if model := [files for files in _MODELS if all((folder / name).is_file() for name in files)]:
        sparse, links = _quoted(folder / "sparse"), " ".join(f"../{name}" for name in model[0])
        return f"; found COLMAP's {' and '.join(model[0])}: type mkdir {sparse} && ln -s {links} {sparse}"
    is_dataset = any((folder / name).is_dir() for name in ("labels", "images"))
    near = [path for path in [*_folders(folder), folder.parent] if _has_cameras(path)]
    if near and not is_dataset:
        return f"; found cameras in {near[0]}: type --data {_quoted(near[0])}"
    for below, known in product(_folders(folder), CAMERA_FORMATS):
        with suppress(GssegError):
            if found := known.find_in(below):
                # ns-process-data writes cameras into a sub-folder, and masks lie here: a link puts the two together.
                # Where there is a folder sparse/ already, with sparse/1 in it, a link of this name would go into it.
                free = (name for name in reversed(known.folders) if not (folder / name).is_dir())
                place = folder / next(free, found.name)
                return f"; found cameras in {found}: type ln -s {_quoted(found.resolve())} {_quoted(place)}"
    for name, advice in _FOREIGN_CAMERAS.items():
        if (folder / name).is_file():
            return f"; found {name}: {advice}"
    with suppress(GssegError):
        names = [path.name + "/" * os.path.isdir(path) for path in list_folder(folder, GssegError, None)]
        return f"; found {', '.join(names[:8])}{' ...' if len(names) > 8 else ''}" if names else "; the folder is empty"
    return ""


def mask_hint(root: Path, labels: str, stems: Collection[str]) -> str:
    """Hint at masks of the cameras' names `stems`, if a dataset has none in its sub-folder `labels`."""
    stem, folder = next(iter(stems), "<stem>"), root / labels
    looked = f"; looked for {folder}/{stem}.png ({stem}.npz, or a folder {stem}/) and so on"
    for_each = f"for each view, {labels}/{stem}/<class id>.png ({_MORE})"
    expected = f"label images as PNG, and probabilities as {stem}.npz or {stem}/<class id>.tif ({_MORE})"
    with suppress(GssegError, OSError):
        if (masks := open_masks(Place(folder, frozenset(stems)))) and all(mask.blank for mask in masks.views.values()):
            return f"; {folder} lists {counted(len(masks.views), 'image')} of these names, and no shape in any of them"
    if classes := _folders_by_class(folder, stems):
        wrong = f"{labels}/ has a folder for each class, such as {classes[0].name}/"
        return f"{looked}, but {wrong}: make one {for_each}"
    if found := _masks_elsewhere(root, labels, stems):
        count, name = found
        where = name + "/" * (root / name).is_dir()
        return f"{looked}, found {count} masks of these names in {where}: type --labels {shlex.quote(name)}"
    if folder.is_symlink() and not folder.exists():
        return f"{looked}, but {labels} is a link to {os.readlink(folder)}, which does not exist"
    if not folder.is_dir():
        return f"{looked}, but {_seen_instead(root, labels, stems, expected)}"
    there = [path for path in _entries(folder) if path.suffix.lower() in _MASKS or _has_detections(path)]
    there = [path for path in there if path.name != SUPERVISES]
    if not there:
        return f"{looked}, but {labels}/ holds no mask"
    if there[0].is_file() and there[0].suffix.lower() not in (".png", ".npz"):
        return f"{looked}, but {labels}/ holds files such as {there[0].name}; expected {expected}"
    several = sum(path.stem.startswith((f"{stem}_", f"{stem}-")) for path in there) > 1
    fix = f", several of a view: make a folder {for_each}" if several else ": rename them to the names of the images"
    return f"{looked}, but {labels}/ holds names such as {there[0].name}{fix}"


def _masks_elsewhere(root: Path, labels: str, stems: Collection[str]) -> tuple[int, str] | None:
    """Count masks of the cameras' names in the place that has most of them; with its name, as `--labels` takes it."""
    below = (root / labels).resolve()
    outside = not below.is_relative_to(root.resolve())
    wanted, counts = frozenset(stems), []
    for path, depth in _places_of_masks(root, labels, outside=outside).items():
        there = Place(path, wanted, depth=depth)
        counts.append((len(_masks(mask_files, there)) or _count_foreign(there), path))
    # A folder that was named may be one too high; what lies beside it is perhaps something else, as true masks are.
    count, place = max(
        counts, key=lambda found: (found[0] > 0 and below in found[1].resolve().parents, found[0]), default=(0, root)
    )
    if not count:
        return None
    if (more := len(_masks(masks_below, Place(place.parent, wanted)))) > count and place.parent != root:
        count, place = more, place.parent
    return count, str(place) if outside and place.is_relative_to(root / labels) else os.path.relpath(place, root)


def _seen_instead(root: Path, labels: str, stems: Collection[str], expected: str) -> str:
    """Say that there is no folder of masks, and what the folders are whose files have the cameras' names."""
    folders = [path for path in _folders(root) if _stems(path) & set(stems)]
    if folder := next((path for path in folders if _OF_MASKS.search(path.name)), None):
        name = next(path.name for path in _entries(folder) if path.stem in stems)
        return f"{folder.relative_to(root)}/ holds files such as {name}; expected {expected}"
    hint = f" ({folders[0].name}/ holds photos; a 2D segmenter makes masks of them)" if folders else ""
    return f"there is no folder {labels}/{hint}"


def _places_of_masks(root: Path, labels: str, *, outside: bool) -> dict[Path, int]:
    """List folders and files in which masks may be, but for `labels` itself, and how far below each to look."""
    tops = [root, root / labels] if outside else [root]
    places = {
        path: _DEPTH - len(path.relative_to(top).parts) for top in tops for path in (*_folders(top), *_annotations(top))
    }
    for folder in (root / labels, *_subfolders(root / labels)):  # of several files, one perhaps for test views
        places |= dict.fromkeys(_annotations(folder), 0)
    places.pop(root / labels, None)
    return places


def _has_cameras(folder: Path) -> bool:
    with suppress(GssegError):
        return any(known.find(folder) for known in CAMERA_FORMATS)
    return False


def _folders(root: Path) -> list[Path]:
    """List folders below one, the nearest first, to a depth and up to a number: a capture may be large."""
    found: list[Path] = []
    level = [root]
    for _ in range(_DEPTH):
        below = [path for folder in level for path in _subfolders(folder)]
        found, level = found + below, below
    return found[:_MOST_FOLDERS]


def _entries(folder: Path) -> list[Path]:
    """List what is in a folder and not hidden, sorted; nothing where one may not look."""
    with suppress(GssegError):
        return list_folder(folder, GssegError, None)
    return []


def _subfolders(folder: Path) -> list[Path]:
    return [path for path in _entries(folder) if os.path.isdir(path)]


def _stems(folder: Path) -> set[str]:
    return {path.stem for path in _entries(folder) if path.suffix.lower() in _MASKS}


def _masks(finder: Callable[[Place], dict[str, Path]], place: Place) -> list[Path]:
    """List the masks of views, of every kind; none where the first label image is a photo."""
    with suppress(GssegError, OSError):
        found = list(finder(place).values())
        images = [path for path in found if path.suffix.lower() == ".png"]
        if images:
            mask_header(images[0])
        return [path for path in found if path.is_file() or _has_detections(path)]
    return []


def _count_foreign(place: Place) -> int:
    """Count the masks of views that another program wrote."""
    with suppress(GssegError, OSError):
        masks = open_masks(place)
        return 0 if masks is None else sum(not mask.blank for mask in masks.views.values())
    return 0


def _annotations(root: Path) -> list[Path]:
    """List the files in a folder that may hold the masks of all views."""
    return [path for path in _entries(root) if path.suffix.lower() in (".json", ".xml")][:_MOST_FILES]


def _has_detections(folder: Path) -> bool:
    """Whether a folder may hold what detectors of one class each say of a view: images that are named by numbers."""
    return folder.is_dir() and any(stem.isdecimal() for stem in _stems(folder))


def _folders_by_class(folder: Path, stems: Collection[str]) -> list[Path]:
    """List folders with images of several views, if there is one for each class, as some detectors write them."""
    wanted = set(stems)
    found = [path for path in _subfolders(folder) if _stems(path) & wanted and path.name not in wanted]
    return found if len(found) > 1 or any(path.name.isdecimal() for path in found) else []


def _quoted(path: Path) -> str:
    return shlex.quote(str(path))
