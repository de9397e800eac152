"""Label images and class names: exact round trips, and nothing that only looks like a mask."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image

from gsseg_core.data import label_images
from gsseg_core.data.class_names import read_classes
from gsseg_core.data.label_images import UNKNOWN, read_mask, write_mask
from gsseg_core.errors import ClassesFileError, MaskFormatError, SettingsError, WriteError


@pytest.mark.parametrize("bits", [8, 16])
@given(data=st.data())
def test_masks_survive_a_round_trip(tmp_path_factory: pytest.TempPathFactory, bits: int, data: st.DataObject) -> None:
    ids = st.one_of(st.just(UNKNOWN), st.integers(0, 2**bits - 2))
    labels = data.draw(hnp.arrays(np.int32, hnp.array_shapes(min_dims=2, max_dims=2, max_side=9), elements=ids))
    path = tmp_path_factory.mktemp("mask") / "mask.png"
    write_mask(path, labels, bits)
    mask = read_mask(path)
    assert mask.bits == bits and mask.labels.dtype == np.int32
    np.testing.assert_array_equal(mask.labels, labels)


def test_the_largest_number_means_unknown_only_in_its_own_encoding(tmp_path: Path) -> None:
    Image.fromarray(np.array([[0, 254, 255]], np.uint8)).save(tmp_path / "8.png")
    Image.fromarray(np.array([[255, 65534, 65535]], np.uint16)).save(tmp_path / "16.png")
    assert read_mask(tmp_path / "8.png").labels.tolist() == [[0, 254, UNKNOWN]]
    assert read_mask(tmp_path / "16.png").labels.tolist() == [[255, 65534, UNKNOWN]]


def test_a_mask_that_is_replaced_while_it_is_read_is_one_of_the_two(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, header = tmp_path / "mask.png", label_images.png_header
    Image.fromarray(np.array([[0, 255]], np.uint8)).save(path)

    def replaced_then_read(*start: Any) -> object:
        Image.fromarray(np.array([[0, 255]], np.uint16)).save(tmp_path / "new.png")
        (tmp_path / "new.png").replace(path)
        return header(*start)

    monkeypatch.setattr(label_images, "png_header", replaced_then_read)
    assert read_mask(path).labels.tolist() == [[0, UNKNOWN]]


@pytest.mark.parametrize("colours", [2, 5, 256])
def test_palette_images_are_read_as_their_indices(tmp_path: Path, colours: int) -> None:
    indices = (np.arange(12).reshape(3, 4) % colours).astype(np.uint8)
    image = Image.fromarray(indices)
    image.putpalette(np.random.default_rng(0).integers(0, 256, 3 * colours).tolist())
    image.save(tmp_path / "mask.png", bits={2: 1, 5: 4, 256: 8}[colours])
    mask = read_mask(tmp_path / "mask.png")
    assert mask.bits == 8
    np.testing.assert_array_equal(mask.labels, indices)


@pytest.mark.parametrize(
    ("mode", "found"),
    [("RGB", "RGB of 8"), ("RGBA", "RGBA of 8"), ("LA", r"gray \+ alpha of 8"), ("1", "gray of 1")],
)
def test_images_with_colours_or_of_one_bit_are_refused(tmp_path: Path, mode: str, found: str) -> None:
    Image.new(mode, (4, 3)).save(tmp_path / "mask.png")
    with pytest.raises(MaskFormatError, match=rf"mask\.png: is {found} bits per channel; expected a one-channel"):
        read_mask(tmp_path / "mask.png")


@pytest.mark.parametrize(("mode", "suffix"), [("F", ".tiff"), ("L", ".jpg"), ("L", ".bmp")])
def test_formats_other_than_png_are_refused_whatever_their_name(tmp_path: Path, mode: str, suffix: str) -> None:
    Image.new(mode, (40, 30)).save(tmp_path / f"mask{suffix}")
    (tmp_path / f"mask{suffix}").rename(tmp_path / "mask.png")
    with pytest.raises(MaskFormatError, match=r"mask\.png: not a PNG; expected"):
        read_mask(tmp_path / "mask.png")


def test_a_truncated_mask_is_refused(tmp_path: Path) -> None:
    write_mask(tmp_path / "mask.png", np.arange(2500, dtype=np.int32).reshape(50, 50), 16)
    whole = (tmp_path / "mask.png").read_bytes()
    for end in (0, 10, 26, 40, len(whole) // 2, len(whole) - 30):
        (tmp_path / "mask.png").write_bytes(whole[:end])
        with pytest.raises(MaskFormatError, match=r"mask\.png: .+; expected"):
            read_mask(tmp_path / "mask.png")


def test_a_mask_with_one_flipped_bit_is_refused_or_read_as_it_was(tmp_path: Path) -> None:
    path, labels = tmp_path / "mask.png", np.arange(64, dtype=np.int32).reshape(8, 8)
    write_mask(path, labels, 8, run="noted by its run")
    whole, same = path.read_bytes(), 0
    for bit in range(8 * len(whole)):
        flipped = bytearray(whole)
        flipped[bit // 8] ^= 1 << bit % 8
        path.write_bytes(flipped)
        try:
            np.testing.assert_array_equal(read_mask(path).labels, labels)
            same += 1
        except MaskFormatError as error:
            assert str(error).startswith(f"{path}: ") and str(error).isprintable()
    assert same > 0  # in the text of the run, which says nothing of pixels
    flipped = bytearray(whole)
    flipped[whole.index(b"IDAT") + 20] ^= 1
    path.write_bytes(flipped)
    said = r"mask\.png: broken PNG \(chunk IDAT is not as its checksum says\); expected a whole label image"
    with pytest.raises(MaskFormatError, match=said):
        read_mask(path)


def test_a_missing_mask_is_named(tmp_path: Path) -> None:
    with pytest.raises(MaskFormatError, match=r"nowhere\.png: cannot be read \(No such file or directory\)"):
        read_mask(tmp_path / "nowhere.png")


@pytest.mark.parametrize(("label", "bits"), [(255, 8), (300, 8), (65535, 16), (-2, 8), (-2, 16)])
def test_labels_that_do_not_fit_are_not_written(tmp_path: Path, label: int, bits: int) -> None:
    with pytest.raises(MaskFormatError, match=rf"labels are .*{label}.*; {bits} bits hold -1 to {2**bits - 2}"):
        write_mask(tmp_path / "mask.png", np.full((2, 2), label), bits)
    assert not list(tmp_path.iterdir())


def test_probabilities_are_not_written_as_labels(tmp_path: Path) -> None:
    with pytest.raises(MaskFormatError, match="labels are float64; expected whole numbers"):
        write_mask(tmp_path / "mask.png", np.full((2, 2), 0.9), 8)
    assert not list(tmp_path.iterdir())


def test_other_depths_are_not_written(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="masks of 32 bits were asked for; expected 8 or 16"):
        write_mask(tmp_path / "mask.png", np.zeros((2, 2), np.int32), 32)


def test_a_mask_that_cannot_be_written_is_one_clear_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(WriteError, match=r"file/mask\.png: cannot be written"):
        write_mask(tmp_path / "file" / "mask.png", np.zeros((2, 2), np.int32), 8)


def test_classes_are_sorted_and_have_a_background(tmp_path: Path) -> None:
    (tmp_path / "classes.json").write_text('{"10": "lamp", "2": "Tür", "65534": "last"}', encoding="utf-8")
    classes = read_classes(tmp_path / "classes.json")
    assert list(classes.items()) == [(0, "background"), (2, "Tür"), (10, "lamp"), (65534, "last")]
    (tmp_path / "classes.json").write_text('\ufeff{"0": "nothing"}', encoding="utf-8")
    assert read_classes(tmp_path / "classes.json") == {0: "nothing"}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('{"1": "chair"', "not valid JSON"),
        ("", "not valid JSON"),
        (b"\xff\xfe", "not valid JSON"),
        ("[" * 100_000, "not valid JSON"),
        ('["chair"]', "holds a list; expected an object"),
        ('{"chair": 1}', "id 'chair' is unusable; expected whole numbers from 0 to 65534"),
        ('{"-1": "chair"}', "id '-1' is unusable"),
        ('{"1.5": "chair"}', "id '1.5' is unusable"),
        ('{"01": "chair"}', "id '01' is unusable"),
        ('{"65535": "chair"}', "id '65535' is unusable"),
        ('{"1": 7}', "id 1 has the name 7; expected text"),
        ('{"1": " "}', "id 1 has the name ' '; expected text"),
    ],
)
def test_broken_classes_are_refused(tmp_path: Path, content: str | bytes, message: str) -> None:
    (tmp_path / "classes.json").write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ClassesFileError, match=rf"classes\.json: {message}") as caught:
        read_classes(tmp_path / "classes.json")
    assert "\n" not in str(caught.value)


def test_missing_classes_are_named(tmp_path: Path) -> None:
    with pytest.raises(ClassesFileError, match=r"classes\.json: cannot be read"):
        read_classes(tmp_path / "classes.json")


def test_real_masks_hold_the_classes_that_are_named(real_data: Path) -> None:
    folder = real_data / "replica_apartment"
    classes = read_classes(folder / "classes.json")
    assert list(classes) == list(range(41))
    for labels in ("labels", "labels_noisy"):
        mask = read_mask(folder / labels / "0001.png")
        assert mask.bits == 8 and mask.labels.shape == (320, 320)
        assert set(np.unique(mask.labels).tolist()) <= {UNKNOWN, *classes}


def test_classes_of_many_ids_are_read(tmp_path: Path) -> None:
    names = {i: f"object {i}" for i in range(1, 1000)}
    (tmp_path / "classes.json").write_text(json.dumps(names))
    assert read_classes(tmp_path / "classes.json") == {0: "background"} | names
