"""Files as they come in: regular ones only, of a size that is believed, and one line about any other."""

from __future__ import annotations

import json
import os
import socket
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from small_scenes import balls_on_a_table, ring, write_dataset

from gsseg_core.data.camera_files import read_cameras
from gsseg_core.data.class_names import read_classes
from gsseg_core.data.dataset import Dataset
from gsseg_core.data.label_images import read_mask
from gsseg_core.data.mask_files import read_soft_mask
from gsseg_core.errors import (
    CameraFileError,
    ClassesFileError,
    GssegError,
    MaskFormatError,
    SplitFileError,
    StateFileError,
    SupervisesFileError,
)
from gsseg_core.files import input_files
from gsseg_core.files.input_files import open_input
from gsseg_core.files.json_files import read_json
from gsseg_core.files.limits import Limits
from gsseg_core.learn.learner_state import State
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import Segmentation
from gsseg_core.text import clipped, quoted

SCENE, _ = balls_on_a_table()
READERS: dict[str, Callable[[Path], object]] = {
    "scene.ply": GaussianScene.load,
    "segmentation.npz": lambda path: Segmentation.load(path, SCENE),
    "state.npz": lambda path: State.load(path, SCENE.digest, len(SCENE)),
    "mask.png": read_mask,
    "mask.npz": lambda path: read_soft_mask(path, None, ring(1)[0]),
    "classes.json": read_classes,
    "cameras.json": lambda path: read_cameras(path.parent),
    "transforms.json": lambda path: read_cameras(path.parent),
    "cameras.bin": lambda path: read_cameras(path.parent.parent),
    "split.json": lambda path: Dataset(path.parent),
    "view0.tif": lambda path: read_soft_mask(path.parent, None, ring(1)[0]),
}


def refused(read: Callable[[], object], error: type[GssegError], *parts: str) -> None:
    with pytest.raises(error) as caught:
        read()
    message = str(caught.value)
    assert "\n" not in message and len(message) < 600
    for part in parts:
        assert part in message


def place(folder: Path, name: str) -> Path:
    """Make a folder in which only the file of this name is missing."""
    if name == "split.json":
        write_dataset(folder)
        (folder / name).unlink()
    if name == "cameras.bin":
        folder = folder / "sparse"
    folder.mkdir(parents=True, exist_ok=True)
    return folder / ("7.tif" if name == "view0.tif" else name)


@pytest.mark.parametrize("name", READERS)
def test_a_named_pipe_is_refused_at_once_whatever_it_is_named(tmp_path: Path, name: str) -> None:
    path = place(tmp_path / "data", name)
    os.mkfifo(path)
    refused(lambda: READERS[name](path), GssegError, str(path), "named pipe")


def test_a_device_a_socket_a_folder_and_a_path_with_nul_are_refused(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(tmp_path / "socket"))
        for path, kind in (("/dev/zero", "a device"), (tmp_path / "socket", "a socket"), (tmp_path, "a folder")):
            with pytest.raises(OSError, match=f"is {kind}"):
                open_input(path)
    with pytest.raises(OSError, match="null"):
        open_input("a\0b")
    (tmp_path / "link").symlink_to(__file__)
    with open_input(tmp_path / "link") as file:
        assert file.read(3) == b'"""'


@pytest.mark.parametrize(
    ("name", "error"),
    [
        ("split.json", SplitFileError), ("classes.json", ClassesFileError), ("cameras.json", CameraFileError),
        ("labels/supervises.json", SupervisesFileError),
    ],
)  # fmt: skip
def test_a_link_that_leads_nowhere_is_refused_with_its_target(
    tmp_path: Path, name: str, error: type[GssegError]
) -> None:
    write_dataset(tmp_path)
    (tmp_path / name).unlink(missing_ok=True)
    (tmp_path / name).symlink_to(tmp_path / "moved" / "away.json")
    refused(lambda: Dataset(tmp_path), error, str(tmp_path / name), str(tmp_path / "moved/away.json"), "does not exist")


def test_a_json_file_that_is_larger_than_the_limit_is_refused_unparsed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(input_files, "LIMITS", Limits(max_json_bytes=1000))
    path = tmp_path / "classes.json"
    path.write_text("[" + "[]," * 500 + "[]]")
    refused(lambda: read_json(path, ClassesFileError), ClassesFileError, "max_json_bytes", "1,000")


