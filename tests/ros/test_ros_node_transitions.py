"""Transitions of the segmentation node that fail or are interrupted: said in the log, and nothing half built stays."""

from __future__ import annotations

import signal
import threading
from pathlib import Path
from typing import Any

import pytest
from lifecycle_msgs.msg import Transition
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.node import Node
from rclpy.parameter import Parameter
from ros_fixtures import node_fixture, parameters_fixture, root_fixture, spun  # noqa: F401
from ros_helpers import Ros, ros_fixture, wait_until  # noqa: F401
from ros_robot import Robot
from small_scenes import clean_views

from gsseg_ros.node import diagnostics, segment_node
from gsseg_ros.node.scene_frame import SceneFrame
from gsseg_ros.node.segment_node import SegmentNode

SUCCESS, FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE
CONFIGURE = Transition(id=Transition.TRANSITION_CONFIGURE)


@pytest.fixture
def errors(node: SegmentNode, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What the node logs as an error."""
    lines: list[str] = []
    monkeypatch.setattr(node.get_logger(), "error", lines.append)
    logger = node.get_logger()
    monkeypatch.setattr(node, "get_logger", lambda: logger)
    return lines


def entities(node: SegmentNode) -> tuple[list[int], set[threading.Thread]]:
    """Publishers, subscriptions and timers of a node, and threads of the process."""
    counts = [len(list(found)) for found in (node.publishers, node.subscriptions, node.timers)]
    return counts, {thread for thread in threading.enumerate() if thread.name != "neighbours"}


def assert_nothing_more(node: SegmentNode, before: tuple[list[int], set[threading.Thread]]) -> None:
    """A node has the entities of before, and no thread more; one of an earlier test may have ended meanwhile."""
    assert entities(node)[0] == before[0]
    wait_until(lambda: entities(node)[1] <= before[1], "the threads to end")


def fails_at(node: SegmentNode, monkeypatch: pytest.MonkeyPatch, method: str, topic: str) -> None:
    """Have the making of a publisher or subscription fail, of one topic."""
    make = getattr(node, method)

    def broken(kind: Any, name: str, *arguments: Any, **settings: Any) -> Any:
        if name in (topic, f"/{topic}"):
            raise MemoryError("none left")
        return make(kind, name, *arguments, **settings)

    monkeypatch.setattr(node, method, broken)


@pytest.mark.parametrize("topic", ["~/cloud", "~/objects", "~/classes/box"])
def test_a_configure_that_breaks_off_leaves_nothing_behind_and_works_afterwards(
    node: SegmentNode, errors: list[str], monkeypatch: pytest.MonkeyPatch, topic: str
) -> None:
    before = entities(node)
    with monkeypatch.context() as patch:
        fails_at(node, patch, "create_publisher", topic)
        assert node.trigger_configure() == FAILURE
    (line,) = errors
    assert line.startswith("cannot be configured: unexpected MemoryError: none left\nTraceback")
    assert_nothing_more(node, before)
    assert node.workspace.loaded is None
    assert node.trigger_configure() == SUCCESS


@pytest.mark.parametrize("topic", ["image", "mask", "camera_info", "pose", "~/obstacles"])
def test_an_activate_that_breaks_off_leaves_nothing_behind_and_works_afterwards(
    node: SegmentNode, errors: list[str], monkeypatch: pytest.MonkeyPatch, topic: str
) -> None:
    assert node.trigger_configure() == SUCCESS
    before = entities(node)
    with monkeypatch.context() as patch:
        fails_at(node, patch, "create_publisher" if topic.startswith("~") else "create_subscription", topic)
        assert node.trigger_activate() == FAILURE
    assert "cannot be activated: unexpected MemoryError: none left\nTraceback" in errors[0] and len(errors) == 1
    assert_nothing_more(node, before)
    assert node.inputs is None and not node.workspace.active
    assert node.trigger_activate() == SUCCESS
    assert node.trigger_deactivate() == SUCCESS
    assert_nothing_more(node, before)


def test_parameters_take_effect_at_once_on_humble_too(
    ros: Ros, parameters: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(Node, "add_post_set_parameters_callback")
    node = SegmentNode(context=ros.context)
    try:
        good, bad = node.set_parameters([Parameter("k", value=7), Parameter("pose_source", value="gps")])
        assert good.successful and not bad.successful
        assert (node.workspace.settings.k, node.workspace.settings.pose_source) == (7, "topic")
    finally:
        node.close()


def test_of_two_that_set_a_parameter_at_once_the_value_that_it_has_counts(node: SegmentNode) -> None:
    node.set_parameters([Parameter("k", value=7)])
    node._take_parameters([Parameter("k", value=5)])  # Its thread set it before, and comes to tell only now.
    assert (node.get_parameter("k").value, node.workspace.settings.k) == (7, 7)


def test_what_is_set_while_it_configures_is_refused_or_takes_effect(
    node: SegmentNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    moved, frames = [1.0, 2.0, 3.0], []

    def set_meanwhile(*_: object) -> None:
        late = [Parameter("max_views", value=7), Parameter("k", value=7)]
        late.append(Parameter("scene_to_map.translation", value=moved))
        assert [result.successful for result in node.set_parameters(late)] == [False, True, True]

    monkeypatch.setattr(segment_node, "warm_up", set_meanwhile)
    monkeypatch.setattr(SceneFrame, "publish", lambda self, similarity, stamp: frames.append(similarity.translation))
    assert node.trigger_configure() == SUCCESS
    assert (node.get_parameter("max_views").value, node.workspace.session.max_views) == (200, 200)
    assert node.workspace.settings.k == 7
    assert [frame.tolist() for frame in frames] == [moved]


def test_a_deactivate_that_fails_is_said_and_brings_it_back_to_unconfigured(
    node: SegmentNode, errors: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    before = entities(node)
    assert node.trigger_configure() == node.trigger_activate() == SUCCESS
    cancel, results = node.workspace.slot.cancel, iter([MemoryError("none left")])

    def broken_once(seconds: float) -> bool:
        for error in results:
            raise error
        return cancel(seconds)

    monkeypatch.setattr(node.workspace.slot, "cancel", broken_once)
    assert node.trigger_deactivate() == TransitionCallbackReturn.ERROR
    (line,) = errors
    assert line.startswith("cannot be deactivated: unexpected MemoryError: none left\nTraceback")
    assert_nothing_more(node, before)
    assert node.trigger_configure() == node.trigger_activate() == SUCCESS


@pytest.mark.parametrize(
    ("override", "step", "state"),
    [
        ("/gsseg/objects.publisher.reliability", "configured", "unconfigured"),
        ("/mask.subscription.reliability", "activated", "inactive"),
        ("/image.subscription.history", "activated", "inactive"),
    ],
)
def test_a_misspelt_quality_of_service_is_one_clear_error(
    ros: Ros, parameters: dict[str, Any], override: str, step: str, state: str
) -> None:
    robot = Robot(ros)
    topic, _, policy = override.split(".")
    process = robot.start({**parameters, f"qos_overrides.{override}": "relible"}, lossless=False)
    process.wait_for(f"cannot be {step}")
    robot.wait_for_state(state)
    (line,) = (line for line in process.output.splitlines() if "[ERROR]" in line)
    assert f"cannot be {step}: parameters qos_overrides of the topic " in line and topic.split("/")[-1] in line
    assert f"`{policy}`: `relible`; expected reliability reliable or best_effort" in line
    assert "Traceback" not in process.output
    assert not ros.node.count_publishers("/gsseg/cloud") or state == "inactive"
    assert not robot.publishers["mask"].get_subscription_count()


def test_a_quality_of_service_of_no_topic_is_named_with_the_one_that_was_meant(
    ros: Ros, parameters: dict[str, Any]
) -> None:
    given = {"qos_overrides./maks.subscription.reliability": "reliable", "qos_overrides./mask.subscription.depth": 7}
    robot = Robot(ros)
    process = robot.start(parameters | given, lossless=False)
    robot.wait_active()
    assert (
        "parameters that this node does not have are ignored: qos_overrides./maks.subscription.reliability (did "
        "you mean qos_overrides./mask.subscription.reliability?)\n" in process.output
    )


def test_the_state_is_told_and_changed_while_the_session_is_locked(
    ros: Ros, node: SegmentNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot, asked = Robot(ros), threading.Event()
    make = diagnostics.diagnostic_array

    def make_and_tell(*arguments: Any) -> Any:
        asked.set()
        return make(*arguments)

    monkeypatch.setattr(diagnostics, "diagnostic_array", make_and_tell)
    with spun(node):
        robot.brought_to("inactive")
        assert robot.change("activate")
        with node.workspace.session._lock:
            asked.clear()
            ros.wait_until(asked.is_set, "diagnostics, which want the lock")
            assert robot.state == "active"
            assert robot.change("deactivate") and robot.state == "inactive"
            assert robot.change("activate") and robot.state == "active"


@pytest.mark.parametrize(("how", "number"), [("autostart", signal.SIGINT), ("change_state", signal.SIGTERM)])
def test_a_signal_is_heard_while_kernels_compile_and_so_are_questions(
    ros: Ros, parameters: dict[str, Any], tmp_path: Path, how: str, number: signal.Signals
) -> None:
    ros.environment["NUMBA_CACHE_DIR"] = str(tmp_path / "cache")
    robot = Robot(ros)
    process = robot.start({**parameters, "autostart": how == "autostart"})
    if how == "change_state":
        process.wait_for("autostart is false")
        robot.send("change_state", transition=CONFIGURE)
    process.wait_for("compiling kernels")
    assert robot.state == "configuring"
    process.send(number)
    assert process.wait() == 0, process.output
    assert "loaded " not in process.output, "it ended only after all were compiled"
    assert "Traceback" not in process.output and "[ERROR]" not in process.output, process.output


def test_images_are_not_subscribed_to_again_by_a_timer_that_runs_while_listening_ends(
    node: SegmentNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert node.trigger_configure() == node.trigger_activate() == SUCCESS
    assert node.inputs is not None and node._outputs is not None
    (images,) = node.inputs._images
    monkeypatch.setattr(type(node._outputs), "wants_overlay", lambda *_: True)
    images.tick()
    assert any(subscription.topic_name == "/image" for subscription in node.subscriptions)
    assert node.trigger_deactivate() == SUCCESS
    images.tick()
    assert not any(subscription.topic_name == "/image" for subscription in node.subscriptions)


def test_a_home_folder_is_understood_in_the_paths_of_parameters(
    ros: Ros, parameters: dict[str, Any], root: Path
) -> None:
    ros.environment["HOME"] = str(root)
    robot = Robot(ros).started({**parameters, "scene_path": "~/data/./scene.ply", "data_root": "~"})
    robot.fuse(clean_views(1))
    assert robot.done("save_state", path="home.npz").path == str(root / "home.npz")
    assert robot.done("load_scene").path == str(root / "data" / "scene.ply")
