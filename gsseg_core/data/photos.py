"""Photos of views."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gsseg_core.data.view import View
from gsseg_core.errors import MaskFormatError
from gsseg_core.files.input_files import open_image


def read_photo(view: View) -> npt.NDArray[np.uint8] | None:
    """Read the photo of a view, (H, W, 3) RGB, undistorted; None if there is none, it is broken or of another size."""
    if view.image_path is None:
        return None
    try:
        with open_image(view.image_path, MaskFormatError, "image", "a photo", within=view.within) as photo:
            if photo.size != view.camera.image_size:
                return None
            taken, undistortion = np.asarray(photo.convert("RGB")), view.camera.undistortion
            return taken if undistortion is None else undistortion.photo(taken)
    except (MaskFormatError, MemoryError):  # What is only looked at is not worth an error.
        return None
