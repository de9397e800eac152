"""Datasets: a folder with cameras, masks, photos, and names of classes; everything is read lazily."""

from __future__ import annotations

import copy
import os
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

from gsseg_core.data.camera_files import read_cameras
from gsseg_core.data.class_names import BACKGROUND_NAME, class_name, read_classes
from gsseg_core.data.label_images import GLOBAL, PER_VIEW
from gsseg_core.data.label_map import read_label_map
from gsseg_core.data.mask_files import masks_below, read_supervises
from gsseg_core.data.mask_formats.masks import MaskSet
from gsseg_core.data.mask_formats.place import Place, possible_stems, view_of
from gsseg_core.data.mask_formats.table import LABEL_IMAGES, open_masks
from gsseg_core.data.view import View
from gsseg_core.errors import ClassesFileError, GssegError, MaskFormatError, SettingsError, SplitFileError
from gsseg_core.files.input_files import READABLE_IMAGES, is_there, list_below, list_folder
from gsseg_core.files.json_files import read_object
from gsseg_core.scene.camera import Camera
from gsseg_core.text import clipped, quoted


def folders_of(root: str | os.PathLike[str], labels: str | os.PathLike[str] = "labels") -> tuple[Path, Path, Path]:
    """Return the folder of a dataset, where its masks are, and the folder of its photos."""
    return Path(root), Path(root, labels), Path(root, "images")


class Dataset:
    """A dataset folder: cameras, and masks in `labels/`, `<stem>.png` or others of docs/masks.md.

    Photos in `images/<stem>.jpg` (or .png, .tif, .webp, .bmp), `classes.json` and `split.json` are optional.

    Parameters
    ----------
    root : path
        The folder.
    labels : path
        The masks: their sub-folder, or a file or folder of another program, see docs/formats.md.
    label_map : path, optional
        What becomes of the masks' classes; see `gsseg_core.data.label_map`.
    within : path, optional
        If given, nothing is read that lies outside this folder once all links are followed.

    Attributes
    ----------
    root : pathlib.Path
        The folder.
    cameras : list of Camera
        All cameras, in the order of their file.
    masks : MaskSet or None
        The masks, if another program wrote them.

    Raises
    ------
    CameraFileError, PoseError, IntrinsicsError, ClassesFileError, SplitFileError, SupervisesFileError
        A file is missing or broken. A mask that is missing is no error here.
    MaskFormatError
        A view has masks of two kinds, masks of another program cannot be read, or the folder of masks or photos cannot.
    LabelMapError, SettingsError
        The label map is broken, or the masks' ids hold in their own view only.
    PathNotAllowedError
        A file or folder lies outside `within`; of a mask that is found out when it is read.
    """

    def __init__(
        self,
        root: str | os.PathLike[str],
        labels: str | os.PathLike[str] = "labels",
        *,
        label_map: str | os.PathLike[str] | None = None,
        within: str | os.PathLike[str] | None = None,
    ) -> None:
        self.root = Path(root)
        self._within = None if within is None else Path(within)
        self.cameras = read_cameras(self.root, self._within)
        classes = self.root / "classes.json"
        self._declared = read_classes(classes, self._within) if is_there(classes, ClassesFileError) else None
        self._views = {camera.name: View(camera, within=self._within) for camera in self.cameras}
        place = Place(self.root / labels, frozenset(camera.image for camera in self.cameras), self._within)
        self.masks = open_masks(place)
        if self.masks is None:
            self._take_own_masks(place)
        else:
            self._take_masks(self.masks)
        photo = self._photos(list_folder) or self._photos(list_below)
        self._change_views(lambda view: {"image_path": photo.get(view.camera.image), "class_names": self._declared})
        if label_map is not None:
            self._apply_label_map(label_map)
        self._split = _read_split(self.root / "split.json", self.cameras, self._within)

    def _photos(self, listed: Callable[[Path, type[GssegError], Path | None], list[Path]]) -> dict[str, Path]:
        """Find photos by the names of images, among those that are listed in `images`."""
        folder, names = self.root / "images", {camera.image for camera in self.cameras}
        found = listed(folder, MaskFormatError, self._within)
        photos = [path for path in found if path.suffix.lower() in READABLE_IMAGES]
        stems = ((possible_stems(str(path.relative_to(folder).with_suffix(""))), path) for path in photos)
        return {name: path for stems_of_path, path in stems for name in stems_of_path if name in names}

    def _take_own_masks(self, place: Place) -> None:
        """Find the masks of images, by their stems, in gsseg's own forms."""
        masks = masks_below(place)
        supervised = read_supervises(place, masks, self._declared)
        self._change_views(
            lambda view: {"mask_path": masks.get(view.camera.image), "supervised": supervised.get(view.camera.image)}
        )

    def _take_masks(self, masks: MaskSet) -> None:
        """Take the masks of another program, with its names of classes if it has any; blank ones are none."""
        names = self._declared if masks.class_names is None else dict(masks.class_names)
        self._declared = None if masks.per_view else names
        drawn = {image: mask for image, mask in masks.views.items() if not mask.blank}
        self._change_views(lambda view: {"foreign_mask": drawn.get(view.camera.image)})

    def _apply_label_map(self, path: str | os.PathLike[str]) -> None:
        """Have all views give their labels by a label map."""
        if self.masks is not None and self.masks.per_view:
            raise SettingsError(
                f"{path}: a label map was given for masks of {self.masks.format}, whose ids hold in their own "
                "view only; expected masks with ids that mean the same in every view"
            )
        label_map = read_label_map(path, self.class_names, self._within)
        self._declared = self.__dict__["class_names"] = dict(label_map.class_names)
        self._change_views(lambda view: {"class_names": self._declared, "label_map": label_map})

    def _change_views(self, changes: Callable[[View], dict[str, Any]]) -> None:
        self._views = {name: replace(view, **changes(view)) for name, view in self._views.items()}

    def views(self, split: str = "all") -> list[View]:
        """List the views of a split, "train", "test" or "all"; without `split.json` all views are for training."""
        if split == "all":
            return list(self._views.values())
        if split not in self._split:
            raise SettingsError(f"split is {split!r}; expected 'train', 'test' or 'all'")
        return [self._views[stem] for stem in self._split[split]]

    @cached_property
    def class_names(self) -> dict[int, str]:
        """Names by id, 0 included: from `classes.json`, else "class_07" and the like for the ids in the masks."""
        if self._declared is not None:
            return self._declared
        ids = {0}.union(*(view.class_ids() for view in self.views() if view.has_mask))
        return {i: class_name({0: BACKGROUND_NAME}, i) for i in sorted(ids)}

    def describe_masks(self) -> dict[str, Any] | None:
        """Describe masks that another program wrote, or that are scaled to the size of their cameras; None of others.

        Returns
        -------
        dict
            `format`, `ids` ("per-view" or "global"), how many `views` have one, and from which size to which the first
            that tells its size is `scaled`, if it is.
        """
        views = [view for view in self.views() if view.has_mask]
        sizes = next(((size, view.camera.image_size) for view in views if (size := view.mask_size)), ())
        is_scaled = len(set(sizes)) > 1
        if self.masks is None and not is_scaled:
            return None
        found = {
            "format": LABEL_IMAGES if self.masks is None else self.masks.format,
            "ids": PER_VIEW if self.masks is not None and self.masks.per_view else GLOBAL,
            "views": len(views),
        }
        if is_scaled:
            found["scaled"] = f"{' to '.join(f'{width} x {height}' for width, height in sizes)} pixels"
        return found

    @property
    def num_classes(self) -> int:
        """Largest id + 1."""
        return max(self.class_names) + 1

    @property
    def class_ids(self) -> tuple[int, ...]:
        """Ids of the classes, ascending, 0 included."""
        return tuple(self.class_names)

    def moved(self, move: Callable[[Camera], Camera]) -> Dataset:
        """Put every camera where `move` says; masks and photos stay what they are."""
        other = copy.copy(self)
        other._change_views(lambda view: {"camera": move(view.camera)})
        other.cameras = [view.camera for view in other._views.values()]
        return other

    def numbered(self, ids: Collection[int] | None = None) -> Dataset:
        """Renumber the classes without gaps, so that one large id costs no more memory than any other.

        Labels, names and number of classes are by place among `ids`, which the masks may hold, ascending from 0;
        `class_ids` by default. Returns the dataset itself if they have no gaps.
        """
        ids = self.class_ids if ids is None else tuple(int(i) for i in ids)
        if ids == tuple(range(len(ids))):
            return self
        names = dict(enumerate(class_name(self.class_names, i) for i in ids))
        declared = None if self._declared is None else names
        other = copy.copy(self)
        other.__dict__["class_names"] = names
        other._change_views(lambda view: {"class_names": declared, "numbering": ids})
        return other


