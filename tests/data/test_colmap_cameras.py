"""COLMAP models, binary and text: a known point lands on a known pixel, and what is broken is refused."""

from __future__ import annotations

import math
import struct
import sys
from pathlib import Path

import pytest
from camera_folders import (
    FX,
    FY,
    assert_lands,
    assert_refused,
    write_colmap,
)

from gsseg_core.data.camera_files import read_cameras
from gsseg_core.errors import CameraFileError, PathNotAllowedError, PoseError


@pytest.mark.parametrize("text", [False, True], ids=["bin", "txt"])
@pytest.mark.parametrize("sub", ["sparse/0", "sparse"])
def test_colmap_cameras_land_the_point_on_its_pixel(tmp_path: Path, sub: str, text: bool) -> None:
    write_colmap(tmp_path / sub, ("room/0001.jpg", "room/0002.jpg"), text=text)
    first, second = read_cameras(tmp_path)
    assert_lands(first, 30 + 25, 20 + 15)
    assert second.name == "0002"


@pytest.mark.parametrize("text", [False, True], ids=["bin", "txt"])
def test_colmap_models_without_rigs_and_points_are_read(tmp_path: Path, text: bool) -> None:
    model = write_colmap(tmp_path / "sparse" / "0", text=text)
    for name in ("rigs", "frames", "points3D"):
        (model / name).with_suffix(".txt" if text else ".bin").unlink()
    assert_lands(read_cameras(tmp_path)[0], 55, 35)


def test_colmap_cameras_need_no_pycolmap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_colmap(tmp_path / "sparse")
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    assert_lands(read_cameras(tmp_path)[0], 55, 35)


def test_a_colmap_model_that_leads_out_of_its_bounds_is_refused(tmp_path: Path) -> None:
    data = tmp_path / "root" / "data"
    images = write_colmap(data / "sparse" / "0") / "images.bin"
    names = [camera.name for camera in read_cameras(data, within=tmp_path / "root")]
    images.rename(tmp_path / "images.bin")
    images.symlink_to(tmp_path / "images.bin")
    assert [camera.name for camera in read_cameras(data)] == names
    with pytest.raises(PathNotAllowedError, match=r"images\.bin: leads out of"):
        read_cameras(data, within=tmp_path / "root")


@pytest.mark.parametrize(
    ("model", "params", "fy"),
    [("SIMPLE_PINHOLE", (FX, 30, 20), FX), ("SIMPLE_RADIAL", (FX, 30, 20, 0), FX), ("OPENCV", (FX, FY, 30, 20), FY)],
)
def test_colmap_lenses_without_distortion_are_accepted(
    tmp_path: Path, model: str, params: tuple[float, ...], fy: float
) -> None:
    params += (0,) * 4 if model == "OPENCV" else ()
    write_colmap(tmp_path / "sparse" / "0", model=model, params=params)
    assert_lands(read_cameras(tmp_path)[0], 55, 20 + fy / 8)


def test_colmap_images_of_one_stem_are_named_after_their_folders(tmp_path: Path) -> None:
    write_colmap(tmp_path / "sparse" / "0", ("rig/left/1.jpg", "rig/right/1.jpg", "rig/right/2.jpg"))
    assert [camera.name for camera in read_cameras(tmp_path)] == ["left_1", "right_1", "right_2"]


@pytest.mark.parametrize("text", [False, True], ids=["bin", "txt"])
def test_colmap_images_keep_the_spaces_in_their_names(tmp_path: Path, text: bool) -> None:
    write_colmap(tmp_path / "sparse" / "0", ("room/0001.jpg", "Küche hinten/photo 2 (1).JPG"), text=text)
    first, second = read_cameras(tmp_path)
    assert_lands(first, 55, 35)
    assert second.name == "photo 2 (1)"


def test_colmap_images_in_text_may_have_their_columns_aligned(tmp_path: Path) -> None:
    write_colmap(tmp_path / "sparse" / "0", ("room/0001.jpg", "0002.jpg"), text=True)
    images = tmp_path / "sparse" / "0" / "images.txt"
    images.write_text(images.read_text().replace(" ", "  "))
    first, second = read_cameras(tmp_path)
    assert_lands(first, 55, 35)
    assert second.name == "0002"


