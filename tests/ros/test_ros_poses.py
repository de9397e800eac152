"""Poses for the pairing: interpolated between those of an odometry, and looked up in TF at the stamp of a mask."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest
from pairing_events import MS, S, pose

from gsseg_core.errors import SettingsError
from gsseg_ros.node.pairing import InterpolatedPoses

HAS_TF = importlib.util.find_spec("tf2_ros") is not None


def test_interpolated_poses_lie_between_their_neighbours() -> None:
    poses = InterpolatedPoses(max_gap_s=0.2)
    for stamp in (1000 * MS, 1100 * MS):
        poses.add(stamp, pose(stamp / S))
    between = poses.at(1025 * MS)
    assert between is not None
    assert np.allclose(between, pose(1.025), atol=1e-12)
    assert np.array_equal(poses.at(1100 * MS), pose(1.1))


@pytest.mark.parametrize("stamp", [999 * MS, 1301 * MS, 1200 * MS])
def test_poses_are_neither_extrapolated_nor_interpolated_over_a_gap(stamp: int) -> None:
    poses = InterpolatedPoses(max_gap_s=0.2)
    for known in (1000 * MS, 1099 * MS, 1300 * MS):
        poses.add(known, pose(known / S))
    assert poses.at(stamp) is None


@pytest.mark.skipif(HAS_TF, reason="tf2_ros is here")
def test_without_tf2_ros_the_error_names_the_parameter_and_the_package() -> None:
    pytest.importorskip("geometry_msgs")
    from gsseg_ros.node.tf_poses import TfPoses

    with pytest.raises(SettingsError, match=r"pose_source is 'tf'.*tf2_ros.*ros-jazzy-tf2-ros-py"):
        TfPoses(None, "map")


@pytest.mark.skipif(not HAS_TF, reason="tf2_ros is not here")
def test_tf_poses_are_looked_up_at_the_stamp_and_never_the_latest() -> None:
    rclpy = pytest.importorskip("rclpy")
    from geometry_msgs.msg import TransformStamped

    from gsseg_ros.conversions import stamp_message
    from gsseg_ros.node.tf_poses import TfPoses

    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node("tf_poses_test", context=context)
    try:
        poses = TfPoses(node, "map")
        for stamp in (1 * S, 2 * S):
            transform = TransformStamped(child_frame_id="camera")
            transform.header.frame_id, transform.header.stamp = "map", stamp_message(stamp)
            transform.transform.translation.x = stamp / S
            poses._buffer.set_transform(transform, "test")
        found = poses.at(1500 * MS, "camera")
        assert found is not None
        assert np.allclose(found, pose(1.5))
        for stamp, frame in ((3 * S, "camera"), (0, "camera"), (1 * S, ""), (1 * S, "no_such_frame")):
            assert poses.at(stamp, frame) is None
            assert poses.problem
        poses.clear()
        assert poses.at(1500 * MS, "camera") is None
        poses.close()
    finally:
        node.destroy_node()
        rclpy.shutdown(context=context)
