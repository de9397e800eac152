"""Cameras and poses come out of their messages as they went in, and impossible ones are refused by name."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pycolmap
import pytest
from geometry_msgs.msg import Point, Pose, Quaternion, Transform, Vector3
from hypothesis import given
from hypothesis import strategies as st
from ros_message_cases import HEADER, IDENTITY, K, info, refusal
from sensor_msgs.msg import CameraInfo, RegionOfInterest

from gsseg_core.errors import IntrinsicsError, MaskSizeError, PoseError
from gsseg_core.scene.camera import Camera, rigid_motion
from gsseg_ros.camera_infos import (
    camera_from_messages,
    camera_of_image,
    image_size,
    is_rectified,
)
from gsseg_ros.conversions import (
    array_from_point,
    camera_info,
    matrix_from_pose,
    matrix_from_transform,
    pose_from_matrix,
    viewpoint_messages,
)
from gsseg_ros.frames import Similarity, rotation_from_quaternion


def intrinsics_from_info(message: CameraInfo, topic: str) -> tuple[np.ndarray, int, int]:
    """Intrinsic matrix, width and height of an undistorted view."""
    camera = camera_from_messages("view", message, np.eye(4), IDENTITY, topic)
    return camera.K, camera.width, camera.height


def test_intrinsics_are_taken_as_they_stand() -> None:
    matrix, width, height = intrinsics_from_info(info(), "/some/topic")
    assert np.array_equal(matrix, K)
    assert (width, height) == (64, 48)


@pytest.mark.parametrize(
    "changes",
    [{"d": []}, {"binning_x": 1, "binning_y": 1}, {"roi": RegionOfInterest(width=64, height=48, do_rectify=True)}],
)
def test_no_distortion_no_binning_and_the_full_image_can_be_said_in_several_ways(changes: dict[str, Any]) -> None:
    assert intrinsics_from_info(info(**changes), "/some/topic")[1:] == (64, 48)


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"d": [0.0, 0.0, 0.0, 0.0, 1e-9]}, "1e-09"),
        ({"d": [math.nan]}, "nan"),
        ({"width": 0}, "width is 0"),
        ({"height": 0}, "height is 0"),
        ({"binning_x": 65}, "0 x 48"),
        ({"roi": RegionOfInterest(x_offset=33, width=32, height=24)}, "32 x 24 at (33, 0)"),
        ({"roi": RegionOfInterest(y_offset=2**32 - 1, width=32, height=24)}, "at (0, 4294967295)"),
        ({"roi": RegionOfInterest(x_offset=4)}, "at (4, 0)"),
        ({"k": np.zeros(9)}, "0 and 0"),
        ({"k": np.diag([100.0, -1.0, 1.0]).ravel()}, "-1"),
        ({"k": np.full(9, math.nan)}, "nan"),
        ({"k": np.diag([100.0, 100.0, 2.0]).ravel()}, "2.0"),
    ],
)
def test_a_camera_info_that_is_not_of_a_rectified_pinhole_image_is_refused(changes: dict[str, Any], found: str) -> None:
    assert found in refusal(IntrinsicsError, intrinsics_from_info, info(**changes), "/some/topic")


def test_a_camera_survives_its_camera_info() -> None:
    camera = Camera("view", 64, 48, K, np.eye(4))
    message = camera_info(camera, HEADER)
    assert message.header == HEADER
    assert message.distortion_model == "plumb_bob"
    assert list(message.d) == [0.0] * 5
    assert np.array_equal(message.r.reshape(3, 3), np.eye(3))
    assert np.array_equal(message.p.reshape(3, 4), np.c_[K, [0, 0, 0]])
    matrix, width, height = intrinsics_from_info(message, "/some/topic")
    assert np.array_equal(matrix, K)
    assert (width, height) == (64, 48)


components = st.floats(-1, 1)


@given(
    st.tuples(components, components, components, components).filter(lambda q: math.hypot(*q) > 1e-3),
    st.tuples(*[st.floats(-1e3, 1e3)] * 3),
)
def test_a_rigid_motion_survives_its_pose(q: tuple[float, ...], place: tuple[float, ...]) -> None:
    matrix = rigid_motion(rotation_from_quaternion(*q), place)
    assert np.allclose(matrix_from_pose(pose_from_matrix(matrix), "/some/topic"), matrix, rtol=0, atol=1e-12)


def test_pose_and_transform_of_the_same_numbers_are_the_same_motion() -> None:
    turn = Quaternion(x=0.5, y=0.5, z=-0.5, w=0.5)
    pose = Pose(position=Point(x=1.0, y=2.0, z=3.0), orientation=turn)
    transform = Transform(translation=Vector3(x=1.0, y=2.0, z=3.0), rotation=turn)
    matrix = matrix_from_pose(pose, "/some/topic")
    assert np.array_equal(matrix, matrix_from_transform(transform, "/some/topic"))
    assert np.allclose(matrix, [[0, 1, 0, 1], [0, 0, -1, 2], [-1, 0, 0, 3], [0, 0, 0, 1]], atol=1e-15)


@pytest.mark.parametrize(
    ("position", "orientation", "found"),
    [
        ((math.nan, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), "nan"),
        ((0.0, math.inf, 0.0), (0.0, 0.0, 0.0, 1.0), "inf"),
        ((0.0, 0.0, 0.0), (0.0, math.nan, 0.0, 1.0), "nan"),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0), "all zeros: was it filled in?"),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.002), "length 1.002"),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1e300), "length 1e+300"),
    ],
)
def test_an_impossible_pose_is_refused(position: Any, orientation: Any, found: str) -> None:
    (x, y, z), (qx, qy, qz, qw) = position, orientation
    # As it comes in over the wire: rclpy checks the range of numbers only where a message is filled in.
    pose = Pose(check_fields=False)
    pose.position = Point(x=x, y=y, z=z, check_fields=False)
    pose.orientation = Quaternion(x=qx, y=qy, z=qz, w=qw, check_fields=False)
    assert found in refusal(PoseError, matrix_from_pose, pose, "/some/topic")


def test_a_quaternion_of_few_digits_still_gives_a_rotation() -> None:
    pose = Pose(orientation=Quaternion(x=0.707, y=0.0, z=0.0, w=0.707))
    rotation = matrix_from_pose(pose, "/some/topic")[:3, :3]
    assert np.allclose(rotation @ rotation.T, np.eye(3), rtol=0, atol=1e-15)


def test_a_camera_is_built_from_camera_info_pose_and_similarity() -> None:
    similarity = Similarity.from_parameters(2.0, [10.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])
    camera = camera_from_messages("view", info(), rigid_motion(np.eye(3), [14.0, 0.0, 0.0]), similarity, "/some/topic")
    assert (camera.name, camera.width, camera.height) == ("view", 64, 48)
    assert np.allclose(camera.center, [2, 0, 0])
    refusal(IntrinsicsError, camera_from_messages, "view", info(d=[1.0]), np.eye(4), IDENTITY, "/some/topic")


def test_a_viewpoint_comes_back_as_the_camera_it_was() -> None:
    pose = rigid_motion(rotation_from_quaternion(0.1, 0.7, -0.1, 0.7), (1.0, -2.0, 3.0))
    camera = Camera("viewpoint", 64, 48, K, pose)
    message, info = viewpoint_messages(camera)
    assert message.header.frame_id == ""
    back = camera_from_messages("viewpoint", info, matrix_from_pose(message.pose, "viewpoint"), IDENTITY, "viewpoint")
    np.testing.assert_allclose(back.world_to_camera, pose, atol=1e-12)
    assert (back.K == K).all() and (back.width, back.height) == (64, 48)


def test_a_point_is_an_array() -> None:
    np.testing.assert_array_equal(array_from_point(Point(x=1.0, y=2.0, z=3.0)), [1, 2, 3])


BENT = {"d": [-0.2, 0.03, 0.001, -0.001, 0.0], "distortion_model": "plumb_bob"}
P = np.array([[90.0, 0, 33, -9], [0, 105, 22, 0], [0, 0, 1, 0]])


def of_image(
    message: CameraInfo, size: tuple[int, int] = (64, 48), rectified: bool = False, topic: str = "/some/topic"
) -> Camera:
    return camera_of_image("view", message, size, np.eye(4), "/mask", topic, rectified=rectified)


@pytest.mark.parametrize(
    ("setting", "topic", "expected"),
    [
        ("auto", "/camera/image_rect", True),
        ("auto", "/camera/image_rect_color", True),
        ("auto", "/camera/rect/camera_info", True),
        ("auto", "/rectified/mask", True),
        ("auto", "/segmenter/mask", False),
        ("auto", "/rectangles/direct", False),
        ("true", "/segmenter/mask", True),
        ("false", "/camera/image_rect", False),
    ],
)
def test_a_stream_is_rectified_as_the_parameter_or_its_name_says(setting: str, topic: str, expected: bool) -> None:
    assert is_rectified(setting, topic, "/camera_info") == is_rectified(setting, "/mask", topic) == expected


def test_of_a_rectified_image_p_counts_whatever_the_raw_camera_has() -> None:
    camera = of_image(info(**BENT, p=P.ravel()), rectified=True)
    assert np.array_equal(camera.K, P[:, :3]) and camera.undistortion is None
    assert np.array_equal(of_image(info(**BENT), rectified=True).K, K), "without p, k"
    assert np.array_equal(of_image(info(p=P.ravel())).K, K), "without distortion, image_proc passes images on"


@pytest.mark.parametrize(
    ("model", "d"),
    [
        ("plumb_bob", [-0.2, 0.03, 0.001, -0.001, 0.01]),
        ("plumb_bob", [-0.2, 0.03, 0.001, -0.001]),
        ("rational_polynomial", [0.2, -0.05, 0.001, 0.002, 0.01, 0.4, 0.02, 0.001]),
        ("equidistant", [0.05, -0.01, 0.003, -0.0005]),
    ],
)
def test_a_raw_image_becomes_what_image_proc_makes_of_it(model: str, d: list[float]) -> None:
    turned = rotation_from_quaternion(0.01, -0.02, 0.005, 0.9997)
    camera = of_image(info(d=d, distortion_model=model, p=P.ravel(), r=turned.ravel()))
    assert (camera.width, camera.height) == (64, 48) and np.array_equal(camera.K, P[:, :3])
    assert np.array_equal(camera.world_to_camera, np.eye(4)), "the frame is that of the rectified image"
    colmap = {"plumb_bob": "FULL_OPENCV", "rational_polynomial": "FULL_OPENCV", "equidistant": "OPENCV_FISHEYE"}[model]
    count = 8 if colmap == "FULL_OPENCV" else 4
    params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *d, *[0.0] * (count - len(d))]
    raw = pycolmap.Camera(camera_id=1, model=colmap, width=64, height=48, params=params)
    image = np.arange(64 * 48, dtype=np.int32).reshape(48, 64)
    assert camera.undistortion is not None
    seen = camera.undistortion.sample(image, -1)
    for row, column in np.ndindex(48, 64):
        ray = turned.T @ np.linalg.inv(P[:, :3]) @ (column + 0.5, row + 0.5, 1)
        u, v = raw.img_from_cam(ray).ravel()
        inside = 0 <= u < 64 and 0 <= v < 48
        assert seen[row, column] == (image[int(v), int(u)] if inside else -1)


def test_without_p_a_raw_image_becomes_the_view_that_keeps_its_focal_length() -> None:
    camera = of_image(info(**BENT))
    assert (camera.fx, camera.fy) == (K[0, 0], K[1, 1]) and camera.width > 64
    assert camera.image_size == (64, 48)


def test_what_a_camera_info_cuts_out_and_bins_is_the_camera_of_the_image() -> None:
    cut = info(**BENT, p=P.ravel(), roi=RegionOfInterest(x_offset=10, y_offset=4, width=41, height=32), binning_x=2)
    of_cut = np.diag([0.5, 1, 1]) @ np.array([[1, 0, -10], [0, 1, -4], [0, 0, 1]])
    assert image_size(cut, "/some/topic") == (20, 32)
    np.testing.assert_allclose(of_image(cut, (20, 32), rectified=True).K, of_cut @ P[:, :3])
    np.testing.assert_allclose(of_image(cut, (10, 16), rectified=True).K, np.diag([0.5, 0.5, 1]) @ of_cut @ P[:, :3])
    cut.d = []
    matrix, width, height = intrinsics_from_info(cut, "/some/topic")
    np.testing.assert_allclose(matrix, of_cut @ K)
    assert (width, height) == (20, 32)
    message = refusal(MaskSizeError, of_image, cut, (64, 48))
    assert message.startswith("/mask: image is 64 x 48 pixels; expected 20 x 32, as /some/topic says")


def test_of_a_raw_image_a_part_is_undistorted_as_that_part_of_the_whole() -> None:
    image = np.arange(64 * 48, dtype=np.int32).reshape(48, 64)
    part = RegionOfInterest(x_offset=16, y_offset=8, width=32, height=24)
    whole = of_image(info(**BENT, p=P.ravel())).undistortion
    seen = of_image(info(**BENT, p=P.ravel(), roi=part), (32, 24)).undistortion
    assert whole is not None and seen is not None
    expected = whole.sample(image, -1)[8:32, 16:48]
    got = seen.sample(image[8:32, 16:48], -1)
    inside = got >= 0
    assert inside.mean() > 0.75 and np.array_equal(got[inside], expected[inside])


def test_intrinsics_are_scaled_to_the_size_of_the_mask() -> None:
    half = np.diag([0.5, 0.5, 1])
    np.testing.assert_allclose(of_image(info(), (32, 24)).K, half @ K)
    np.testing.assert_allclose(of_image(info(**BENT, p=P.ravel()), (32, 24), rectified=True).K, half @ P[:, :3])
    raw = of_image(info(**BENT, p=P.ravel()), (32, 24))
    np.testing.assert_allclose(raw.K, half @ P[:, :3])
    assert raw.undistortion is not None and raw.undistortion.lens.focal == (50.0, 60.0)
    assert of_image(info(width=1241, height=376), (620, 188)).width == 620, "rounded to whole pixels"
    message = refusal(MaskSizeError, of_image, info(), (48, 48))
    assert message.startswith(
        "/mask: image is 48 x 48 pixels; expected 64 x 48, as /some/topic says, or a size of the "
    )


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"d": [math.nan]}, "k1 = nan"),
        ({"d": [1e12]}, "is it calibrated for"),
        ({"d": [-99.0]}, "cannot be undone"),
        ({"d": [0.1] * 8}, "d has 8 coefficients; expected the 5 of plumb_bob"),
        ({"d": [0.1], "distortion_model": "mirror"}, "distortion_model is 'mirror'; expected plumb_bob, rational"),
        ({**BENT, "p": P.ravel(), "r": np.diag([1.0, 1, 2]).ravel()}, "expected a rotation"),
        ({**BENT, "p": np.where(P == 105, -1, P).ravel()}, "focal lengths are 90 and -1"),
        ({**BENT, "k": np.zeros(9)}, "focal lengths are 0 and 0"),
        ({**BENT, "width": 0}, "width is 0"),
        ({**BENT, "roi": RegionOfInterest(width=65, height=48)}, "roi is 65 x 48 at (0, 0)"),
    ],
)
def test_an_absurd_lens_is_refused_by_the_name_of_its_topic(changes: dict[str, Any], found: str) -> None:
    message = info(**{"distortion_model": "plumb_bob", **changes})
    assert found in refusal(IntrinsicsError, of_image, message)
