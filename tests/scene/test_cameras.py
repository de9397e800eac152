"""Cameras and their files: in every format a known point of the world lands on a known pixel."""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from gsseg_core.data.camera_files import read_cameras
from gsseg_core.errors import CameraFileError, GssegError, IntrinsicsError, PathNotAllowedError, PoseError
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene

# A camera at POSITION looks along the world's +x, the world's +z being up. POINT lies 2 before it, 0.5 to its right and
# 0.25 below its axis: with focal lengths 100 and 120 it lands 25 pixels right of, and 15 below, the principal point.
POSITION = (1.0, 2.0, 3.0)
RIGHT, DOWN, FORWARD = (0.0, -1.0, 0.0), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0)
POINT = (3.0, 1.5, 2.75)
ROTATION = np.stack([RIGHT, DOWN, FORWARD], axis=1)  # camera to world, OpenCV axes
WIDTH, HEIGHT, FX, FY = 64, 48, 100.0, 120.0
K = np.array([[FX, 0, 32], [0, FY, 24], [0, 0, 1]])
WORLD_TO_CAMERA = np.block([[ROTATION.T, -ROTATION.T @ np.array(POSITION)[:, None]], [np.zeros(3), 1]])


def entry_3dgs(name: str = "0001", **changes: Any) -> dict[str, Any]:
    entry = {"id": 0, "img_name": name, "width": WIDTH, "height": HEIGHT, "position": list(POSITION)}
    return entry | {"rotation": ROTATION.tolist(), "fx": FX, "fy": FY} | changes


def transforms(name: str = "images/0001.png", frame: dict[str, Any] | None = None, **changes: Any) -> dict[str, Any]:
    pose = np.eye(4)
    pose[:3, :3] = np.stack([RIGHT, np.negative(DOWN), np.negative(FORWARD)], axis=1)  # OpenGL: y up, z backward
    pose[:3, 3] = POSITION
    content = {"fl_x": FX, "fl_y": FY, "cx": 30.0, "cy": 20.0, "w": WIDTH, "h": HEIGHT}
    content["frames"] = [{"file_path": name, "transform_matrix": pose.tolist()} | (frame or {})]
    return {key: value for key, value in (content | changes).items() if value is not None}


def write_colmap(
    folder: Path,
    names: tuple[str, ...] = ("room/0001.jpg",),
    model: str = "PINHOLE",
    params: tuple[float, ...] = (FX, FY, 30, 20),
    text: bool = False,
) -> Path:
    """Write a model as COLMAP does, with keypoints, one triangulated point, and one image that was not registered."""
    reconstruction = pycolmap.Reconstruction()
    camera = pycolmap.Camera(camera_id=7, model=model, width=WIDTH, height=HEIGHT, params=params)
    reconstruction.add_camera_with_trivial_rig(camera)
    point = reconstruction.add_point3D(np.array(POINT), pycolmap.Track(), np.zeros(3, np.uint8))
    for i, name in enumerate(names):
        keypoints = np.array([[1.0, 2.0], [55.0, 35.0]])
        image = pycolmap.Image(name=name, camera_id=7, image_id=i + 1, keypoints=keypoints)
        reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d(WORLD_TO_CAMERA[:3]))
        reconstruction.add_observation(point, pycolmap.TrackElement(i + 1, 1))
    reconstruction.add_image_with_trivial_frame(pycolmap.Image(name="lost.jpg", camera_id=7, image_id=99))
    folder.mkdir(parents=True)
    (reconstruction.write_text if text else reconstruction.write_binary)(str(folder))
    return folder


def write_json(path: Path, content: object) -> Path:
    path.write_text(json.dumps(content))
    return path


def assert_lands(camera: Camera, u: float, v: float) -> None:
    uv, depth = camera.project([POINT])
    np.testing.assert_allclose(uv, [[u, v]], atol=1e-9)
    np.testing.assert_allclose(depth, [2], atol=1e-12)
    np.testing.assert_allclose(camera.center, POSITION, atol=1e-12)
    assert (camera.name, camera.width, camera.height) == ("0001", WIDTH, HEIGHT)


def assert_refused(folder: Path, error: type[GssegError], *words: str) -> None:
    with pytest.raises(error) as caught:
        read_cameras(folder)
    message = str(caught.value)
    assert type(caught.value) is error and "\n" not in message
    for word in (str(folder), *words):
        assert word in message, message


# Camera


def test_a_known_point_lands_on_a_known_pixel() -> None:
    camera = Camera("0001", WIDTH, HEIGHT, K, WORLD_TO_CAMERA)
    assert_lands(camera, 57, 39)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (FX, FY, 32, 24)


def test_points_that_are_not_in_front_have_no_pixel() -> None:
    camera = Camera("0001", WIDTH, HEIGHT, K, np.eye(4))
    uv, depth = camera.project([[0, 0, -1], [1, 1, 0], [0, 0, 1]])
    np.testing.assert_array_equal(uv, [[np.nan] * 2, [np.nan] * 2, [32, 24]])
    np.testing.assert_array_equal(depth, [-1, 0, 1])


