"""Masks that the segmentation node cannot use: rejected, counted by reason and explained; they change nothing."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from gsseg_msgs.msg import SegmentationReport
from gsseg_msgs.srv import Segment
from ros_fixtures import parameters_fixture, root_fixture, shared_fixture  # noqa: F401
from ros_helpers import Ros, ros_fixture  # noqa: F401
from ros_robot import SECOND, STEP, Robot, messages
from small_scenes import balls_on_a_table, clean_views, look_at, true_labels
from std_msgs.msg import Header

from gsseg_core.data.view import View
from gsseg_core.segmentation import Segmentation
from gsseg_ros.conversions import mask_image, pose_from_matrix, stamp_message, stamp_ns

Messages = dict[str, Any]


@dataclass(frozen=True)
class Bad:
    """A view that cannot be used."""

    what: str
    reason: str
    log: str
    spoil: Callable[[Messages], Any]

    def __str__(self) -> str:
        return self.what


def set_labels(sent: Messages, labels: np.ndarray) -> None:
    sent["mask"] = mask_image(labels, sent["mask"].header, 8)


def set_fields(name: str, **fields: Any) -> Callable[[Messages], None]:
    def spoil(sent: Messages) -> None:
        for key, value in fields.items():
            setattr(sent[name], key, value)

    return spoil


def turn_away(sent: Messages) -> None:
    """Stand beside the scene, with the back to it."""
    facing = look_at("facing", np.array([50.0, 0, 0]))
    sent["pose"].pose = pose_from_matrix(np.linalg.inv(facing.world_to_camera))
    sent["pose"].pose.position.x = -50.0


def set_stamp(sent: Messages, change: int) -> None:
    header = sent["mask"].header
    header.stamp = stamp_message(stamp_ns(header.stamp) + change)


def set_orientation(sent: Messages, x: float, w: float) -> None:
    orientation = sent["pose"].pose.orientation
    orientation.x, orientation.y, orientation.z, orientation.w = x, 0.0, 0.0, w


BAD = [
    Bad("a mask of another size", "size_mismatch", "/mask: image is 64 x 47 pixels; expected 64 x 48, as",
        lambda sent: set_labels(sent, np.zeros((47, 64), int))),
    Bad("a picture", "mask_format", "/mask: encoding is 'rgb8'; expected labels as one of mono8",
        set_fields("mask", encoding="rgb8")),
    Bad("a mask cut short", "mask_format", "", set_fields("mask", step=65)),
    Bad("an unknown label", "unknown_label", "mask holds the label 4; expected at most 3",
        lambda sent: set_labels(sent, np.full((48, 64), 4))),
    Bad("an impossible lens", "bad_camera_info", "/camera_info: lens OPENCV (k1 = -99, k2 = 0, p1 = 0, p2 = 0, k3 = "
        "0): its distortion cannot be undone", set_fields("camera_info", d=[-99.0, 0.0, 0.0, 0.0, 0.0])),
    Bad("no focal length", "bad_camera_info", "", set_fields("camera_info", k=np.zeros(9))),
    Bad("all unknown", "all_pixels_unknown", "all pixels unknown",
        lambda sent: set_labels(sent, np.full((48, 64), -1))),
    Bad("a view of nothing", "sees_no_Gaussian", "sees no Gaussian", turn_away),
    Bad("no pose at the stamp", "no_pose", "masks were dropped because no pose with their stamp came",
        lambda sent: sent.pop("pose")),
    Bad("a repeated stamp", "repeated_stamp", "dropped because a mask with their stamp and frame_id came before",
        lambda sent: set_stamp(sent, -STEP)),
]  # fmt: skip
BAD_POSES = [
    Bad("nan", "bad_pose", "pose: position is (nan,", lambda sent: setattr(sent["pose"].pose.position, "x", np.nan)),
    Bad("zeros", "bad_pose", "pose: orientation is all zeros: was it filled in?",
        lambda sent: set_orientation(sent, 0.0, 0.0)),
    Bad("frame", "bad_pose", "pose: frame_id is 'odom'; expected 'map', the parameter map_frame",
        set_fields("pose", header=Header(frame_id="odom"))),
]  # fmt: skip


@dataclass(frozen=True)
class Rejected:
    """A node that has fused four views, and then rejected two hundred others."""

    robot: Robot
    before: Segmentation
    after: Segmentation
    status: dict[str, str]
    report: SegmentationReport
    counts: dict[str, int]


@pytest.fixture(scope="module")
def rejected(shared: Ros, parameters: dict[str, Any]) -> Rejected:
    robot = Robot(shared, "/rejecting").started({**parameters, "queue_size": 1000})
    views = clean_views(5)
    robot.stamp = 1001 * SECOND - STEP
    robot.fuse(views[:4])
    before = robot.exported(robot.out("before"), skip_refinement=True)
    counts: dict[str, int] = {}
    for _ in range(200 // len(BAD)):
        for bad in BAD:
            sent = messages(views[4], robot.next_stamp())
            bad.spoil(sent)
            robot.publish(sent)
            counts[bad.reason] = counts.get(bad.reason, 0) + 1

    def total(status: dict[str, str]) -> int:
        return sum(int(value) for key, value in status.items() if key.startswith("rejected "))

    status = robot.wait_for_status(lambda status: total(status) >= 200, "200 rejected views")
    after = robot.exported(robot.out("after"), skip_refinement=True)
    return Rejected(robot, before, after, status, robot.done("segment").report, counts)


def test_two_hundred_rejected_views_leave_the_codes_untouched(rejected: Rejected) -> None:
    assert sum(rejected.counts.values()) == 200
    np.testing.assert_array_equal(rejected.after.labels, rejected.before.labels)
    np.testing.assert_array_equal(rejected.after.probabilities, rejected.before.probabilities)
    assert (rejected.status["views fused"], rejected.status["views kept"]) == ("4", "4")
    assert rejected.report.num_views == 4


@pytest.mark.parametrize("bad", BAD, ids=str)
def test_a_view_that_cannot_be_used_is_counted_by_its_reason_and_explained(rejected: Rejected, bad: Bad) -> None:
    assert rejected.status[f"rejected {bad.reason}"] == str(rejected.counts[bad.reason])
    reported = dict(zip(rejected.report.rejection_reasons, rejected.report.rejection_counts, strict=True))
    assert reported[bad.reason] == rejected.counts[bad.reason]
    assert rejected.robot.process is not None
    rejected.robot.process.wait_for(bad.log)


def test_while_masks_are_refused_diagnostics_say_of_how_many_and_why(rejected: Rejected) -> None:
    verdicts = [(s.level, s.message) for array in rejected.robot.received_status for s in array.status]
    assert verdicts[-1][1] != "fusing"
    level, message = next(said for said in verdicts if "masks of the last 10 s were refused" in said[1])
    assert level in (DiagnosticStatus.WARN, DiagnosticStatus.ERROR)
    assert re.match(r"\d+ of \d+ masks of the last 10 s were refused, \d+ of them as \w+: .*expected ", message)


def test_the_report_counts_all_rejected_views_until_the_reset(rejected: Rejected) -> None:
    assert rejected.report.num_views_rejected == 200
    assert dict(zip(rejected.report.rejection_reasons, rejected.report.rejection_counts, strict=True)) == (
        rejected.counts
    )
    rejected.robot.done("reset")
    rejected.robot.fuse(clean_views(1))
    report = rejected.robot.done("segment").report
    assert (report.num_views_rejected, list(report.rejection_reasons)) == (0, [])


def test_each_reason_is_complained_of_by_itself(rejected: Rejected) -> None:
    assert rejected.robot.process is not None
    said = re.findall(r"a view was rejected \((\w+)\)", rejected.robot.process.output)
    assert set(said) == set(rejected.counts) - {"no_pose", "repeated_stamp"}


@pytest.fixture(scope="module")
def misplaced(shared: Ros, parameters: dict[str, Any]) -> dict[str, Robot]:
    """Nodes of which each hears another kind of bad pose."""
    robots = {bad.what: Robot(shared, f"/{bad.what}") for bad in BAD_POSES}
    for robot in robots.values():
        robot.start(parameters)
    for bad, robot in zip(BAD_POSES, robots.values(), strict=True):
        robot.wait_active()
        for view in clean_views(2):
            sent = messages(view, robot.next_stamp())
            stamp = sent["mask"].header.stamp
            bad.spoil(sent)
            sent["pose"].header.stamp = stamp
            robot.publish(sent)
    return robots


@pytest.mark.parametrize("bad", BAD_POSES, ids=str)
def test_a_bad_pose_is_the_reason_of_its_mask_and_the_log_says_what_is_wrong_with_it(
    misplaced: dict[str, Robot], bad: Bad
) -> None:
    robot = misplaced[bad.what]
    status = robot.wait_for_status(lambda status: status.get("rejected bad_pose") == "2", "two masks of bad poses")
    assert "rejected no_pose" not in status
    assert (status["views fused"], status[f"/{bad.what}/pose received"]) == ("0", "2")
    assert robot.process is not None
    robot.process.wait_for(bad.log)
    assert robot.ask("segment").error_code == Segment.Response.NO_CODES


def test_two_hundred_bad_poses_are_a_few_lines_that_count_the_others(misplaced: dict[str, Robot]) -> None:
    robot = misplaced["nan"]
    sent = messages(clean_views(1)[0], robot.next_stamp())["pose"]
    for i in range(200):
        sent.pose.position.x, sent.pose.position.y = np.nan, float(i)
        robot.publish({"pose": sent})
    robot.wait_for_status(lambda status: int(status["poses refused"]) >= 202, "all poses")
    assert robot.process is not None
    robot.process.wait_for("more of this kind since the last such line")
    assert robot.process.output.count("pose: position is (nan,") < 50


def test_masks_that_come_before_there_is_a_scene_are_counted(ros: Ros, parameters: dict[str, Any]) -> None:
    robot = Robot(ros).started({**parameters, "scene_path": ""})
    assert robot.process is not None
    robot.process.wait_for("no scene yet: set the parameter scene_path, or call ~/load_scene")
    robot.drive(clean_views(3))
    status = robot.wait_for_status(lambda status: status.get("rejected no_scene") == "3", "three masks")
    assert (status["scene"], status["message"]) == ("none", "no scene is loaded")
    robot.done("load_scene", path="data/scene.ply")
    robot.fuse(clean_views(2))


def test_of_too_many_masks_at_once_the_oldest_are_dropped_and_counted(
    ros: Ros, parameters: dict[str, Any], tmp_path: Path
) -> None:
    robot = Robot(ros).started({**parameters, "queue_size": 1})
    scene, truth = balls_on_a_table()
    camera = look_at("large", np.array([3.0, 0, 3.0]), 640, 480, 550.0)
    view = View.from_arrays(camera, true_labels(scene, truth, camera))
    sent = 0

    def burst() -> None:
        nonlocal sent
        robot.publish({"camera_info": messages(view, robot.next_stamp())["camera_info"]})
        for _ in range(10):
            made = messages(view, robot.next_stamp())
            robot.publish({"mask": made["mask"], "pose": made["pose"]})
        # Until a later one comes they wait for a camera_info of their own; then all are ready in the same moment.
        robot.publish({"camera_info": messages(view, robot.next_stamp())["camera_info"]})
        sent += 10

    def all_counted(status: dict[str, str]) -> bool:
        # On a busy machine a pose may come too late for its mask.
        rejected = sum(int(count) for key, count in status.items() if key.startswith("rejected "))
        return int(status.get("views accepted", 0)) + rejected == sent

    # Whether a burst comes at once is up to the machine, which may be busy.
    for _ in range(20):
        burst()
        status = robot.wait_for_status(all_counted, "all masks to be fused or dropped")
        if int(status["queue drops"]):
            break
    assert int(status["queue drops"]) >= 1
    assert status["rejected queue_full"] == status["queue drops"]
    report = robot.done("segment").report
    counts = dict(zip(report.rejection_reasons, report.rejection_counts, strict=True))
    assert counts["queue_full"] == int(status["queue drops"])
