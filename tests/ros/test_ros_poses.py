"""Poses for the pairing: of messages at a mask's stamp or near it, in whichever frames, and of TF."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest
from pairing_events import MS, S, expire, pose

from gsseg_core.errors import SettingsError
from gsseg_core.scene.camera import rigid_motion
from gsseg_ros.node.pairing import Pairing
from gsseg_ros.node.pose_sources import GivenPose, InterpolatedPoses, MessagePoses, PoseFrames, TfFirst

HAS_TF = importlib.util.find_spec("tf2_ros") is not None


def test_interpolated_poses_lie_between_their_neighbours() -> None:
    poses = InterpolatedPoses(max_gap_s=0.2)
    for stamp in (1000 * MS, 1100 * MS):
        poses.add(stamp, GivenPose(pose(stamp / S)))
    between = poses.at(1025 * MS)
    assert between is not None
    assert np.allclose(between, pose(1.025), atol=1e-12)
    assert np.array_equal(poses.at(1100 * MS), pose(1.1))


@pytest.mark.parametrize("stamp", [999 * MS, 1301 * MS, 1200 * MS])
def test_poses_are_neither_extrapolated_nor_interpolated_over_a_gap(stamp: int) -> None:
    poses = InterpolatedPoses(max_gap_s=0.2)
    for known in (1000 * MS, 1099 * MS, 1300 * MS):
        poses.add(known, GivenPose(pose(known / S)))
    assert poses.at(stamp) is None


def test_a_segmenter_may_take_nine_seconds_beside_an_odometry_of_a_kilohertz() -> None:
    pairing, taken = Pairing(InterpolatedPoses()), 1000 * S
    pairing.add_camera_info(taken, "info", "camera")
    for stamp in range(taken - 3 * MS, taken + 9 * S, MS):
        pairing.add_pose(stamp, GivenPose(pose(1.0)))
    pairing.add_mask(taken, "mask", "camera")
    assert [paired.stamp for paired in pairing.take()] == [taken] and not pairing.dropped


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
            poses._heard.set_transform(transform, "test")
        found = poses.at(1500 * MS, "camera")
        assert found is not None
        assert np.allclose(found, pose(1.5))
        for stamp, frame in ((3 * S, "camera"), (0, "camera"), (1 * S, ""), (1 * S, "no_such_frame")):
            assert poses.at(stamp, frame) is None
            assert poses.problem
        poses.set_back(2 * S, 0)
        assert poses.at(1500 * MS, "camera") is None
        poses.close()
    finally:
        node.destroy_node()
        rclpy.shutdown(context=context)


@pytest.mark.parametrize(
    ("stamps", "found"),
    [((1000, 1030), 1.010), ((1000, 1060), 1.0), ((950, 1030), 1.030), ((1010,), None), ((950, 1060), None)],
)
def test_a_pose_near_enough_is_interpolated_or_taken_once_a_later_one_has_come(
    stamps: tuple[int, ...], found: float | None
) -> None:
    poses = MessagePoses(tolerance_s=0.02)
    for stamp in stamps:
        poses.add(stamp * MS, GivenPose(pose(stamp / 1000)))
    at = poses.at(1010 * MS) if len(stamps) > 1 else poses.at(1015 * MS)
    assert (None if at is None else round(at[0, 3], 9)) == found


def test_the_only_pose_within_the_tolerance_is_taken_when_the_waiting_time_is_over() -> None:
    pairing = Pairing(MessagePoses(tolerance_s=0.02))
    pairing.add_camera_info(1000 * MS, "info")
    pairing.add_mask(1000 * MS, "mask")
    pairing.add_pose(990 * MS, GivenPose(pose(0.99)))
    assert pairing.take() == []
    expire(pairing)
    (paired,) = pairing.take()
    assert paired.pose[0, 3] == 0.99


class Tree:
    """In the place of TF: x of each frame in its parent, from some time (ns) on."""

    problem = ""
    knows_frames = True

    def __init__(self, **known: tuple[str, float, int]) -> None:
        self.known, self.cleared = known, 0

    def look_up(self, frame_id: str, stamp: int, within: str = "") -> np.ndarray | None:
        x, frame = 0.0, frame_id
        while frame != (within or "map"):
            if frame not in self.known or stamp < self.known[frame][2]:
                return None
            x, frame = x + self.known[frame][1], self.known[frame][0]
        return pose(x)

    def at(self, stamp: int, frame_id: str = "", last_chance: bool = False, several: bool = False) -> np.ndarray | None:
        return self.look_up(frame_id, stamp)

    def too_late(self, stamp: int) -> bool:
        return False

    def set_back(self, before: int, began: int) -> None:
        self.cleared += 1


def test_poses_in_odom_wait_for_the_transform_to_the_map_and_are_never_too_late_for_it() -> None:
    tree = Tree(odom=("map", 10.0, 2 * S))
    poses = MessagePoses(frames=PoseFrames("map", tree))
    for stamp in (1 * S, 3 * S, 5 * S):
        poses.add(stamp, GivenPose(pose(stamp / S), "odom"))
    assert poses.at(1 * S) is None and not poses.too_late(1 * S)
    assert poses.too_late(1 * S + 1)
    found = poses.at(3 * S)
    assert found is not None and found[0, 3] == 13.0
    assert PoseFrames("map", tree).reaches_map("odom") and not PoseFrames("map").reaches_map("odom")


def test_poses_in_different_frames_are_not_interpolated() -> None:
    poses = InterpolatedPoses()
    for stamp, frame in ((1000, "odom"), (1100, "map"), (1200, "map")):
        poses.add(stamp * MS, GivenPose(pose(0), frame))
    assert poses.at(1050 * MS) is None
    assert poses.at(1150 * MS) is not None


@pytest.mark.parametrize(
    ("child", "frame", "given", "tf", "x"),
    [
        ("camera", "camera", 0.5, True, 1.0),  # Of the camera itself, whatever was given.
        ("base", "camera", 0.5, True, 1.5),
        ("base", "camera", 0.5, False, 1.5),
        ("base", "camera", None, True, 1.25),
        ("base", "left", None, True, None),  # Not known to TF yet.
        ("", "camera", 0.5, True, 1.5),
        ("", "camera", None, True, 1.0),
    ],
)
def test_the_child_frame_of_an_odometry_says_what_it_is_the_pose_of(
    child: str, frame: str, given: float | None, tf: bool, x: float | None
) -> None:
    tree = Tree(camera=("base", 0.25, 0)) if tf else None
    frames = PoseFrames("map", tree, None if given is None else pose(given))
    found = frames.camera_in_map(GivenPose(pose(1.0), "map", child), 1 * S, frame)
    assert (None if found is None else found[0, 3]) == x


def test_automatic_poses_are_those_of_tf_and_else_of_the_topic() -> None:
    tree = Tree(left=("map", 7.0, 2 * S))
    poses = TfFirst(tree)
    for stamp in (1 * S, 2 * S):
        poses.add(stamp, GivenPose(rigid_motion(np.eye(3), [0, stamp / S, 0])))
    assert np.array_equal(poses.at(1 * S, "left"), rigid_motion(np.eye(3), [0, 1, 0]))
    assert np.array_equal(poses.at(2 * S, "left"), pose(7.0))
    assert poses.at(2 * S, "right", several=True) is None, "the pose on the topic may be of the other camera"
    poses.set_back(2 * S, 1 * S)
    assert tree.cleared == 1 and poses.at(1 * S, "left") is None


def test_of_cameras_that_share_stamps_and_topics_those_that_tf_knows_are_paired() -> None:
    pairing = Pairing(TfFirst(Tree(left=("map", 7.0, 0))))
    for frame in ("left", "right"):
        pairing.add_camera_info(1 * S, frame, frame)
        pairing.add_mask(1 * S, frame, frame)
    pairing.add_pose(1 * S, GivenPose(pose(1.0)))
    expire(pairing)
    assert [(p.mask, p.pose[0, 3]) for p in pairing.take()] == [("left", 7.0)]
    assert pairing.dropped == {"no_pose": 1}