def test_a_camera_keeps_its_own_copy_of_the_matrices() -> None:
    pose = np.eye(4)
    camera = Camera("a", WIDTH, HEIGHT, K, pose)
    pose[0, 0] = 5
    assert camera.world_to_camera[0, 0] == 1


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_centre_is_where_the_camera_sits_and_every_rigid_motion_is_accepted(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    rotation *= np.sign(np.linalg.det(rotation))
    position = rng.normal(size=3) * 1000
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.T, -rotation.T @ position
    camera = Camera("a", WIDTH, HEIGHT, K, pose)
    np.testing.assert_allclose(camera.center, position, atol=1e-9)
    uv, depth = camera.project((position + 3 * rotation[:, 2])[None])
    np.testing.assert_allclose(uv, [[32, 24]], atol=1e-6)
    np.testing.assert_allclose(depth, [3], atol=1e-9)


def pose_with(row: int, column: int, value: float) -> np.ndarray:
    pose = np.eye(4)
    pose[row, column] = value
    return pose


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        (pose_with(0, 3, np.nan), "pose holds NaN or infinite numbers"),
        (pose_with(1, 1, np.inf), "pose holds NaN or infinite numbers"),
        (pose_with(2, 2, 0), r"pose is not invertible \(determinant 0\)"),
        (np.zeros((4, 4)), "pose is not invertible"),
        (pose_with(0, 0, -1), r"pose is not a rigid motion \(determinant -1"),
        (np.diag([2.0, 2, 2, 1]), r"pose is not a rigid motion \(determinant 8"),
        (pose_with(0, 1, 0.5), "pose is not a rigid motion"),
        (pose_with(3, 0, 0.5), "pose is not a rigid motion"),
        (np.eye(3), r"pose has shape \(3, 3\); expected \(4, 4\)"),
    ],
)
def test_impossible_poses_are_refused(pose: np.ndarray, message: str) -> None:
    with pytest.raises(PoseError, match=f"camera 'a': {message}"):
        Camera("a", WIDTH, HEIGHT, K, pose)


def K_with(row: int, column: int, value: float) -> np.ndarray:
    matrix = K.copy()
    matrix[row, column] = value
    return matrix


@pytest.mark.parametrize(
    ("width", "height", "matrix", "message"),
    [
        (0, 48, K, "width is 0; expected a whole number of pixels, at least 1"),
        (64, -3, K, "height is -3"),
        (64.5, 48, K, r"width is 64\.5"),
        (64, 48, np.eye(4), "expected 3 x 3 finite numbers"),
        (64, 48, K_with(0, 2, np.nan), "expected 3 x 3 finite numbers"),
        (64, 48, K_with(0, 0, 0), "focal lengths are 0 and 120; expected positive"),
        (64, 48, K_with(1, 1, -5), "focal lengths are 100 and -5; expected positive"),
        (64, 48, K_with(0, 1, 2), r"expected \[\[fx, 0, cx\]"),
        (64, 48, K_with(2, 2, 2), r"expected \[\[fx, 0, cx\]"),
    ],
)
def test_impossible_intrinsics_are_refused(width: Any, height: int, matrix: np.ndarray, message: str) -> None:
    with pytest.raises(IntrinsicsError, match=f"camera 'a': .*{message}"):
        Camera("a", width, height, matrix, np.eye(4))


# 3DGS cameras.json


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
        ([entry_3dgs("a/1.jpg"), entry_3dgs("b/1.png")], CameraFileError, ("2 images have the stem '1'",)),
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


# nerfstudio transforms.json


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


@pytest.mark.parametrize(
    ("content", "error", "words"),
    [
        (transforms(w=None), IntrinsicsError, ("entry 0", "image size is missing; expected 'w' and 'h'")),
        (transforms(fl_x=None, fl_y=None), IntrinsicsError, ("focal length is missing", "'camera_angle_x'")),
        (transforms(fl_x=0), IntrinsicsError, ("entry 0", "focal lengths are 0 and 120")),
        (transforms(fl_x=None, camera_angle_x=0), IntrinsicsError, ("'camera_angle_x' is 0; expected radians",)),
        (transforms(fl_x="wide"), CameraFileError, ("'fl_x' is wide; expected a number",)),
        (transforms(k1=0.1), IntrinsicsError, ("distortion (k1 = 0.1)", "undistort")),
        (transforms(frame={"p2": -0.1}), IntrinsicsError, ("distortion (p2 = -0.1)",)),
        (transforms(camera_model="OPENCV_FISHEYE"), IntrinsicsError, ("OPENCV_FISHEYE", "expected a pinhole")),
        (transforms(is_fisheye=True), IntrinsicsError, ("expected a pinhole",)),
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


# COLMAP


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


@pytest.mark.parametrize(
    ("model", "params"),
    [("SIMPLE_RADIAL", (FX, 30, 20, 0.1)), ("OPENCV", (FX, FY, 30, 20, 0, 0, 0, 1)), ("SIMPLE_FISHEYE", (FX, 30, 20))],
)
def test_colmap_lenses_with_distortion_are_refused(tmp_path: Path, model: str, params: tuple[float, ...]) -> None:
    write_colmap(tmp_path / "sparse" / "0", model=model, params=params)
    assert_refused(tmp_path, IntrinsicsError, "room/0001.jpg", model, "undistort the images first")


def test_colmap_images_of_one_stem_are_refused(tmp_path: Path) -> None:
    write_colmap(tmp_path / "sparse" / "0", ("left/1.jpg", "right/1.jpg"))
    assert_refused(tmp_path, CameraFileError, "2 images have the stem '1'")


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


# The folder


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
