"""Poses from TF where time is set back without a clock that says so: a bag in a loop, as tf2's buffer takes it."""

from __future__ import annotations

import sys
from bisect import bisect_left, insort
from collections import defaultdict
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from pairing_events import MS, S, pose

pytest.importorskip("rclpy", reason="ROS is not installed")

from geometry_msgs.msg import TransformStamped

from gsseg_ros.conversions import stamp_message, stamp_ns
from gsseg_ros.node.pairing import Pairing
from gsseg_ros.node.pose_sources import GivenPose, MessagePoses, PoseFrames
from gsseg_ros.node.tf_poses import TfPoses

LATE = 7  # Masks of a slow segmenter that are under way.
CACHE = 10 * S  # What tf2 keeps.


class NotKnown(Exception):
    pass


class Buffer:
    """What tf2's does with frames that hang on the one that is asked for: ten seconds, nothing extrapolated."""

    def __init__(self) -> None:
        self.x: defaultdict[str, list[tuple[int, float]]] = defaultdict(list)

    def set_transform(self, transform: TransformStamped, authority: str) -> None:
        stamps, stamp = self.x[transform.child_frame_id], stamp_ns(transform.header.stamp)
        if not stamps or stamp >= stamps[-1][0] - CACHE:
            insort(stamps, (stamp, transform.transform.translation.x))
            while stamps[0][0] < stamps[-1][0] - CACHE:
                del stamps[0]

    def lookup_transform(self, target: str, source: str, time: Any) -> TransformStamped:
        known, stamp = self.x[source], time.nanoseconds
        after = bisect_left(known, (stamp, -np.inf))
        found = TransformStamped()
        if after < len(known) and known[after][0] == stamp:
            found.transform.translation.x = known[after][1]
        elif 0 < after < len(known):
            found.transform.translation.x = float(np.interp(stamp, *zip(*known[after - 1 : after + 1], strict=True)))
        else:
            raise NotKnown("lookup would require extrapolation")
        return found

    def clear(self) -> None:
        self.x.clear()


class TransformListener:
    def __init__(self, buffer: Any, node: list[Any]) -> None:
        node.append(buffer)


@pytest.fixture(name="tf")
def tf_fixture(monkeypatch: pytest.MonkeyPatch) -> tuple[TfPoses, Any]:
    """Poses from TF, and what the listener hands transforms to."""
    module: Any = ModuleType("tf2_ros")
    module.Buffer, module.TransformException = Buffer, NotKnown
    module.TransformListener = lambda buffer, node: node.append(buffer)
    monkeypatch.setitem(sys.modules, "tf2_ros", module)
    heard: list[Any] = []
    poses = TfPoses(heard, "map")
    poses.listen()
    return poses, heard[0]


def transform(stamp: int, x: float, child: str) -> TransformStamped:
    message = TransformStamped(child_frame_id=child)
    message.header.stamp, message.transform.translation.x = stamp_message(stamp), float(x)
    return message


@pytest.mark.parametrize("source", ["tf", "odom"])
@pytest.mark.parametrize("seconds", [5, 15])
@pytest.mark.parametrize("under_way", [0, 10])
def test_every_round_of_a_bag_in_a_loop_is_paired_with_the_transforms_of_that_round(
    tf: tuple[TfPoses, Any], source: str, seconds: int, under_way: int
) -> None:
    """Two cameras share TF, of the second a slow segmenter's masks come late; so do some transforms, or no message."""
    transforms, listener = tf
    in_map = source == "tf"
    pairings = [Pairing(transforms if in_map else MessagePoses(frames=PoseFrames("map", transforms))) for _ in "12"]
    frame, late_masks, late_transforms, number = "camera" if in_map else "odom", [], [], 100_000
    fused: list[dict[str, float]] = [{}, {}]
    for _ in range(3):
        for stamp in range(1 * S, (1 + seconds) * S, 50 * MS):
            late_transforms.append(transform(stamp, number := number + 1, frame))
            if len(late_transforms) > under_way:
                listener.set_transform(late_transforms.pop(0), "")
            if stamp % (200 * MS) == 0 and stamp < seconds * S:
                for pairing in pairings:
                    pairing.add_camera_info(stamp, "info", "camera")
                    if not in_map:
                        pairing.add_pose(stamp, GivenPose(pose(0.0), "odom"))
                pairings[0].add_mask(stamp, number, "camera")
                late_masks.append((stamp, number))
            if len(late_masks) > LATE:
                pairings[1].add_mask(*late_masks.pop(0), "camera")
            for found, pairing in zip(fused, pairings, strict=True):
                found |= {p.name: p.pose[0, 3] - p.mask for p in pairing.take()}
    for found, pairing, lost in zip(fused, pairings, (0, 2 * LATE), strict=True):  # Late ones of a round that is over.
        assert set(found.values()) == {0.0}
        assert pairing.time_jumps == 2 and pairing.dropped.total() == lost
        assert len(found) + pairing.waiting + lost == 3 * 5 * (seconds - 1) - (len(late_masks) if lost else 0)
        assert pairing.waiting <= under_way // 4 + 1


def test_a_transform_that_comes_once_a_round_is_known_in_each(tf: tuple[TfPoses, Any]) -> None:
    transforms, listener = tf
    for stamp, x, child in ((3, 1.0, "odom"), (3, 1.0, "base"), (22, 1.0, "base"), (3, 2.0, "odom"), (4, 2.0, "base")):
        listener.set_transform(transform(stamp * S, x, child), "")
    for began in (3 * S, 4 * S):  # As two cameras find it.
        transforms.set_back(22 * S, began)
    found = transforms.look_up("odom", 3 * S)
    assert found is not None and found[0, 3] == 2.0


def test_a_frame_that_begins_late_in_a_round_is_not_taken_for_one_of_before(tf: tuple[TfPoses, Any]) -> None:
    transforms, listener = tf
    for stamp in (1 * S, 20 * S):
        listener.set_transform(transform(stamp, 1.0, "base"), "")
    transforms.set_back(20 * S, 1 * S)
    assert transforms.look_up("base", 20 * S) is None
    for stamp, child in ((1 * S, "base"), (15 * S, "base"), (15 * S, "arm")):
        listener.set_transform(transform(stamp, 2.0, child), "")
    assert transforms.look_up("arm", 15 * S) is not None


def test_why_a_transform_is_missing_is_kept_while_others_are_found(tf: tuple[TfPoses, Any]) -> None:
    """Of a chain of which one link has stopped, and of two cameras of which TF knows one."""
    transforms, listener = tf
    listener.set_transform(transform(1 * S, 1.0, "camera"), "")
    assert PoseFrames("map", transforms).camera_in_map(GivenPose(pose(0.0), "odom", "base"), 1 * S, "camera") is None
    assert transforms.problem == "lookup would require extrapolation"
    listener.set_transform(transform(1 * S, 1.0, "odom"), "")
    assert transforms.look_up("odom", 1 * S) is not None and transforms.problem == ""
    for number in range(100):
        assert transforms.at(0, f"camera{number}") is None
        assert transforms.at(1 * S, "camera") is not None
        assert transforms.problem.startswith(f"a mask has the stamp 0 and the frame_id 'camera{number}'")
    assert len(transforms._problems) < 20
