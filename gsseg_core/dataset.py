"""Posed views with their label images, read lazily from a dataset folder or held in memory."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gsseg_core.camera_files import read_cameras
from gsseg_core.cameras import Camera
from gsseg_core.errors import MaskFormatError, MaskSizeError, SettingsError, SplitFileError, UnknownLabelError
from gsseg_core.json_files import read_json
from gsseg_core.masks import BACKGROUND_NAME, MAX_LABEL, UNKNOWN, PackedLabels, mask_bits, read_classes, read_mask

_IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")


@dataclass(frozen=True, eq=False)
class View:
    """A camera and what was seen from it. Labels of a file are read when asked for; those in memory are compressed.

    Attributes
    ----------
    camera : Camera
        Where from.
    mask_path : pathlib.Path or None
        The label image; None if there is none or the labels are in memory.
    image_path : pathlib.Path or None
        The photo, if there is one.
    class_names : mapping from id to name, or None
        If given, labels must be among its ids.
    """

    camera: Camera
    mask_path: Path | None = None
    image_path: Path | None = None
    class_names: Mapping[int, str] | None = field(default=None, repr=False)
    _labels: PackedLabels | None = field(default=None, repr=False)

    @classmethod
    def from_arrays(
        cls,
        camera: Camera,
        labels: npt.ArrayLike,  # (H, W)
        class_names: Mapping[int, str] | None = None,
    ) -> View:
        """Build a view from labels (H, W) of whole numbers, `UNKNOWN` (-1) where nothing is known.

        Raises
        ------
        MaskFormatError, MaskSizeError, UnknownLabelError
            The labels are not whole numbers, not of the camera's size, or not among the classes.
        """
        array = np.asarray(labels)
        if array.ndim != 2 or array.dtype.kind not in "iu":
            raise MaskFormatError(
                f"view '{camera.name}': labels are {array.dtype} of shape {array.shape}; expected integers (H, W)"
            )
        view = cls(camera, class_names=class_names)
        view._check(array, f"view '{camera.name}'")
        return replace(view, _labels=PackedLabels(array))

    @property
    def name(self) -> str:
        """Stem of the image's file name."""
        return self.camera.name

    @property
    def has_mask(self) -> bool:
        """Whether there are labels to read."""
        return self.mask_path is not None or self._labels is not None

    @property
    def mask_bits(self) -> int | None:
        """Bits per label of the mask, 8 or 16 (in memory: as many as its labels need); None without a mask."""
        if self._labels is not None:
            return 8 if self._labels.largest < 255 else 16
        return None if self.mask_path is None else mask_bits(self.mask_path)

    @property
    def largest_label(self) -> int:
        """The largest label of the mask, `UNKNOWN` (-1) if it says nothing at all."""
        return int(self.read_labels().max()) if self._labels is None else self._labels.largest

    def read_labels(self) -> npt.NDArray[np.int32]:
        """Read the labels (H, W) int32, `UNKNOWN` (-1) where the mask says nothing.

        Raises
        ------
        MaskFormatError
            The mask is missing or no label image.
        MaskSizeError
            The mask has another size than the camera.
        UnknownLabelError
            A label is not among the classes.
        """
        source = str(self.mask_path or f"view '{self.name}'")
        if self._labels is not None:
            labels = self._labels.unpack()
        elif self.mask_path is not None:
            labels = read_mask(self.mask_path).labels
        else:
            raise MaskFormatError(f"{source}: has no mask; expected a label image {self.name}.png")
        self._check(labels, source)
        return labels

    def _check(self, labels: npt.NDArray[np.integer[Any]], source: str) -> None:
        size, expected = labels.shape[::-1], (self.camera.width, self.camera.height)
        if size != expected:
            raise MaskSizeError(
                f"{source}: mask is {size[0]} x {size[1]} pixels; expected {expected[0]} x {expected[1]}, the size of "
                f"camera '{self.name}' (masks are never resized)"
            )
        self._check_ids(labels, source)

    def _check_ids(self, labels: npt.NDArray[np.integer[Any]], source: str) -> None:
        ids = np.unique(labels)
        if self.class_names is None:
            unknown = ids[(ids < UNKNOWN) | (ids > MAX_LABEL)].tolist()
            expected = f"0 to {MAX_LABEL}, or {UNKNOWN} for unknown"
        else:
            unknown = [i for i in ids.tolist() if i != UNKNOWN and i not in self.class_names]
            expected = f"ids from {min(self.class_names)} to {max(self.class_names)} that classes.json names"
        if unknown:
            raise UnknownLabelError(f"{source}: mask holds the labels {str(unknown)[1:-1][:60]}; expected {expected}")


