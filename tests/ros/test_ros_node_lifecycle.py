"""The transitions of the segmentation node, those that work and those that do not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from gsseg_msgs.action import Learn
from ros_fixtures import idle_fixture, idle_robot_fixture, parameters_fixture, root_fixture, shared_fixture  # noqa: F401
from ros_helpers import Ros, ros_fixture  # noqa: F401
from ros_robot import SERVICES, Robot
from small_scenes import clean_views

REQUESTS = ("segment", "pick", "render_view", "load_scene", "save_state", "load_state", "export", "reset")


def publishers(robot: Robot, topic: str) -> int:
    return int(robot.ros.node.count_publishers(f"{robot.name}/{topic}"))


def assert_not_active(robot: Robot) -> None:
    """Every request is answered, with NOT_ACTIVE, and goals are rejected."""
    for service in REQUESTS:
        response = robot.ask(service)
        assert response.error_code == type(response).NOT_ACTIVE, service
        assert response.error_msg == "the node is not active; expected it to be configured and activated first"
    assert robot.offered() is None


# Transitions


def test_with_autostart_false_it_waits_and_answers_that_it_is_not_active(robot: Robot) -> None:
    assert robot.state == "unconfigured"
    assert_not_active(robot)
    assert robot.publishers["mask"].get_subscription_count() == 0
    robot.wait_for_status(lambda status: status.get("message") == "not active", "the diagnostics")


def test_with_autostart_it_is_active_by_itself(ros: Ros, parameters: dict[str, Any]) -> None:
    robot = Robot(ros).started(parameters)
    assert robot.state == "active"
    assert robot.process is not None
    robot.process.wait_for("loaded")


def test_configure_loads_the_scene_and_offers_the_outputs(robot: Robot) -> None:
    assert robot.change("configure")
    assert robot.state == "inactive"
    assert_not_active(robot)
    topics = ("cloud", "report", "overlay", "classes/background", "classes/red_ball", "classes/cup_mug", "classes/box")
    robot.ros.wait_until(lambda: all(publishers(robot, topic) == 1 for topic in topics), "the outputs")
    assert robot.publishers["mask"].get_subscription_count() == 0, "it listens only when it is active"
    status = robot.wait_for_status(lambda status: status.get("scene", "").endswith("scene.ply"), "the scene")
    assert status["gaussians"] == "626"


def test_activate_begins_to_listen(robot: Robot) -> None:
    robot.brought_to("inactive")
    assert robot.change("activate")
    assert robot.state == "active"
    robot.wait_active()
    robot.fuse(clean_views(2))


def test_deactivate_stops_listening_and_keeps_what_is_known(robot: Robot) -> None:
    robot.brought_to("active")
    robot.fuse(clean_views(3))
    assert robot.change("deactivate")
    assert robot.state == "inactive"
    assert_not_active(robot)
    robot.ros.wait_until(lambda: not robot.publishers["mask"].get_subscription_count(), "the subscriptions to go")
    assert robot.change("activate")
    assert robot.done("segment").report.num_views == 3
    robot.wait_active()
    robot.fuse(clean_views(1))


def test_deactivate_stops_a_running_learn(robot: Robot) -> None:
    robot.brought_to("active")
    robot.fuse(clean_views(2))
    before = robot.exported(Path(robot.get("data_root")) / "out" / "before").probabilities
    goal = robot.begin(dataset_path="long")
    assert robot.change("deactivate")
    status, result = robot.outcome(goal)
    assert (status, result.error_code) == (GoalStatus.STATUS_ABORTED, Learn.Result.CANCELED)
    assert robot.change("activate")
    after = robot.exported(Path(robot.get("data_root")) / "out" / "after").probabilities
    np.testing.assert_array_equal(after, before)


def test_cleanup_forgets_the_scene_and_what_was_learnt_and_takes_the_outputs_away(robot: Robot) -> None:
    robot.brought_to("active")
    robot.fuse(clean_views(2))
    assert robot.change("deactivate") and robot.change("cleanup")
    assert robot.state == "unconfigured"
    assert_not_active(robot)
    topics = ("cloud", "report", "overlay", "classes/background", "classes/box")
    robot.ros.wait_until(lambda: not any(publishers(robot, topic) for topic in topics), "the outputs to go")
    robot.wait_for_status(lambda status: status.get("scene") == "none", "the scene to go")
    robot.brought_to("active")
    assert robot.ask("segment").error_code == SERVICES["segment"].Response.NO_CODES


@pytest.mark.parametrize("state", ["unconfigured", "inactive", "active"])
def test_shutdown_finalizes_it_and_it_still_answers(ros: Ros, parameters: dict[str, Any], state: str) -> None:
    robot = Robot(ros)
    process = robot.start({**parameters, "autostart": False})
    robot.brought_to(state)
    goal = robot.begin(dataset_path="long") if state == "active" else None
    assert robot.shutdown()
    assert robot.state == "finalized"
    if goal is not None:
        assert robot.outcome(goal)[1].error_code == Learn.Result.CANCELED
    assert_not_active(robot)
    ros.wait_until(lambda: not robot.publishers["mask"].get_subscription_count(), "the subscriptions to go")
    assert process.stop() == 0, process.output
    assert "Traceback" not in process.output, process.output


@pytest.mark.parametrize(
    ("state", "transition"),
    [("unconfigured", "activate"), ("inactive", "configure"), ("inactive", "deactivate"), ("active", "cleanup")],
)
def test_a_transition_that_does_not_start_here_is_refused(robot: Robot, state: str, transition: str) -> None:
    robot.brought_to(state)
    assert not robot.change(transition)
    assert robot.state == state


def test_a_configure_that_fails_leaves_it_unconfigured_until_the_parameter_is_right(
    ros: Ros, parameters: dict[str, Any], root: Path
) -> None:
    robot = Robot(ros)
    process = robot.start({**parameters, "scene_path": root / "no.ply"})
    process.wait_for("cannot be configured")
    (line,) = (line for line in process.output.splitlines() if "[ERROR]" in line)
    assert f"parameter scene_path: {root}/no.ply does not exist; expected a scene" in line
    robot.wait_for_state("unconfigured")
    assert not robot.change("configure")
    (root / "broken.ply").write_text("no PLY")
    assert robot.set("scene_path", str(root / "broken.ply")) == (True, "")
    assert not robot.change("configure")
    process.wait_for("broken.ply: truncated or not a PLY file")
    assert robot.state == "unconfigured"
    assert_not_active(robot)
    assert robot.set("scene_path", str(parameters["scene_path"])) == (True, "")
    robot.brought_to("active").fuse(clean_views(1))
    assert "Traceback" not in process.output


def test_an_activate_that_fails_leaves_it_inactive_until_the_parameter_is_right(
    ros: Ros, parameters: dict[str, Any]
) -> None:
    try:
        import tf2_ros  # noqa: F401
    except ImportError:
        pass
    else:
        pytest.skip("tf2_ros is installed, so that nothing makes it fail")
    robot = Robot(ros)
    robot.start({**parameters, "pose_source": "tf"}).wait_for("cannot be activated: parameter pose_source is 'tf'")
    robot.wait_for_state("inactive")
    assert_not_active(robot)
    assert not robot.change("activate")
    assert robot.state == "inactive"
    assert robot.change("cleanup")
    assert robot.set("pose_source", "topic") == (True, "")
    robot.brought_to("active").fuse(clean_views(1))
