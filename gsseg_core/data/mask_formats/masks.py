"""Masks of views in files of other programs: where each is, how it is read, and what its labels are called."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt

from gsseg_core.data.class_names import BACKGROUND_NAME, check_class_name
from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.data.mask_formats.shapes import Drawing, Nested
from gsseg_core.errors import MaskFormatError
from gsseg_core.files.limits import MAX_LABEL
from gsseg_core.scene.camera import Camera
from gsseg_core.text import quoted

_NO_OBJECTS = {**dict.fromkeys((BACKGROUND_NAME, "_background_", "__background__"), 0), "__ignore__": UNKNOWN}


@dataclass(frozen=True, eq=False)
class ViewMask:
    """The mask of one view: where it stands, and how it is read, when it is asked for.

    `size` is the mask's own, width and height, as far as it is known without reading it. One is `blank` if its image is
    listed in a file without a shape: nobody may have looked at it.
    """

    where: str
    read: Callable[[Camera], npt.NDArray[np.int32] | Nested]
    size: tuple[int, int] | None = None
    blank: bool = False

    @classmethod
    def of(cls, drawing: Drawing, where: str) -> ViewMask:
        """Make the mask of a drawing."""
        size = drawing.width, drawing.height
        return cls(where, partial(drawing.labels, where=where), size, blank=not drawing.shapes)

    def labels(self, camera: Camera) -> npt.NDArray[np.int32]:
        """Read labels (H, W) of the size of the image as it was taken, scaled if the mask has another one.

        Raises `MaskFormatError` where the mask is missing or broken, `MaskSizeError` where it has another shape than
        the camera's image.
        """
        return self.nested(camera).labels

    def nested(self, camera: Camera) -> Nested:
        """Read the labels, and which lie in which, where a format tells; raises as `labels` does."""
        try:
            found = self.read(camera)
            return found if isinstance(found, Nested) else Nested(found)
        except RecursionError as cause:  # Quoting what is nested goes less deep than reading it.
            raise MaskFormatError(f"{self.where}: is nested too deep; expected a mask") from cause


@dataclass(frozen=True, eq=False)
class MaskSet:
    """The masks of all views that another program wrote."""

    views: Mapping[str, ViewMask]
    class_names: Mapping[int, str] | None = None  # by id; None where ids have no names; a reader may leave out 0
    per_view: bool = False  # whether an id means something in its own view only
    format: str = ""  # name in `MASK_FORMATS`


def number_names(names: Iterable[str], where: str) -> dict[str, int]:
    """Assign ids to names of classes, from 1; the background is 0, and LabelMe's `__ignore__` unknown.

    Raises `MaskFormatError` where there are more names than labels.
    """
    numbers = dict(_NO_OBJECTS)
    for name in names:
        numbers.setdefault(name, len(numbers) - len(_NO_OBJECTS) + 1)
    if len(numbers) > MAX_LABEL:
        raise MaskFormatError(f"{where}: has {len(numbers):,} classes; expected at most {MAX_LABEL:,}")
    return numbers


def names_of(numbers: Mapping[str, int]) -> dict[int, str]:
    """Turn ids by name into names by id, those of objects alone."""
    return {number: name for name, number in numbers.items() if number > 0}


def ids_from_zero(names: Mapping[int, str]) -> dict[int, int]:
    """Labels by id for a format in which 0 may be an object: one more than the id if it is, else the id itself.

    As with `number_names`, the background is 0, and `__ignore__` unknown, whatever its id.
    """
    shift = 1 if 0 in names and names[0].lower() not in _NO_OBJECTS else 0
    return {i: _NO_OBJECTS.get(name.lower(), i + shift) for i, name in names.items()}


def check_name(name: object, where: str) -> str:
    """Return the name of a class, or raise `MaskFormatError` if it is unusable."""
    return check_class_name(name, MaskFormatError, f"{where}: a class has")


def check_id(value: object, where: str) -> int:
    """Return an id, or raise `MaskFormatError` if it can be no label."""
    if type(value) is not int or not 0 <= value < MAX_LABEL:
        raise MaskFormatError(f"{where}: has the id {quoted(value)}; expected whole numbers from 0 to {MAX_LABEL - 1}")
    return value
