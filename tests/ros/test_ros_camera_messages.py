"""Cameras and poses come out of their messages as they went in, and impossible ones are refused by name."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("sensor_msgs")

from geometry_msgs.msg import Point, Pose, Quaternion, Transform, Vector3
from ros_message_cases import HEADER, IDENTITY, K, info, refusal
from sensor_msgs.msg import RegionOfInterest

from gsseg_core.errors import IntrinsicsError, PoseError
from gsseg_core.scene.camera import Camera
from gsseg_ros.conversions import (
    array_from_point,
    camera_from_messages,
    camera_info,
    intrinsics_from_info,
    matrix_from_pose,
    matrix_from_transform,
    pose_from_matrix,
    viewpoint_messages,
)
from gsseg_ros.frames import Similarity, rigid, rotation_from_quaternion


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
        ({"binning_x": 2, "binning_y": 2}, "2 x 2"),
        ({"roi": RegionOfInterest(width=32, height=24)}, "32 x 24 at (0, 0)"),
        ({"roi": RegionOfInterest(x_offset=4)}, "at (4, 0)"),
        ({"k": np.zeros(9)}, "0 and 0"),
        ({"k": np.diag([100.0, -1.0, 1.0]).ravel()}, "-1"),
        ({"k": np.full(9, math.nan)}, "nan"),
        ({"k": np.diag([100.0, 100.0, 2.0]).ravel()}, "2.0"),
    ],
)
def test_a_camera_info_that_is_not_of_a_rectified_pinhole_image_is_refused(changes: dict[str, Any], found: str) -> None:
    assert found in refusal(IntrinsicsError, intrinsics_from_info, info(**changes), "/some/topic")


def test_distortion_is_refused_with_the_way_out() -> None:
    message = refusal(IntrinsicsError, intrinsics_from_info, info(d=[0.1] * 5), "/some/topic")
    assert "use the rectified topic" in message
    assert "image_proc" in message


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
    matrix = rigid(rotation_from_quaternion(*q), place)
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
    camera = camera_from_messages("view", info(), rigid(np.eye(3), [14.0, 0.0, 0.0]), similarity, "/some/topic")
    assert (camera.name, camera.width, camera.height) == ("view", 64, 48)
    assert np.allclose(camera.center, [2, 0, 0])
    refusal(IntrinsicsError, camera_from_messages, "view", info(d=[1.0]), np.eye(4), IDENTITY, "/some/topic")


def test_a_viewpoint_comes_back_as_the_camera_it_was() -> None:
    pose = rigid(rotation_from_quaternion(0.1, 0.7, -0.1, 0.7), (1.0, -2.0, 3.0))
    camera = Camera("viewpoint", 64, 48, K, pose)
    message, info = viewpoint_messages(camera)
    assert message.header.frame_id == ""
    back = camera_from_messages("viewpoint", info, matrix_from_pose(message.pose, "viewpoint"), IDENTITY, "viewpoint")
    np.testing.assert_allclose(back.world_to_camera, pose, atol=1e-12)
    assert (back.K == K).all() and (back.width, back.height) == (64, 48)


def test_a_point_is_an_array() -> None:
    np.testing.assert_array_equal(array_from_point(Point(x=1.0, y=2.0, z=3.0)), [1, 2, 3])
