"""Images of one object each: binary PNGs, as trackers and mask generators write them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from gsseg_core.errors import MaskFormatError
from gsseg_core.files.input_files import open_image

_MODES = ("1", "L", "P", "I;16")


def image_size(path: Path, within: Path | None) -> tuple[int, int]:
    """Read width and height from the header of a mask; raises as `read_binary` does."""
    with open_image(path, MaskFormatError, "mask", "a PNG of one object", ("PNG",), within) as image:
        return image.size


def read_binary(path: Path, within: Path | None) -> npt.NDArray[np.bool_]:
    """Read where the object of a mask (H, W) is: all that is not 0, in a PNG of one channel.

    Raises
    ------
    MaskFormatError
        It is missing, broken, or another kind of image.
    """
    with open_image(path, MaskFormatError, "mask", "a PNG of one object", ("PNG",), within) as image:
        if image.mode not in _MODES:
            raise MaskFormatError(
                f"{path}: is an image of kind {image.mode}; expected one channel, 0 outside of the object"
            )
        return np.array(image) > 0
