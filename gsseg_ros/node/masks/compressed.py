"""Images of compressed topics, as image_transport publishes them, made into plain ones: no larger than is allowed."""

from __future__ import annotations

import re
from io import BytesIO

import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import CompressedImage, Image

from gsseg_core.data.label_images import png_header
from gsseg_core.errors import MaskFormatError
from gsseg_core.files.input_files import decode_image
from gsseg_ros.conversions import plain_image, require_size

TRANSPORTS = ("raw", "compressed")
"""Values of the parameters `mask_transport` and `image_transport`."""

_JPEG = b"\xff\xd8\xff"
_PNGS = {("gray", 8): "mono8", ("gray", 16): "mono16", ("palette", 8): "mono8", ("RGB", 8): "rgb8"}
_SWAPPED = re.compile(r"compressed\s+rgb")


def compressed_topic(node: Node, topic: str) -> str:
    """Name of the topic of a compressed image: below that of the image, as it is remapped, as image_transport does."""
    return f"{node.resolve_topic_name(topic)}/compressed"


def decompress_mask(message: CompressedImage, topic: str, max_pixels: int) -> Image:
    """Make a plain image of a compressed mask: of a PNG, whose size is looked at before it is inflated.

    Raises `MaskFormatError`: it is broken, no PNG, or a PNG of something else than labels or colours;
    `TooManyPixelsError`: it has more pixels than allowed.
    """
    data = bytes(message.data)
    if data.startswith(_JPEG):
        raise MaskFormatError(
            f"{topic}: is a JPEG, which blends labels where they meet into others; expected a PNG "
            "(compressed_image_transport: parameter <topic>.compressed.format of the publisher set to png)"
        )
    header = png_header(data[:26], topic)
    require_size(header, max_pixels, topic)
    # Palette indices of less than 8 bits are read as such; gray values of less would be scaled.
    encoding = _PNGS.get((header.kind, 8 if header.kind == "palette" else header.depth))
    if encoding is None:
        raise MaskFormatError(
            f"{topic}: is a PNG of {header.kind} with {header.depth} bits per channel; expected labels, gray with 8 or "
            "16 bits or indices of a palette, or colours, RGB with 8 bits"
        )
    with decode_image(BytesIO(data), topic, MaskFormatError, "PNG", "a whole mask", ("PNG",)) as image:
        pixels = np.asarray(image)
    if encoding == "mono16":
        pixels = pixels.astype("<u2")
        encoding = "16SC1" if _original(message) == "16SC1" else encoding
    return plain_image(_colors_as_sent(pixels, message), encoding, message.header)


def decompress_picture(message: CompressedImage, topic: str, max_pixels: int) -> Image:
    """Make an rgb8 image of a compressed camera picture, JPEG or PNG; raises as `decompress_mask` does."""
    data = BytesIO(bytes(message.data))
    with decode_image(data, topic, MaskFormatError, "picture", "a whole JPEG or PNG", ("JPEG", "PNG")) as image:
        require_size(image, max_pixels, topic)
        pixels = np.asarray(image.convert("RGB"))
    return plain_image(_colors_as_sent(pixels, message), "rgb8", message.header)


def _original(message: CompressedImage) -> str:
    """Read which encoding the image had before, as in "16SC1; png compressed"; empty where it is not said."""
    return str(message.format).partition(";")[0].strip()


def _colors_as_sent(pixels: np.ndarray, message: CompressedImage) -> np.ndarray:
    """Swap red and blue where the format says that OpenCV, which takes all for BGR, was handed RGB to compress."""
    return pixels[..., ::-1] if pixels.ndim == 3 and _SWAPPED.search(str(message.format)) else pixels
