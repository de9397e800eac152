"""Images as masks of a view: label images, and binary PNGs of one object each as trackers and generators write them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from gsseg_core.data.label_images import read_mask
from gsseg_core.data.mask_formats.shapes import Drawing, Part, Shape, check_fit, scaled
from gsseg_core.errors import MaskFormatError
from gsseg_core.files.input_files import open_image
from gsseg_core.scene.camera import Camera

_MODES = ("1", "L", "P", "I;16")


def read_label_image(path: Path, camera: Camera, within: Path | None = None) -> npt.NDArray[np.int32]:
    """Read a label image (H, W), scaled to the size of the image that a camera took.

    Before any pixel is read, raises `MaskFormatError` where it is missing, broken or another kind of image,
    `MaskSizeError` where it has another shape than the camera's, `PathNotAllowedError` where it lies outside `within`.
    """
    mask = read_mask(path, within, lambda width, height: check_fit(width, height, camera, str(path)))
    return scaled(mask.labels, camera)


@dataclass(frozen=True, eq=False)
class _Object:
    """The region of one object in the image of a camera: where a PNG is not 0."""

    path: Path
    camera: Camera
    within: Path | None

    def parts(self, width: int, height: int) -> Iterator[Part]:
        """See `Region`."""
        yield Part(0, 0, read_object(self.path, self.camera, self.within))


def drawing_of_objects(masks: Iterable[tuple[int, Path]], camera: Camera, within: Path | None) -> Drawing:
    """Make a drawing of PNGs of one object each, with its label; when it is painted, they raise as `read_object`."""
    return Drawing(*camera.image_size, [Shape(label, _Object(path, camera, within)) for label, path in masks])


def read_object(path: Path, camera: Camera | None, within: Path | None) -> npt.NDArray[np.bool_]:
    """Read where a PNG of one channel is not 0, (H, W), scaled to the size of a camera's image if need be.

    Errors are those of `read_label_image`.
    """
    with open_image(path, MaskFormatError, "mask", "a PNG of one object", ("PNG",), within) as image:
        if camera is not None:
            check_fit(*image.size, camera, str(path))
        if image.mode not in _MODES:
            raise MaskFormatError(
                f"{path}: is an image of kind {image.mode}; expected one channel, 0 outside of the object"
            )
        inside = np.array(image) > 0
    return inside if camera is None else scaled(inside, camera)
