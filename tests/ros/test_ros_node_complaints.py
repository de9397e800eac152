"""What the segmentation node says of its inputs: quality of service, diagnostics, and what is missing."""

from __future__ import annotations

import gc
import re
from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from ros_fixtures import node_fixture, parameters_fixture, root_fixture  # noqa: F401
from ros_helpers import Ros, private_ros, ros_fixture  # noqa: F401
from ros_robot import SECOND, Robot
from sensor_msgs.msg import Image
from small_scenes import NUM_CLASSES, clean_views

from gsseg_ros.node.segment_node import SegmentNode

MASK_RELIABILITY = "qos_overrides./mask.subscription.reliability"


@pytest.fixture(scope="module")
def silent(tmp_path_factory: pytest.TempPathFactory, parameters: dict[str, Any]) -> Iterator[Robot]:
    """A node that hears nothing; it may complain while other tests run."""
    with private_ros(tmp_path_factory.mktemp("silent")) as ros:
        robot = Robot(ros, "/silent")
        ros.node.destroy_publisher(robot.publishers.pop("mask"))
        ros.node.destroy_publisher(robot.publishers.pop("pose"))
        robot.start(parameters, lossless=False)
        yield robot


@pytest.mark.parametrize("reliability", [None, "best_effort"])
def test_the_quality_of_service_of_an_input_can_be_overridden(
    ros: Ros, parameters: dict[str, Any], reliability: str | None
) -> None:
    robot = Robot(ros)
    override = {} if reliability is None else {MASK_RELIABILITY: reliability}
    robot.started({**parameters, **override}, lossless=False)
    for topic in ("/mask", "/pose"):  # That the node is active says nothing of what has been discovered here.
        ros.wait_until(lambda topic=topic: ros.node.get_subscriptions_info_by_topic(topic), topic)
    (found,) = ros.node.get_subscriptions_info_by_topic("/mask")
    wanted = ReliabilityPolicy.RELIABLE if reliability is None else ReliabilityPolicy.BEST_EFFORT
    assert found.qos_profile.reliability == wanted
    assert found.qos_profile.durability == DurabilityPolicy.VOLATILE
    (other,) = ros.node.get_subscriptions_info_by_topic("/pose")
    assert other.qos_profile.reliability == ReliabilityPolicy.RELIABLE

    def fused() -> bool:
        robot.drive(clean_views(1))  # One that is sent before the two have found each other may be lost.
        return robot.ask("segment").error_code == 0

    ros.wait_until(fused, "a view")


def test_masks_that_are_lost_on_the_way_are_counted_and_said(ros: Ros, parameters: dict[str, Any]) -> None:
    robot = Robot(ros).started({**parameters, MASK_RELIABILITY: "best_effort"}, lossless=False)
    # Larger than the middleware's buffers; what comes after it shows that it is missing.
    large = Image(height=4096, width=4096, encoding="mono8", step=4096, data=array("B", bytes(1 << 24)))

    def lost() -> int:
        robot.drive(clean_views(1))
        robot.publishers["mask"].publish(large)
        return int(robot.status().get("rejected lost", 0))

    ros.wait_until(lost, "a mask to be lost")
    assert robot.process is not None
    robot.process.wait_for("dropped because they were lost on the way to this node (/mask: best effort, volatile)")
    robot.wait_for_status(lambda s: int(s["/mask lost on the way"]) == int(s["rejected lost"]) > 0, "the same numbers")

    def fused() -> bool:
        robot.drive(clean_views(1))
        return bool(robot.ask("segment").error_code == 0)

    ros.wait_until(fused, "a view to be fused, of which none was lost")
    assert "lost" in robot.ask("segment").report.rejection_reasons