def _read_split(path: Path, cameras: Sequence[Camera], within: Path | None) -> dict[str, list[str]]:
    """Read `split.json`, stems of images by "train" and "test", as names of views; without it, all are for training.

    Raises `SplitFileError` where it is broken, names a view without a camera, or one twice, and `PathNotAllowedError`
    where it lies outside `within`.
    """
    if not is_there(path, SplitFileError):
        return {"train": [camera.name for camera in cameras], "test": []}
    expected = '{"train": [stems], "test": [stems]}'
    content = read_object(path, SplitFileError, expected, within)
    if "train" not in content:
        raise SplitFileError(f'{path}: no "train" in it; expected {expected}')
    views: dict[str, list[str]] = {}
    for camera in cameras:
        views.setdefault(camera.image, []).append(camera.name)
    split = {name: content.get(name, []) for name in ("train", "test")}
    for name, stems in split.items():
        if not isinstance(stems, list) or not all(isinstance(stem, str) for stem in stems):
            raise SplitFileError(f'{path}: "{name}" is {clipped(stems)}; expected a list of image stems')
        split[name] = [view_of(stem, views) or stem for stem in stems]
        unknown_stems = [stem for stem in split[name] if stem not in views]
        if unknown_stems:
            raise SplitFileError(
                f'{path}: "{name}" names views without a camera ({len(unknown_stems)}, the first '
                f"{quoted(unknown_stems[0])}); expected stems such as {quoted(next(iter(views)))}"
            )
    stem, count = Counter(split["train"] + split["test"] or [""]).most_common(1)[0]
    if count > 1:
        raise SplitFileError(f"{path}: stem {quoted(stem)} occurs {count} times; expected each stem once, in one split")
    return {name: [view for stem in stems for view in views[stem]] for name, stems in split.items()}