@pytest.mark.parametrize("end", ["\n\n", "\n", ""])
def test_the_last_colmap_image_in_text_counts_though_nothing_follows_it(tmp_path: Path, end: str) -> None:
    images = write_colmap(tmp_path / "sparse" / "0", text=True) / "images.txt"
    images.write_text("1 1 0 0 0 0 0 0 7 a.jpg\n\n2 1 0 0 0 0 0 0 7 b.jpg" + end)
    assert [camera.name for camera in read_cameras(tmp_path)] == ["a", "b"]


def test_colmap_images_in_text_without_lines_of_points_are_refused(tmp_path: Path) -> None:
    images = write_colmap(tmp_path / "sparse" / "0", text=True) / "images.txt"
    images.write_text("1 1 0 0 0 0 0 0 7 a.jpg\n2 1 0 0 0 0 0 0 7 b.jpg\n3 1 0 0 0 0 0 0 7 c.jpg\n")
    words = ("images.txt: after image 'a.jpg' comes '2 1 0 0 0 0 0 0 7 b.jpg", "expected its points, or an empty line")
    assert_refused(tmp_path, CameraFileError, *words)


def test_colmap_images_of_one_name_after_their_folders_too_are_refused(tmp_path: Path) -> None:
    write_colmap(tmp_path / "sparse" / "0", ("a/b_1.jpg", "a_b/1.jpg", "c/1.jpg"))
    assert_refused(tmp_path, CameraFileError, "2 images have the stem 'a_b_1'")


def test_a_colmap_model_of_no_registered_image_is_refused(tmp_path: Path) -> None:
    write_colmap(tmp_path / "sparse" / "0", ())
    assert_refused(tmp_path, CameraFileError, "holds no camera")


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin"])
def test_truncated_colmap_models_are_refused(tmp_path: Path, name: str) -> None:
    model = write_colmap(tmp_path / "sparse" / "0", ("1.jpg", "2.jpg"))
    whole = (model / name).read_bytes()
    for end in (*range(0, len(whole), 7), len(whole) - 1):
        (model / name).write_bytes(whole[:end])
        assert_refused(tmp_path, CameraFileError, name, "truncated")


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("cameras.txt", "7 PINHOLE 64 48 100 120"),
        ("cameras.txt", "7 FLAT 64 48 100 120 30 20"),
        ("cameras.txt", ""),
        ("images.txt", "1 1 0 0 0 0 0"),
        ("images.txt", "1 nan 0 0 0 0 0 0 7 0001.jpg\n\n"),
        ("images.txt", "1 1 0 0 0 0 0 0 8 other_camera.jpg\n\n"),
        ("images.txt", "1 1 0 0 0 0 0 0 7.0 0001.jpg\n\n"),
    ],
)
def test_broken_colmap_models_are_refused(tmp_path: Path, name: str, content: str) -> None:
    model = write_colmap(tmp_path / "sparse" / "0", text=True)
    (model / name).write_text(content)
    assert_refused(tmp_path, CameraFileError, "not a readable COLMAP model")


def test_a_colmap_image_name_that_is_no_text_is_refused(tmp_path: Path) -> None:
    images = write_colmap(tmp_path / "sparse" / "0") / "images.bin"
    images.write_bytes(images.read_bytes().replace(b"0001.jpg", b"000\xff.jpg"))
    assert_refused(tmp_path, CameraFileError, "image 1: its name is not UTF-8 text")


def test_a_colmap_model_without_images_is_refused(tmp_path: Path) -> None:
    (write_colmap(tmp_path / "sparse" / "0") / "images.bin").unlink()
    assert_refused(tmp_path, CameraFileError, "has cameras.bin but no images.bin")


@pytest.mark.parametrize(("value", "words"), [(0.0, "quaternion of zero"), (math.nan, "pose holds NaN")])
def test_impossible_poses_of_a_colmap_model_are_refused(tmp_path: Path, value: float, words: str) -> None:
    images = write_colmap(tmp_path / "sparse" / "0") / "images.bin"
    content = bytearray(images.read_bytes())
    struct.pack_into("<4d", content, 12, *[value] * 4)  # after the number of images and the id of the first
    images.write_bytes(content)
    assert_refused(tmp_path, PoseError, "0001.jpg", words)