def test_without_tf2_ros_the_pose_source_tf_is_one_clear_error(ros: Ros, parameters: dict[str, Any]) -> None:
    try:
        import tf2_ros  # noqa: F401
    except ImportError:
        pass
    else:
        pytest.skip("tf2_ros is installed")
    robot = Robot(ros)
    process = robot.start({**parameters, "pose_source": "tf"})
    process.wait_for("cannot be activated")
    errors = [line for line in process.output.splitlines() if "[ERROR]" in line]
    assert len(errors) == 1 and "Traceback" not in process.output
    assert "parameter pose_source is 'tf', but TF cannot be used here" in errors[0]
    assert "expected the apt package ros-jazzy-tf2-ros-py to be installed, or pose_source 'topic'" in errors[0]
    robot.wait_for_state("inactive")


def test_diagnostics_are_due_once_a_second(node: SegmentNode) -> None:
    assert [timer.timer_period_ns for timer in node.timers if timer.callback == node._tell] == [SECOND]


def test_diagnostics_tell_what_there_is(ros: Ros, parameters: dict[str, Any], root: Path) -> None:
    robot = Robot(ros).started(parameters)
    robot.fuse(clean_views(3))
    robot.learn(learner="em")
    # The job that learns publishes, too; until it has ended, the last one is that.
    status = robot.wait_for_status(lambda s: s.get("last job", "").startswith("learn done in "), "the end of the job")
    assert {
        "active": "True", "scene": f"{root}/data/scene.ply", "gaussians": "626", "classes": str(NUM_CLASSES),
        "codes": "em", "views fused": "3", "views kept": "3",
    }.items() <= status.items()  # fmt: skip

    told = 0

    def fuses(status: dict[str, str]) -> bool:
        nonlocal told
        if told != len(robot.received_status):  # The robot may have been slow; once masks come again, it fuses.
            told = len(robot.received_status)
            robot.drive(clean_views(1))
        return status.get("message") == "fusing"

    robot.wait_for_status(fuses, "a status that says so")
    assert all(len(array.status) == 1 for array in robot.received_status)


def test_another_node_of_its_name_is_known_until_it_goes(ros: Ros, node: SegmentNode) -> None:
    assert node.trigger_configure() == node.trigger_activate() == TransitionCallbackReturn.SUCCESS
    assert node.inputs is not None and node.inputs.namesakes == 0
    other = LifecycleNode(node.get_name(), context=ros.context, use_global_arguments=False)
    ros.wait_until(lambda: node.inputs.namesakes == 1, "the other node")
    other.destroy_node()
    del other  # rclpy keeps the publisher of a node's transitions for as long as there is the node.
    gc.collect()
    ros.wait_until(lambda: node.inputs.namesakes == 0, "the end of the other node")


def test_the_log_says_which_input_is_missing_and_what_to_check(silent: Robot) -> None:
    process = silent.process
    assert process is not None

    def complaints() -> dict[str, list[tuple[int, str]]]:
        found: dict[str, list[tuple[int, str]]] = {}
        for line in process.output.splitlines():
            if match := re.search(r"\[WARN\] .*no data on (\S+) for (\d+) s; (.*)", line):
                found.setdefault(match[1], []).append((int(match[2]), match[3]))
        return found

    topics = ("/silent/mask", "/silent/camera_info", "/silent/pose")
    silent.ros.wait_until(lambda: all(len(complaints().get(topic, ())) >= 2 for topic in topics), "two complaints each")
    for topic, hint in zip(
        topics,
        (
            "nobody publishes it: is the segmenter running, and is its topic remapped to this one (--ros-args -r mask",
            "it has 1 publisher: do their QoS and type match (this side is reliable, volatile; ros2 topic info -v",
            "nobody publishes it: expected geometry_msgs/PoseStamped of the camera's optical frame",
        ),
        strict=True,
    ):
        assert all(silence >= 5 and found.startswith(hint) for silence, found in complaints()[topic])
    message = "no data on /silent/mask for "
    status = silent.wait_for_status(lambda status: status["message"].startswith(message), "a status that says so, too")
    assert status["/silent/mask age [s]"] == "never"
    assert silent.received_status[-1].status[0].level == DiagnosticStatus.WARN
