"""Stamps, masks, pictures, names: what goes into a message comes out again, and the unusable is refused by name."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from ros_message_cases import HEADER, image, refusal
from sensor_msgs.msg import Image

from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.errors import MaskFormatError
from gsseg_ros.conversions import (
    confidence_image,
    labels_from_image,
    mask_image,
    picture_from_image,
    rgb_image,
    stamp_message,
    stamp_ns,
)
from gsseg_ros.topic_tokens import topic_tokens

sizes = hnp.array_shapes(min_dims=2, max_dims=2, max_side=9)


@given(st.integers(-(2**31) * 10**9, 2**31 * 10**9 - 1))
def test_a_stamp_survives_its_message(ns: int) -> None:
    assert stamp_ns(stamp_message(ns)) == ns


@pytest.mark.parametrize(
    ("encoding", "kind", "unknown"),
    [
        ("mono8", np.uint8, 255),
        ("8UC1", np.uint8, 255),
        ("mono16", np.uint16, 65535),
        ("16UC1", np.uint16, 65535),
        ("32SC1", np.int32, -1),
    ],
)
@given(data=st.data(), shape=sizes, padding=st.integers(0, 5), big=st.booleans())
def test_labels_survive_every_encoding_padding_and_byte_order(
    encoding: str, kind: type, unknown: int, data: st.DataObject, shape: tuple[int, int], padding: int, big: bool
) -> None:
    largest = 254 if kind is np.uint8 else 65534
    labels = data.draw(hnp.arrays(np.int32, shape, elements=st.integers(UNKNOWN, largest)))
    values = np.where(labels == UNKNOWN, unknown, labels).astype(kind)
    read = labels_from_image(image(values, encoding, padding, big), "/some/topic")
    assert read.dtype == np.int32
    assert np.array_equal(read, labels)
    read[:] = 0  # Not a view of the message, which is read-only where it is shared.


@pytest.mark.parametrize("bits", [8, 16])
@given(data=st.data(), shape=sizes)
def test_labels_survive_a_mask_image_of_our_own(bits: int, data: st.DataObject, shape: tuple[int, int]) -> None:
    labels = data.draw(hnp.arrays(np.int32, shape, elements=st.integers(UNKNOWN, 2**bits - 2)))
    message = mask_image(labels, HEADER, bits)
    assert (message.encoding, message.step) == (f"mono{bits}", shape[1] * bits // 8)
    assert (message.header, message.height, message.width) == (HEADER, *shape)
    assert np.array_equal(labels_from_image(message, "/some/topic"), labels)


def test_a_label_that_does_not_fit_is_not_written() -> None:
    for labels, bits in (([[255]], 8), ([[65535]], 16), ([[-2]], 16)):
        with pytest.raises(MaskFormatError, match=rf"labels are {labels[0][0]} to .*{bits} bits hold -1 to"):
            mask_image(np.array(labels), HEADER, bits)


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "32FC1", "8UC3", "mono1", ""])
def test_a_mask_of_another_encoding_is_refused(encoding: str) -> None:
    message = refusal(MaskFormatError, labels_from_image, image(np.zeros((2, 3), np.uint8), encoding), "/some/topic")
    assert f"'{encoding}'" in message
    assert "mono8, 8UC1, mono16, 16UC1, 16SC1, 32SC1" in message


@pytest.mark.parametrize(("width", "height"), [(0, 2), (3, 0), (0, 0)])
def test_a_mask_without_pixels_is_refused(width: int, height: int) -> None:
    message = Image(width=width, height=height, encoding="mono8", step=width)
    assert f"{width} x {height}" in refusal(MaskFormatError, labels_from_image, message, "/some/topic")


def test_a_mask_with_too_few_bytes_is_refused() -> None:
    short = image(np.zeros((4, 3), np.uint16), "mono16")
    short.data = short.data[:-1]
    assert "23 bytes with a step of 6" in refusal(MaskFormatError, labels_from_image, short, "/some/topic")
    narrow = image(np.zeros((4, 3), np.uint16), "mono16")
    narrow.step = 5
    assert "step of at least 6" in refusal(MaskFormatError, labels_from_image, narrow, "/some/topic")


@pytest.mark.parametrize("label", [-2, 65535, 2**31 - 1])
def test_a_label_that_no_class_can_have_is_refused(label: int) -> None:
    mask = image(np.array([[0, label]], np.int32), "32SC1")
    assert str(label) in refusal(MaskFormatError, labels_from_image, mask, "/some/topic")


def test_pictures_and_confidences_are_written_pixel_by_pixel() -> None:
    pixels = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
    message = rgb_image(pixels[:, ::-1], HEADER)  # Not contiguous.
    assert (message.encoding, message.height, message.width, message.step) == ("rgb8", 2, 4, 12)
    assert np.array_equal(np.frombuffer(message.data, np.uint8).reshape(2, 4, 3), pixels[:, ::-1])
    values = np.linspace(0, 1, 6).reshape(2, 3)
    message = confidence_image(values, HEADER)
    assert (message.encoding, message.height, message.width, message.step) == ("32FC1", 2, 3, 12)
    assert np.array_equal(np.frombuffer(message.data, "<f4").reshape(2, 3), values.astype(np.float32))


def test_pictures_and_confidences_come_back_as_they_were() -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (5, 7, 3), np.uint8)
    np.testing.assert_array_equal(picture_from_image(rgb_image(pixels, HEADER), "overlay"), pixels)
    confidence = np.random.default_rng(1).random((5, 7), np.float32)
    np.testing.assert_array_equal(picture_from_image(confidence_image(confidence, HEADER), "confidence"), confidence)


def test_a_picture_of_another_kind_or_cut_short_is_refused() -> None:
    labels = mask_image(np.zeros((2, 2), int), HEADER, 16)
    assert "'mono16'" in refusal(MaskFormatError, picture_from_image, labels, "/some/topic")
    message = rgb_image(np.zeros((2, 2, 3), np.uint8), HEADER)
    message.data = message.data[:-1]
    assert "11 bytes" in refusal(MaskFormatError, picture_from_image, message, "/some/topic")


@given(st.dictionaries(st.integers(0, 65534), st.text(max_size=100), max_size=12))
def test_every_class_gets_a_valid_topic_token_of_its_own(names: dict[int, str]) -> None:
    tokens = topic_tokens(names)
    assert tokens.keys() == names.keys()
    assert len(set(tokens.values())) == len(names)
    for token in tokens.values():
        assert re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", token)
        assert "__" not in token
        assert not token.endswith("_")
        assert len(token) < 100


def test_topic_tokens_stay_close_to_the_names() -> None:
    names = {
        0: "background",
        1: "Chair",
        2: "potted plant!",
        3: "3d-printer",
        4: "5",
        5: "Küche",
        6: "椅子",
        7: "Chair",
    }
    assert topic_tokens(names) == {
        0: "background",
        1: "Chair",
        2: "potted_plant",
        3: "class_3d_printer",
        4: "class_5",
        5: "Kuche",
        6: "class_6",
        7: "Chair_7",
    }


def test_a_token_made_unique_does_not_meet_a_third_class() -> None:
    assert topic_tokens({1: "a", 2: "a_3", 3: "a"}) == {1: "a", 2: "a_3", 3: "a_3_3"}
