"""Camera files: in every format a known point of the world lands on a known pixel, and what is broken is refused."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from camera_folders import (
    FX,
    FY,
    HEIGHT,
    WIDTH,
    assert_lands,
    assert_refused,
    entry_3dgs,
    transforms,
    write_colmap,
    write_json,
)
from PIL import Image

from gsseg_core.data.camera_files import read_cameras
from gsseg_core.errors import CameraFileError, GssegError, IntrinsicsError, PathNotAllowedError, PoseError
from gsseg_core.scene.gaussian_scene import GaussianScene


def test_3dgs_cameras_land_the_point_on_its_pixel(tmp_path: Path) -> None:
    write_json(tmp_path / "cameras.json", [entry_3dgs(), entry_3dgs("0002")])
    first, second = read_cameras(tmp_path)
    assert_lands(first, 32 + 25, 24 + 15)
    assert second.name == "0002"


@pytest.mark.parametrize(
    ("name", "stem"),
    [("IMG_1.JPG", "IMG_1"), ("a/b/0001.png", "0001"), ("a\\0001.jpeg", "0001"), ("frame.0001", "frame.0001")],
)
def test_names_are_stems_of_image_names(tmp_path: Path, name: str, stem: str) -> None:
    write_json(tmp_path / "cameras.json", [entry_3dgs(name)])
    assert [camera.name for camera in read_cameras(tmp_path)] == [stem]


@pytest.mark.parametrize(
    ("content", "error", "words"),
    [
        ([], CameraFileError, ("holds no camera",)),
        ({"cameras": []}, CameraFileError, ("holds an object", "expected a list of cameras")),
        ([entry_3dgs(), 7], CameraFileError, ("expected a list of cameras, each an object",)),
        ([entry_3dgs(), entry_3dgs()], CameraFileError, ("2 images have the stem '0001'",)),
        ([entry_3dgs("a/1.jpg"), entry_3dgs("a/1.png")], CameraFileError, ("2 images have the stem '1'",)),
        ([entry_3dgs("")], CameraFileError, ("entry 0", "'img_name' is ''")),
        ([entry_3dgs(), {"img_name": "b"}], CameraFileError, ("entry 1", "lacks 'width' (has img_name)")),
        ([entry_3dgs(rotation=[1, 2, 3])], CameraFileError, ("'rotation' is [1, 2, 3]", "3 x 3 numbers")),
        ([entry_3dgs(position=["a", 0, 0])], CameraFileError, ("'position' is", "expected 3 numbers")),
        ([entry_3dgs(fx="wide")], CameraFileError, ("'fx' is wide; expected a number",)),
        ([entry_3dgs(fx=0)], IntrinsicsError, ("entry 0", "focal lengths are 0 and 120")),
        ([entry_3dgs(width=1.5)], IntrinsicsError, ("'width' is 1.5",)),
        ([entry_3dgs(position=[math.nan, 0, 0])], PoseError, ("entry 0", "pose holds NaN")),
        ([entry_3dgs(rotation=np.zeros((3, 3)).tolist())], PoseError, ("entry 0", "pose is not invertible")),
        ([entry_3dgs(rotation=(2 * np.eye(3)).tolist())], PoseError, ("pose is not a rigid motion",)),
    ],
)
def test_broken_3dgs_cameras_are_refused(
    tmp_path: Path, content: object, error: type[GssegError], words: tuple[str, ...]
) -> None:
    write_json(tmp_path / "cameras.json", content)
    assert_refused(tmp_path, error, "cameras.json", *words)


@pytest.mark.parametrize("name", ["cameras.json", "transforms.json"])
def test_broken_json_is_refused_with_its_place(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text('[{"id": 0,')
    assert_refused(tmp_path, CameraFileError, name, "not valid JSON", "line 1 column")


def test_nerfstudio_cameras_land_the_point_on_its_pixel(tmp_path: Path) -> None:
    write_json(tmp_path / "transforms.json", transforms())
    assert_lands(read_cameras(tmp_path)[0], 30 + 25, 20 + 15)


def test_intrinsics_of_a_frame_go_before_those_of_the_file(tmp_path: Path) -> None:
    write_json(tmp_path / "transforms.json", transforms(frame={"fl_x": 200.0, "cx": 10}))
    assert_lands(read_cameras(tmp_path)[0], 10 + 50, 20 + 15)


def test_the_focal_length_may_be_a_field_of_view(tmp_path: Path) -> None:
    angle = 2 * math.atan(WIDTH / 2 / FX)
    content = transforms(fl_x=None, fl_y=None, cx=None, cy=None, camera_angle_x=angle)
    write_json(tmp_path / "transforms.json", content)
    assert_lands(read_cameras(tmp_path)[0], 32 + 25, 24 + 12.5)
    write_json(tmp_path / "transforms.json", content | {"camera_angle_y": 2 * math.atan(HEIGHT / 2 / FY)})
    assert_lands(read_cameras(tmp_path)[0], 32 + 25, 24 + 15)


def test_what_was_applied_to_the_poses_is_not_undone(tmp_path: Path) -> None:
    applied = [[0, 1, 0, 5], [1, 0, 0, 6], [0, 0, -1, 7]]
    write_json(tmp_path / "transforms.json", transforms(applied_transform=applied, applied_scale=0.5))
    assert_lands(read_cameras(tmp_path)[0], 55, 35)


def test_poses_of_three_rows_and_lenses_without_distortion_are_accepted(tmp_path: Path) -> None:
    rows = transforms()["frames"][0]["transform_matrix"][:3]
    content = transforms(frame={"transform_matrix": rows}, camera_model="OPENCV", k1=0, k2=0.0, w=64.0)
    write_json(tmp_path / "transforms.json", content)
    assert_lands(read_cameras(tmp_path)[0], 55, 35)


def test_a_camera_model_that_is_null_is_none_that_bends(tmp_path: Path) -> None:
    (tmp_path / "transforms.json").write_text(json.dumps(transforms() | {"camera_model": None}))
    assert_lands(read_cameras(tmp_path)[0], 55, 35)


def test_the_last_row_of_a_nerfstudio_pose_may_be_rounded(tmp_path: Path) -> None:
    content = transforms()
    content["frames"][0]["transform_matrix"][3] = [0.0, 0.0, 1e-17, 1.0000000000000002]
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    assert_lands(read_cameras(tmp_path)[0], 55, 35)


@pytest.mark.parametrize(("file", "name"), [("0001.png", "./train/0001"), ("0001.jpg", "train/0001.jpg")])
def test_where_no_size_is_given_the_images_are_asked(tmp_path: Path, file: str, name: str) -> None:
    angle = 2 * math.atan(WIDTH / 2 / FX)
    sizeless = dict.fromkeys(("fl_x", "fl_y", "cx", "cy", "w", "h"))
    write_json(tmp_path / "transforms_train.json", transforms(name, camera_angle_x=angle, **sizeless))
    assert_refused(tmp_path, IntrinsicsError, "entry 0: the image size is missing", f"train/{file}: cannot be read")
    (tmp_path / "train").mkdir()
    Image.new("RGBA" if file.endswith("png") else "RGB", (WIDTH, HEIGHT)).save(tmp_path / "train" / file)
    (camera,) = read_cameras(tmp_path)
    assert (camera.name, camera.image_size) == ("0001", (WIDTH, HEIGHT))
    assert_lands(camera, 32 + 25, 24 + 12.5)
    (tmp_path / "train" / file).rename(tmp_path.parent / file)
    (tmp_path / "train" / file).symlink_to(tmp_path.parent / file)
    with pytest.raises(PathNotAllowedError, match=file):
        read_cameras(tmp_path, within=tmp_path)


@pytest.mark.parametrize(
    ("content", "error", "words"),
    [
        (transforms(w=None), IntrinsicsError, ("entry 0", "image size is missing; expected 'w' and 'h'")),
        (transforms(fl_x=None, fl_y=None), IntrinsicsError, ("focal length is missing", "'camera_angle_x'")),
        (transforms(fl_x=0), IntrinsicsError, ("entry 0", "focal lengths are 0 and 120")),
        (transforms(fl_x=None, camera_angle_x=0), IntrinsicsError, ("'camera_angle_x' is 0; expected radians",)),
        (transforms(fl_x="wide"), CameraFileError, ("'fl_x' is wide; expected a number",)),
        (transforms(frames=None), CameraFileError, ("holds null", "expected a list 'frames'")),
        (transforms(frames=[]), CameraFileError, ("holds no camera",)),
        (transforms(frames=[{}]), CameraFileError, ("entry 0", "lacks 'file_path'")),
        ([], CameraFileError, ("holds a list; expected an object with 'frames'",)),
        (transforms(frame={"transform_matrix": [[1]]}), CameraFileError, ("4 x 4 numbers or 3 x 4 numbers",)),
        (transforms(frame={"transform_matrix": np.ones((4, 4)).tolist()}), PoseError, ("entry 0", "last row")),
        (transforms(frame={"transform_matrix": np.zeros((3, 4)).tolist()}), PoseError, ("not invertible",)),
        (transforms(frame={"transform_matrix": np.full((3, 4), np.nan).tolist()}), PoseError, ("NaN",)),
    ],
)
def test_broken_nerfstudio_cameras_are_refused(
    tmp_path: Path, content: object, error: type[GssegError], words: tuple[str, ...]
) -> None:
    write_json(tmp_path / "transforms.json", content)
    assert_refused(tmp_path, error, "transforms.json", *words)


def test_a_folder_without_cameras_is_refused_and_says_what_was_looked_for(tmp_path: Path) -> None:
    (tmp_path / "sparse").mkdir()
    assert_refused(tmp_path, CameraFileError, "has no cameras", "cameras.json", "transforms.json", "sparse/0", "sparse")
    assert_refused(tmp_path / "nowhere", CameraFileError, "is not a folder")


def test_cameras_json_goes_before_the_other_formats(tmp_path: Path) -> None:
    write_json(tmp_path / "transforms.json", transforms())
    write_colmap(tmp_path / "sparse" / "0")
    assert_lands(read_cameras(tmp_path)[0], 55, 35)
    write_json(tmp_path / "cameras.json", [entry_3dgs()])
    assert_lands(read_cameras(tmp_path)[0], 57, 39)


@pytest.mark.parametrize(("name", "count"), [("replica_apartment", 119), ("fern", 20)])
def test_real_scenes_project_onto_pixels_of_their_own_colour(real_data: Path, name: str, count: int) -> None:
    cameras = read_cameras(real_data / name)
    assert len(cameras) == count
    scene = GaussianScene.load(real_data / name / "scene.ply")
    solid = scene.subset((scene.opacities > 0.8) & (scene.scales.max(axis=1) < np.quantile(scene.scales, 0.9)))
    for camera in cameras[:: count // 3]:
        path = next((real_data / name / "images").glob(f"{camera.name}.*"))
        with Image.open(path) as image:
            photo = np.asarray(image.convert("RGB")) / 255
        assert photo.shape == (camera.height, camera.width, 3)
        uv, depth = camera.project(solid.means)
        inside = np.flatnonzero(((uv >= 0) & (uv < (camera.width, camera.height))).all(axis=1))
        pixels = uv[inside].astype(int) @ (1, camera.width)
        # The nearest Gaussian of each pixel decides.
        order = np.argsort(depth[inside], kind="stable")
        pixels, first = np.unique(pixels[order], return_index=True)
        colors = solid.colors(camera.center)[inside[order[first]]]
        error = np.abs(colors - photo.reshape(-1, 3)[pixels]).mean(axis=1)
        elsewhere = np.abs(colors - photo.reshape(-1, 3)[np.roll(pixels, len(pixels) // 2)]).mean(axis=1)
        assert np.median(error) < 0.7 * np.median(elsewhere)
