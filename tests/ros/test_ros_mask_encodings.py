"""Masks as segmenters publish them: each way of saying a label is read as it is meant, the unusable refused by name."""

from __future__ import annotations

import array
import io
import struct
import zlib
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image as Picture
from ros_message_cases import HEADER, image, refusal
from sensor_msgs.msg import CompressedImage

from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.data.soft_masks import quantise
from gsseg_core.errors import MaskFormatError, SettingsError
from gsseg_ros.conversions import labels_from_image, rgb_image
from gsseg_ros.errors import TooManyPixelsError
from gsseg_ros.node.masks.compressed import decompress_mask, decompress_picture
from gsseg_ros.node.masks.encodings import mask_from_image
from gsseg_ros.node.masks.palette import Palette

COLORS = ["#000000", "#ff8000", "#0080FF", "123456"]
RGB = np.array([[0, 0, 0], [255, 128, 0], [0, 128, 255], [0x12, 0x34, 0x56]], np.uint8)
LABELS = np.array([[0, 1, 2], [3, 2, 1]])
TOPIC = "/some/topic"


def compressed(pixels: np.ndarray, kind: str = "PNG", form: str = "png", **options: Any) -> CompressedImage:
    """A compressed image as image_transport sends it; `pixels` of mode P are indices of a palette."""
    stream = io.BytesIO()
    if options.pop("palette", False):
        picture = Picture.fromarray(pixels, "P")
        picture.putpalette(RGB.tobytes())
    else:
        picture = Picture.fromarray(pixels)
    picture.save(stream, format=kind, **options)
    return CompressedImage(header=HEADER, format=form, data=array.array("B", stream.getvalue()))


def claiming(width: int, height: int) -> CompressedImage:
    """A small PNG that claims to be a large one, its checksum being right."""
    data = bytearray(compressed(np.zeros((2, 2), np.uint8)).data.tobytes())
    data[16:24] = struct.pack(">II", width, height)
    data[29:33] = struct.pack(">I", zlib.crc32(bytes(data[12:29])))
    return CompressedImage(header=HEADER, format="mono8; png compressed ", data=array.array("B", bytes(data)))


@given(st.data(), st.booleans())
def test_negative_numbers_of_16sc1_are_unknown_and_all_others_labels(data: st.DataObject, big: bool) -> None:
    values = data.draw(hnp.arrays(np.int16, (3, 4)))
    read = labels_from_image(image(values, "16SC1", 3, big), TOPIC)
    assert np.array_equal(read, np.where(values < 0, UNKNOWN, values))


@given(hnp.arrays(np.float32, (4, 3, 5), elements=st.floats(0, 0.25, width=32)), st.integers(0, 5), st.booleans())
def test_channels_of_probabilities_are_classes_of_a_soft_mask(p: np.ndarray, padding: int, big: bool) -> None:
    height, width, channels = p.shape[1], p.shape[2], p.shape[0]
    message = image(np.moveaxis(p, 0, -1).reshape(height, width * channels), f"32FC{channels}", padding, big)
    message.width = width
    found, expected = mask_from_image(message, TOPIC), quantise(p)
    assert np.array_equal(found.labels, expected.labels)
    if expected.evidence is None:
        assert found.evidence is None
        return
    assert found.evidence is not None
    for part in ("classes", "mass"):
        assert np.array_equal(getattr(found.evidence, part), getattr(expected.evidence, part))


def test_a_certain_mask_of_probabilities_is_the_plain_one() -> None:
    message = image(np.eye(4, dtype=np.float32)[LABELS].reshape(2, 12), "32FC4")
    message.width = 3
    found = mask_from_image(message, TOPIC)
    assert found.evidence is None
    assert np.array_equal(found.labels, LABELS)


