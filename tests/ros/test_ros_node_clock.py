"""The segmentation node with use_sim_time, and a clock that does not come, comes, and is set back."""

from __future__ import annotations

from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from ros_fixtures import parameters_fixture, root_fixture, shared_fixture  # noqa: F401
from ros_helpers import Ros
from ros_robot import RELIABLE, SECOND, STEP, Robot, messages
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2
from small_scenes import clean_views

from gsseg_ros.conversions import stamp_message, stamp_ns


@pytest.fixture(scope="module")
def robot(shared: Ros, parameters: dict[str, Any]) -> Robot:
    """A node whose clock has not come yet; the tests of this file take it from there, each whatever came before."""
    return Robot(shared).started({**parameters, "use_sim_time": True})


@pytest.fixture(scope="module")
def clock(robot: Robot) -> Any:
    """Sets /clock to a number of seconds, and waits until the node has heard of it."""
    publisher = robot.ros.node.create_publisher(Clock, "/clock", RELIABLE)

    def set_to(seconds: float) -> None:
        def heard() -> bool:
            publisher.publish(Clock(clock=stamp_message(round(seconds * SECOND))))
            return stamps(robot)[-1:] == [seconds]

        robot.ros.wait_until(heard, f"a status of {seconds:g} s")

    return set_to


def stamps(robot: Robot) -> list[float]:
    return [stamp_ns(array.header.stamp) / SECOND for array in robot.received_status]


def fused(robot: Robot, count: int, what: str) -> dict[str, str]:
    return robot.wait_for_status(lambda status: status.get("views fused") == str(count), what)


def test_without_a_clock_there_are_diagnostics_and_they_and_the_log_say_so(robot: Robot) -> None:
    status = robot.wait_for_status(lambda status: "use_sim_time" in status["message"], "the complaint")
    assert status["message"].startswith("use_sim_time is true, but no /clock has come for ")
    assert "and nobody publishes it; expected a simulator or 'ros2 bag play --clock'" in status["message"]
    assert robot.received_status[-1].status[0].level == DiagnosticStatus.WARN
    assert min(stamps(robot)) > 1e9, "a stamp of zero says that there is none"
    assert robot.process is not None
    robot.process.wait_for("use_sim_time is true, but no /clock has come for ")


def test_without_a_clock_masks_are_fused_all_the_same(robot: Robot) -> None:
    robot.done("reset")
    robot.fuse(clean_views(2))


def test_while_the_clock_stands_still_every_run_has_a_stamp_of_its_own(robot: Robot) -> None:
    robot.done("reset")
    robot.fuse(clean_views(1))
    headers = [robot.done("segment").report.header for _ in range(3)]
    assert len({stamp_ns(header.stamp) for header in headers}) == 3
    (cloud,) = robot.latched((PointCloud2, "cloud"))
    assert cloud.header == headers[-1]


def test_after_the_clock_is_set_back_no_pose_of_before_is_taken_for_a_new_one(robot: Robot, clock: Any) -> None:
    clock(200.0)
    # Nobody moves it on: soon it stands still, which is said, too.
    robot.ros.wait_until(
        lambda: any(stamp_ns(a.header.stamp) == 200 * SECOND and "clock" not in a.status[0].message
                    for a in robot.received_status), "no complaint any more"
    )  # fmt: skip
    robot.done("reset")
    views = clean_views(3)
    fused(robot, 0, "the reset")
    robot.publish(messages(views[0], 190 * SECOND))
    robot.publish(messages(views[1], 200 * SECOND))
    before = fused(robot, 2, "two views")

    clock(100.0)
    status = robot.wait_for_status(lambda status: status["time jumps"] != before["time jumps"], "the jump")
    assert int(status["time jumps"]) == int(before["time jumps"]) + 1
    sent = messages(views[2], 190 * SECOND)
    del sent["pose"]
    robot.publish(sent)
    lost = int(before.get("rejected no_pose", 0)) + 1
    robot.wait_for_status(lambda status: status.get("rejected no_pose") == str(lost), "a mask without a pose")
    robot.publish(messages(views[2], 190 * SECOND + STEP))
    fused(robot, 3, "the third view")
    assert robot.process is not None
    robot.process.wait_for("from 200.000 s to 100.000 s: poses, camera_infos and masks of before")
