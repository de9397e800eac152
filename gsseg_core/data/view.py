"""Views: a camera with its mask and photo, the mask in a file or in memory."""

from __future__ import annotations

from collections.abc import Collection, Container, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from gsseg_core.data.class_names import listed
from gsseg_core.data.label_images import UNKNOWN, digest_of, mask_header
from gsseg_core.data.label_map import LabelMap
from gsseg_core.data.mask_files import read_soft_mask
from gsseg_core.data.mask_formats.images import read_label_image
from gsseg_core.data.mask_formats.masks import ViewMask
from gsseg_core.data.soft_masks import PackedMask, SeenLabels, combine_detections, quantise, restrict
from gsseg_core.errors import GssegError, MaskFormatError, SettingsError, UnknownLabelError
from gsseg_core.files.input_files import open_image
from gsseg_core.files.limits import MAX_LABEL
from gsseg_core.files.npz_files import Header
from gsseg_core.scene.camera import Camera, smaller_camera

T = TypeVar("T")

QUALITIES = {"full": 1, "half": 2, "quarter": 4}
"""Names of the pixels of a view to learn from: all, or every second or fourth of each row and column."""


@dataclass(frozen=True, eq=False)
class View:
    """A camera with the mask and photo of its view. A mask in a file is read when asked for, one in memory is packed.

    Attributes
    ----------
    camera : Camera
        Where from.
    mask_path : pathlib.Path or None
        The mask: a label image (.png), probabilities (.npz) or a folder of detections, see docs/masks.md; None if there
        is none or it is in memory. It is drawn on the image as it was taken, and undistorted when it is read. `held`
        leaves it, as what messages name.
    image_path : pathlib.Path or None
        The photo as it was taken, if there is one.
    class_names : mapping from id to name, or None
        If given, labels must be among its ids.
    supervised : tuple of int, or None
        If given, the segmenter looked for these classes only: 0 in its label image means "none of these".
    within : pathlib.Path or None
        If given, the folder below which the mask must lie, links followed.
    foreign_mask : ViewMask or None
        The mask, if another program has written it: then `mask_path` is None.
    label_map : LabelMap or None
        If given, the mask's ids become those of `class_names` by it.
    numbering : tuple of int, or None
        If given, the mask holds these ids, ascending, and labels are read as places among them; see
        `Dataset.numbered`. `class_names` are by place.
    group : int or None
        The group of Gaussians that the camera moves with, and in whose frame its pose is, see docs/living_map.md; None
        if it stays where it is in the scene.
    former_name : str or None
        The name that it had before states were merged, where that gave it another one.
    """

    camera: Camera
    mask_path: Path | None = None
    image_path: Path | None = None
    class_names: Mapping[int, str] | None = field(default=None, repr=False)
    supervised: tuple[int, ...] | None = None
    within: Path | None = None
    numbering: tuple[int, ...] | None = None
    foreign_mask: ViewMask | None = field(default=None, repr=False)
    label_map: LabelMap | None = field(default=None, repr=False)
    group: int | None = None
    former_name: str | None = None
    _mask: PackedMask | None = field(default=None, repr=False)

    @classmethod
    def from_arrays(
        cls,
        camera: Camera,
        labels: npt.ArrayLike,  # (H, W)
        class_names: Mapping[int, str] | None = None,
        *,
        supervised: Collection[int] | None = None,
    ) -> View:
        """Build a view from labels (H, W) of whole numbers, `UNKNOWN` (-1) where nothing is known.

        Masks in memory are those of the pinhole view; `camera.undistortion.sample` makes them of one drawn on a photo.

        Parameters
        ----------
        camera : Camera
            Where from.
        labels : (H, W) of int
            The mask; what a NumPy masked array masks is unknown.
        class_names : mapping from id to name, optional
            Labels must be among its ids.
        supervised : collection of int, optional
            The segmenter looked for these classes only, and 0 means "none of these".

        Raises
        ------
        MaskFormatError, MaskSizeError, UnknownLabelError
            The labels are not whole numbers, not of the camera's size, or not among the classes.
        """
        array, source = np.asarray(labels), f"view '{camera.name}'"
        if array.ndim != 2 or array.dtype.kind not in "iu":
            raise MaskFormatError(f"{source}: labels are {Header.of(array)}; expected integers (H, W)")
        if isinstance(labels, np.ma.MaskedArray):
            array = np.ma.filled(labels.astype(np.int64), UNKNOWN)
        seen = SeenLabels(array)
        if supervised is not None:
            cls(camera, class_names=class_names)._check_seen(seen, source)
            seen = restrict(array, supervised, source)
        return cls.from_seen(camera, seen, class_names)

    @classmethod
    def from_probabilities(
        cls,
        camera: Camera,
        probabilities: npt.ArrayLike,  # (C, H, W)
        classes: Sequence[int] | None = None,
        *,
        unknown: npt.NDArray[np.bool_] | None = None,  # (H, W)
        class_names: Mapping[int, str] | None = None,
    ) -> View:
        """Build a view from the probabilities of one segmenter, rounded as `gsseg_core.data.soft_masks.quantise` says.

        Parameters
        ----------
        camera : Camera
            Where from.
        probabilities : (C, H, W) of float
            In [0, 1], summing to at most 1 in each pixel.
        classes : sequence of C int, optional
            What the segmenter looked for; what is left to 1 then means "none of these". Without, [c] is class c, and
            what is left is unknown.
        unknown : (H, W) bool, optional
            Where there is no evidence.
        class_names : mapping from id to name, optional
            Classes must be among its ids.

        Raises
        ------
        MaskFormatError, MaskSizeError, UnknownLabelError
            Values, sizes or classes are unusable.
        """
        source = f"view '{camera.name}'"
        seen = quantise(np.asarray(probabilities), classes, unknown=unknown, source=source)
        return cls.from_seen(camera, seen, class_names)

    @classmethod
    def from_detections(
        cls,
        camera: Camera,
        detections: Mapping[int, npt.NDArray[Any]],  # class -> (H, W)
        *,
        unknown: npt.NDArray[np.bool_] | None = None,  # (H, W)
        class_names: Mapping[int, str] | None = None,
    ) -> View:
        """Build a view from detectors of one class each: bool, or probabilities, by class.

        On a class that is not among them the view has no evidence. A detector that ran and found nothing gives zeros.

        Raises
        ------
        MaskFormatError, MaskSizeError, UnknownLabelError
            Values, sizes or classes are unusable.
        """
        source = f"view '{camera.name}'"
        return cls.from_seen(camera, combine_detections(detections, unknown=unknown, source=source), class_names)

    @classmethod
    def from_seen(cls, camera: Camera, seen: SeenLabels, class_names: Mapping[int, str] | None = None) -> View:
        """Build a view from labels with their evidence, unless their size or classes do not fit: see `from_arrays`."""
        view = cls(camera, class_names=class_names)
        view._check_seen(seen, f"view '{camera.name}'")
        return replace(view, _mask=PackedMask(seen))

    def held(self) -> View:
        """Read the mask into memory, so that later changes of its file do not matter; raises as `read_labels` does.

        Returns the view itself where the mask is in memory already, or there is none.
        """
        if self.is_in_memory or not self.has_mask:
            return self
        return replace(self, _mask=PackedMask(self.read_seen()), label_map=None, numbering=None)

    def smaller(self, step: int) -> View:
        """Make the view of every step-th pixel of each row and column; the view itself where that is all, or none.

        Pixels are left out, never averaged, so that the mask's labels stay exact: see `smaller_camera`.
        """
        if step == 1 or min(self.camera.width, self.camera.height) <= step // 2:
            return self
        mask = None if self._mask is None else PackedMask(self._mask.unpack().every(step))
        return replace(self, camera=smaller_camera(self.camera, step), _mask=mask)

    @property
    def name(self) -> str:
        """Name of the camera, which is that of the image as a rule; see `Camera.name`."""
        return self.camera.name

    @property
    def has_mask(self) -> bool:
        """Whether there are labels to read."""
        return self.is_in_memory or self.mask_path is not None or self.foreign_mask is not None

    @property
    def is_in_memory(self) -> bool:
        """Whether the labels are here, and need no file."""
        return self._mask is not None

    @property
    def source(self) -> str:
        """What messages call the mask: its file, or the view."""
        return self.foreign_mask.where if self.foreign_mask else str(self.mask_path or f"view '{self.name}'")

    @property
    def first_name(self) -> str:
        """Name that it had before any states were merged."""
        return self.name if self.former_name is None else self.former_name

    @cached_property
    def digest(self) -> bytes:
        """16 bytes that are others for another first name, group, intrinsics, pose or mask, with all that it says."""
        packed, camera = PackedMask(self.read_seen()) if self._mask is None else self._mask, self.camera
        group = None if self.group is None else int(self.group)
        poses = camera.K.tobytes(), camera.world_to_camera.tobytes()
        return digest_of(str(self.first_name), group, *poses, packed.digest)

    @property
    def mask_bits(self) -> int | None:
        """Bits per label of a label image in a file, 8 or 16; of other masks, as many as labels need; None without."""
        if not self.is_in_memory and self.mask_path is not None and self.mask_path.suffix.lower() == ".png":
            return mask_header(self.mask_path, self.within).bits
        return (8 if self.largest_label < 255 else 16) if self.has_mask else None

    @property
    def mask_size(self) -> tuple[int, int] | None:
        """Width and height of a mask in a file, as far as they are known without reading it."""
        if self.foreign_mask is not None:
            return self.foreign_mask.size
        if self.mask_path is None or self.mask_path.suffix.lower() != ".png":
            return None
        try:
            header = mask_header(self.mask_path, self.within)
        except GssegError:  # Reading the mask says what is wrong.
            return None
        return header.width, header.height

    @property
    def largest_label(self) -> int:
        """Largest class on which the mask has evidence, `UNKNOWN` (-1) if there is none."""
        return self.read_seen().largest if self._mask is None else self._mask.largest

    def class_ids(self) -> set[int]:
        """Classes on which the mask has evidence."""
        return set(np.unique(self.read_seen().concerned).tolist()) - {UNKNOWN}

    def read_labels(self) -> npt.NDArray[np.int32]:
        """Read the mask as one class per pixel, (H, W) int32; `UNKNOWN` (-1) where it names none.

        Raises
        ------
        MaskFormatError
            The mask is missing or broken.
        MaskSizeError
            The mask has another shape than the camera's image; or another size, if it is soft: those are not scaled.
        UnknownLabelError
            A label is not among the classes.
        """
        return self.read_seen().named()

    def read_seen(self) -> SeenLabels:
        """Read the labels of the mask with their evidence, or raise as `read_labels`; of a soft mask, prototypes."""
        source = self.source
        if self.numbering is not None:
            names = dict(zip(self.numbering, self.class_names.values(), strict=True)) if self.class_names else None
            by_id = replace(self, class_names=names, numbering=None)
            return by_id.read_seen().numbered(np.array(self.numbering, np.int32), source)
        if self._mask is not None:
            seen = self._mask.unpack()
        elif self.foreign_mask is None and self.mask_path is None:
            raise MaskFormatError(f"{source}: has no mask; expected a label image {self.camera.image}.png")
        else:
            seen = self._read_file()
            if self.camera.undistortion is not None:
                seen = seen.undistorted(self.camera.undistortion)
        if self.label_map is not None:
            seen = seen.relabelled(self.label_map.new_ids, source)
        self._check_seen(seen, source)
        return seen

    def read_photo(self) -> npt.NDArray[np.uint8] | None:
        """Read the photo, (H, W, 3) RGB, undistorted; None if there is none, it is broken or of another size."""
        if self.image_path is None:
            return None
        try:
            with open_image(self.image_path, MaskFormatError, "image", "a photo", within=self.within) as photo:
                if photo.size != self.camera.image_size:
                    return None
                taken, undistortion = np.asarray(photo.convert("RGB")), self.camera.undistortion
                return taken if undistortion is None else undistortion.photo(taken)
        except (MaskFormatError, MemoryError):  # What is only looked at is not worth an error.
            return None

    def _read_file(self) -> SeenLabels:
        """Read a mask from its file, in the size of the image as it was taken."""
        if self.foreign_mask is not None:
            mask = self.foreign_mask.nested(self.camera)
            return SeenLabels(mask.known(), outermost=mask.outermost)
        path = Path(self.source)
        if path.suffix.lower() != ".png":
            names = self.class_names if self.label_map is None else None
            return read_soft_mask(path, names, self.camera, self.within)
        labels = read_label_image(path, self.camera, self.within)
        return SeenLabels(labels) if self.supervised is None else restrict(labels, self.supervised, str(path))

    def _check_seen(self, seen: SeenLabels, source: str) -> None:
        self.camera.check_mask_size(seen.labels.shape[1], seen.labels.shape[0], source)
        labels = seen.concerned
        names: Container[int] = range(MAX_LABEL + 1) if self.class_names is None else self.class_names
        low, high = (int(labels.min()), int(labels.max())) if labels.size else (0, -1)
        if low >= UNKNOWN and high <= MAX_LABEL and all(i in names for i in range(max(low, 0), high + 1)):
            return  # The usual case; to list the labels of an image takes ten times as long.
        unknown = [i for i in np.unique(labels).tolist() if i != UNKNOWN and i not in names]
        if unknown:
            expected = f"0 to {MAX_LABEL}, or {UNKNOWN} for unknown"
            if self.class_names is not None:
                expected = f"ids from {min(self.class_names)} to {max(self.class_names)} that classes.json names"
            raise UnknownLabelError(f"{source}: mask holds the labels {listed(map(str, unknown))}; expected {expected}")


def spread(views: Sequence[T], count: int | None) -> list[T]:
    """Choose `count` views, or cameras, spread evenly over all of them; all if there are no more, or it is None.

    Raises `SettingsError` where it is below 1.
    """
    if count is None or count >= len(views):
        return list(views)
    if count < 1:
        raise SettingsError(f"views is {count}; expected at least 1")
    return [views[i] for i in np.linspace(0, len(views) - 1, count).round().astype(int)]