def png_that_claims(width: int, height: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


def test_an_image_that_claims_more_pixels_than_any_camera_takes_is_refused_by_its_header(tmp_path: Path) -> None:
    path = tmp_path / "view0.png"
    for width, height in ((100_000, 100_000), (2**31 - 1, 2**31 - 1), (12_000, 12_000)):
        path.write_bytes(png_that_claims(width, height))
        refused(lambda: read_mask(path), MaskFormatError, f"{width} x {height} pixels", "max_pixels")
        with (
            pytest.raises(MaskFormatError, match="view0"),
            input_files.open_image(path, MaskFormatError, "image", "a photo"),
        ):
            pass


def test_a_mask_of_another_size_than_its_camera_is_refused_before_its_pixels_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_dataset(tmp_path, cameras=ring(3))
    (tmp_path / "labels/view0.png").write_bytes(png_that_claims(8000, 8000))
    view = Dataset(tmp_path).views()[0]
    monkeypatch.setattr(Image, "open", lambda *_, **__: pytest.fail("the pixels were read"))
    refused(view.read_labels, GssegError, "view0.png", "8000 x 8000 pixels; expected 64 x 48")


@pytest.mark.parametrize("name", ["view0.png", "view0.npz"])
def test_too_little_memory_makes_no_mask_a_broken_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    write_dataset(tmp_path, cameras=ring(3))
    Image.new("L", (64, 48)).save(tmp_path / "labels/view0.png")
    np.savez(tmp_path / "labels/view0.npz", classes=[1], probabilities=np.ones((1, 48, 64), "f4"))
    (tmp_path / "labels" / ({"view0.png", "view0.npz"} - {name}).pop()).unlink()
    view = Dataset(tmp_path).views()[0]

    def exhausted(*_: object, **__: object) -> None:
        raise MemoryError("Unable to allocate 1.35 GiB")

    monkeypatch.setattr(np.lib.format, "read_array", exhausted)
    monkeypatch.setattr(Image.Image, "load", exhausted)
    with pytest.raises(MemoryError, match="Unable to allocate"):
        view.read_labels()


def test_foreign_text_in_a_message_is_short_printable_and_on_one_line(tmp_path: Path) -> None:
    assert clipped("a\nb\x1b[31m\u202e") == r"a\nb\x1b[31m\u202e" and clipped("käse") == "käse"
    assert len(clipped("x" * 5000)) == len(quoted("y" * 5000)) == 80
    write_dataset(tmp_path, scene=SCENE, truth=balls_on_a_table()[1])
    (tmp_path / "split.json").write_text('{"train": ["' + "z" * 5000 + '"]}')
    refused(lambda: Dataset(tmp_path), SplitFileError, "zzz...")


def test_a_missing_file_is_named_with_what_was_expected(tmp_path: Path) -> None:
    refused(lambda: State.load(tmp_path / "no.npz", "", 1), StateFileError, "no.npz: does not exist; expected a saved")


@pytest.mark.parametrize(
    ("entry", "parts"),
    [
        ({"width": 60_000, "height": 60_000}, ("60000 x 60000 pixels", "max_pixels")),
        ({"width": 1e300}, ("pixels", "max_pixels")),
        ({"width": float("inf")}, ("'width' is inf",)),
        ({"height": float("nan")}, ("'height' is nan",)),
        ({"width": 10**400}, ("'width' is 1000",)),
        ({"img_name": "n" * 5000, "fx": -1}, ("nnn...",)),
    ],
)
def test_sizes_that_no_camera_has_are_refused_before_memory_is_taken(
    tmp_path: Path, entry: dict[str, object], parts: tuple[str, ...]
) -> None:
    camera = {
        "img_name": "a", "width": 64, "height": 48, "fx": 50.0, "fy": 50.0,
        "position": [0, 0, 0], "rotation": np.eye(3).tolist(),
    }  # fmt: skip
    (tmp_path / "cameras.json").write_text(json.dumps([{**camera, **entry}]))
    with pytest.raises(GssegError) as caught:
        read_cameras(tmp_path)
    message = str(caught.value)
    assert len(message) < 500 and all(part in message for part in (str(tmp_path / "cameras.json"), *parts))


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin"])
def test_a_colmap_count_beyond_the_file_is_refused_at_once(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "sparse"
    folder.mkdir()
    for file in ("cameras.bin", "images.bin"):
        (folder / file).write_bytes((2**60 if file == name else 0).to_bytes(8, "little"))
    with pytest.raises(CameraFileError, match=rf"{name}: is truncated; expected a whole COLMAP model"):
        read_cameras(tmp_path)
