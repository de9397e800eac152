"""Limits the size of the images that peers send and ask for."""

from __future__ import annotations

from typing import Any

from gsseg_ros.errors import TooManyPixelsError


def require_size(message: Any, max_pixels: int, topic: str) -> None:
    """Refuse an Image or a CameraInfo by its size, before anything of that size is made.

    Raises
    ------
    TooManyPixelsError
        It has more pixels than the parameter max_pixels allows.
    """
    if message.width * message.height > max_pixels:
        size = f"{message.width} x {message.height}"
        raise TooManyPixelsError(f"{topic}: is {size}; expected {max_pixels} pixels at most (parameter max_pixels)")