@pytest.mark.parametrize(
    ("encoding", "value", "says"),
    [
        ("32FC1", 0.5, "'32FC1', one number in each pixel, which does not say of what"),
        ("32FC2", 0.6, "(2 classes): probabilities of a pixel sum to 1.200"),
        ("32FC2", np.nan, "probabilities: values are NaN"),
        ("32FC2", -0.5, "values are from -0.5 to -0.5"),
        ("32FC3", 0.1, "thus a step of at least 24"),
        ("32FC99999", 0.1, "thus a step of at least 799992"),
        ("32FC0", 0.1, "encoding is '32FC0'; expected labels as one of mono8"),
        ("32FC1234567", 0.1, "encoding is '32FC1234567'; expected labels"),
        ("64FC2", 0.1, "encoding is '64FC2'; expected labels"),
    ],
)
def test_numbers_that_are_no_probabilities_are_refused(encoding: str, value: float, says: str) -> None:
    message = image(np.full((2, 4), value, np.float32), encoding)
    message.width = 2
    assert says in refusal(MaskFormatError, mask_from_image, message, TOPIC)


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8"])
def test_colours_of_the_palette_are_labels(encoding: str) -> None:
    message = rgb_image(RGB[LABELS] if encoding == "rgb8" else RGB[LABELS][..., ::-1], HEADER)
    message.encoding = encoding
    found = mask_from_image(message, TOPIC, Palette(COLORS))
    assert found.evidence is None
    assert np.array_equal(found.labels, LABELS)


@pytest.mark.parametrize("odd", [(0, 0, 1), (255, 255, 255), (1, 0, 0)])
def test_a_colour_that_is_not_in_the_palette_has_the_mask_refused(odd: tuple[int, int, int]) -> None:
    pixels = RGB[LABELS]
    pixels[1, 1] = odd
    said = refusal(MaskFormatError, mask_from_image, rgb_image(pixels, HEADER), TOPIC, Palette(COLORS))
    assert "1 pixels have a colour that is not in the palette, first #{:02x}{:02x}{:02x};".format(*odd) in said


def test_colours_without_a_palette_are_refused() -> None:
    said = refusal(MaskFormatError, mask_from_image, rgb_image(RGB[LABELS], HEADER), TOPIC)
    assert "or, for colours, the parameter palette" in said


@pytest.mark.parametrize(
    ("colors", "says"),
    [
        (["#000000", "red"], "label 1 has the colour 'red'; expected one such as #0080ff"),
        (["#00000"], "label 0 has the colour '#00000'"),
        (["#0000000"], "label 0 has the colour"),
        ([""], "label 0 has the colour ''"),
        (["#12345\n6"], "label 0 has the colour"),
        (["#010203", "#000000", "010203"], "labels 0 and 2 have the same colour, 010203"),
        (["#000000"] * 65536, "has 65,536 colours; expected at most 65,535"),
    ],
)
def test_an_impossible_palette_is_refused(colors: list[str], says: str) -> None:
    with pytest.raises(SettingsError) as caught:
        Palette(colors)
    assert says in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("pixels", "form", "expected"),
    [
        (LABELS.astype(np.uint8), "mono8; png compressed ", LABELS),
        (np.array([[0, 255]], np.uint8), "", [[0, -1]]),
        (np.array([[0, 65534, 65535]], np.uint16), "16UC1; png compressed ", [[0, 65534, -1]]),
        (np.array([[7, 65535, 32768]], np.uint16), "16SC1; png compressed ", [[7, -1, -1]]),
        (RGB[LABELS], "rgb8; png compressed bgr8", LABELS),
        (RGB[LABELS], "png", LABELS),
        (RGB[LABELS][..., ::-1], "rgb8; png compressed rgb8", LABELS),
    ],
)
def test_masks_survive_a_png(pixels: np.ndarray, form: str, expected: Any) -> None:
    message = decompress_mask(compressed(pixels, form=form), TOPIC, 100)
    assert message.header == HEADER
    assert np.array_equal(mask_from_image(message, TOPIC, Palette(COLORS)).labels, expected)