class Dataset:
    """A folder with cameras and label images in `labels/<stem>.png`.

    Photos in `images/<stem>.jpg` (or .jpeg, .png), `classes.json` and `split.json` are optional.

    Parameters
    ----------
    root : path
        The folder.
    labels : str
        Sub-folder of the label images.

    Attributes
    ----------
    root : pathlib.Path
        The folder.
    cameras : list of Camera
        All cameras, in the order of their file.

    Raises
    ------
    CameraFileError, PoseError, IntrinsicsError, ClassesFileError, SplitFileError
        A file is missing or broken. A mask that is missing is no error here.
    """

    def __init__(self, root: str | os.PathLike[str], labels: str = "labels") -> None:
        self.root = Path(root)
        self.cameras = read_cameras(self.root)
        classes = self.root / "classes.json"
        self._declared = read_classes(classes) if classes.is_file() else None
        masks = _files_by_stem(self.root / labels, (".png",))
        images = _files_by_stem(self.root / "images", _IMAGE_SUFFIXES)
        self._views = {
            camera.name: View(camera, masks.get(camera.name), images.get(camera.name), self._declared)
            for camera in self.cameras
        }
        self._split = self._read_split()

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
        ids = {0, UNKNOWN}.union(*(np.unique(view.read_labels()).tolist() for view in self.views() if view.has_mask))
        return {i: f"class_{i:02d}" if i else BACKGROUND_NAME for i in sorted(ids - {UNKNOWN})}

    @property
    def num_classes(self) -> int:
        """Largest id + 1."""
        return max(self.class_names) + 1

    def _read_split(self) -> dict[str, list[str]]:
        path = self.root / "split.json"
        if not path.is_file():
            return {"train": list(self._views), "test": []}
        content = read_json(path, SplitFileError)
        if not isinstance(content, dict) or "train" not in content:
            raise SplitFileError(f'{path}: no "train" in it; expected {{"train": [stems], "test": [stems]}}')
        split = {name: content.get(name, []) for name in ("train", "test")}
        for name, stems in split.items():
            if not isinstance(stems, list) or not all(isinstance(stem, str) for stem in stems):
                raise SplitFileError(f'{path}: "{name}" is {str(stems)[:60]}; expected a list of image stems')
            strangers = [stem for stem in stems if stem not in self._views]
            if strangers:
                raise SplitFileError(
                    f'{path}: "{name}" names views without a camera ({len(strangers)}, the first {strangers[0]!r}); '
                    f"expected stems such as {next(iter(self._views))!r}"
                )
        stem, count = Counter(split["train"] + split["test"] or [""]).most_common(1)[0]
        if count > 1:
            raise SplitFileError(f"{path}: stem {stem!r} occurs {count} times; expected each stem once, in one split")
        return split


def spread(views: Sequence[View], count: int | None) -> list[View]:
    """Choose some views, spread evenly over all of them; all if there are no more, or `count` is None.

    Raises
    ------
    SettingsError
        None is asked for.
    """
    if count is None or count >= len(views):
        return list(views)
    if count < 1:
        raise SettingsError(f"views is {count}; expected at least 1")
    return [views[i] for i in np.linspace(0, len(views) - 1, count).round().astype(int)]


def _files_by_stem(folder: Path, suffixes: tuple[str, ...]) -> dict[str, Path]:
    if not folder.is_dir():
        return {}
    return {path.stem: path for path in sorted(folder.iterdir()) if path.suffix.lower() in suffixes}