def test_a_png_with_a_palette_of_its_own_holds_labels_as_indices() -> None:
    for bits in (2, 8):
        sent = compressed(LABELS.astype(np.uint8), palette=True, bits=bits)
        message = decompress_mask(sent, TOPIC, 100)
        assert np.array_equal(mask_from_image(message, TOPIC).labels, LABELS)


def test_a_jpeg_is_no_mask() -> None:
    said = refusal(MaskFormatError, decompress_mask, compressed(np.zeros((4, 4), np.uint8), "JPEG"), TOPIC, 100)
    assert "is a JPEG, which blends labels where they meet into others; expected a PNG" in said


@pytest.mark.parametrize(
    ("message", "says"),
    [
        (CompressedImage(), "not a PNG"),
        (compressed(np.zeros((2, 2), np.uint8), "TIFF"), "not a PNG"),
        (compressed(np.zeros((2, 2, 4), np.uint8)), "is a PNG of RGBA with 8 bits"),
        (compressed(np.zeros((2, 2, 2), np.uint8)), "is a PNG of gray + alpha with 8 bits"),
        (compressed(np.zeros((2, 2), bool)), "is a PNG of gray with 1 bits"),
    ],
)
def test_other_files_are_no_masks(message: CompressedImage, says: str) -> None:
    assert says in refusal(MaskFormatError, decompress_mask, message, TOPIC, 100)


def test_a_png_cut_short_anywhere_is_one_clear_error() -> None:
    noise = np.random.default_rng(0).integers(0, 255, (16, 16), np.uint8)
    data = compressed(noise).data
    for size in range(0, len(data) - 20, 7):  # Only checksums and an empty chunk come after all pixels.
        refusal(MaskFormatError, decompress_mask, CompressedImage(format="png", data=data[:size]), TOPIC, 1000)


def test_what_inflates_beyond_the_limit_is_refused_by_what_it_claims() -> None:
    for width, height in ((65536, 65536), (101, 1), (2**31 - 1, 2**31 - 1)):
        with pytest.raises(TooManyPixelsError, match=rf"/some/topic: is {width} x {height}; expected 100 pixels"):
            decompress_mask(claiming(width, height), TOPIC, 100)
    with pytest.raises(TooManyPixelsError, match="is 11 x 10; expected 100 pixels"):
        decompress_picture(compressed(np.zeros((10, 11, 3), np.uint8)), TOPIC, 100)


@pytest.mark.parametrize("kind", ["PNG", "JPEG"])
def test_camera_pictures_are_jpeg_or_png_in_colour_or_gray(kind: str) -> None:
    gray = np.full((8, 8), 100, np.uint8)
    red = np.zeros((8, 8, 3), np.uint8)
    red[..., 0] = 200
    for pixels, form, expected in (
        (gray, "mono8; jpeg compressed ", (100, 100, 100)),
        (red, "bgr8; jpeg compressed bgr8", (200, 0, 0)),
        (red, "rgb8; jpeg compressed rgb8", (0, 0, 200)),
    ):
        message = decompress_picture(compressed(pixels, kind, form), TOPIC, 64)
        assert (message.encoding, message.width, message.height, message.header) == ("rgb8", 8, 8, HEADER)
        found = np.frombuffer(message.data, np.uint8).reshape(-1, 3).mean(axis=0)
        np.testing.assert_allclose(found, expected, atol=3)


def test_a_broken_picture_is_one_clear_error() -> None:
    whole = compressed(np.random.default_rng(0).integers(0, 255, (16, 16, 3), np.uint8), "JPEG").data
    for data in (whole[:0], whole[:10], whole[: len(whole) // 2], array.array("B", b"GIF89a" + bytes(20))):
        said = refusal(MaskFormatError, decompress_picture, CompressedImage(format="jpeg", data=data), TOPIC, 1000)
        assert "expected a whole JPEG or PNG" in said
