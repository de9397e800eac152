"""The segmentation node's life: its transitions, its parameters, and its end by a signal, at any moment."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ros_helpers import REPOSITORY, Ros, ros_fixture  # noqa: F401
from ros_robot import CLASSES, SERVICES, Goal, Robot, core_session, private_ros, renamed, write_long_dataset
from small_scenes import clean_views, write_dataset

from gsseg_core.dataset import Dataset
from gsseg_core.scene import GaussianScene
from gsseg_core.segmentation import Segmentation

pytest.importorskip("gsseg_msgs.msg", reason="gsseg_msgs is not installed")

from action_msgs.msg import GoalStatus
from gsseg_msgs.action import Learn
from rcl_interfaces.msg import ParameterType
from rclpy.parameter import Parameter

from gsseg_ros.parameters import DECLARATIONS

REQUESTS = ("segment", "render_view", "load_scene", "save_state", "load_state", "export", "reset")


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("root")
    write_dataset(root / "data")
    write_long_dataset(root / "long")
    return root


@pytest.fixture(scope="module")
def parameters(root: Path) -> dict[str, Any]:
    return {"scene_path": root / "data" / "scene.ply", "data_root": root, "class_names": CLASSES}


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory, parameters: dict[str, Any]) -> Iterator[Robot]:
    with private_ros(tmp_path_factory.mktemp("ros")) as ros:
        robot = Robot(ros)
        robot.start({**parameters, "autostart": False}).wait_for("autostart is false")
        yield robot


DOWN = {"active": "deactivate", "inactive": "cleanup"}


@pytest.fixture
def robot(running: Robot) -> Robot:
    """A node that is not configured, shared by the tests of this file."""
    while running.state != "unconfigured":
        assert running.change(DOWN[running.state])
    return running


def brought_to(robot: Robot, state: str) -> Robot:
    for transition in {"unconfigured": (), "inactive": ("configure",), "active": ("configure", "activate")}[state]:
        assert robot.change(transition)
    assert robot.state == state
    if state == "active":
        robot.wait_active()
    return robot


def publishers(robot: Robot, topic: str) -> int:
    return int(robot.ros.node.count_publishers(f"{robot.name}/{topic}"))


def assert_not_active(robot: Robot) -> None:
    """Every request is answered, with NOT_ACTIVE."""
    for service in REQUESTS:
        response = robot.ask(service)
        assert response.error_code == type(response).NOT_ACTIVE, service
        assert response.error_msg == "the node is not active; expected it to be configured and activated first"
    status, result = robot.learn()
    assert (status, result.error_code) == (GoalStatus.STATUS_ABORTED, Learn.Result.NOT_ACTIVE)


# Transitions


def test_with_autostart_false_it_waits_and_answers_that_it_is_not_active(robot: Robot) -> None:
    assert robot.state == "unconfigured"
    assert_not_active(robot)
    assert robot.publishers["mask"].get_subscription_count() == 0
    robot.wait_for_status(lambda status: status["message"] == "not active", "the diagnostics")


def test_with_autostart_it_is_active_by_itself(ros: Ros, parameters: dict[str, Any]) -> None:
    robot = Robot(ros).started(parameters)
    assert robot.state == "active"
    assert robot.process is not None and "loaded" in robot.process.output


def test_configure_loads_the_scene_and_offers_the_outputs(robot: Robot) -> None:
    assert robot.change("configure")
    assert robot.state == "inactive"
    assert_not_active(robot)
    topics = ("cloud", "report", "overlay", "classes/background", "classes/red_ball", "classes/cup_mug", "classes/box")
    robot.ros.wait_until(lambda: all(publishers(robot, topic) == 1 for topic in topics), "the outputs")
    assert robot.publishers["mask"].get_subscription_count() == 0, "it listens only when it is active"
    status = robot.wait_for_status(lambda status: status["scene"].endswith("scene.ply"), "the scene")
    assert status["gaussians"] == "626"


def test_activate_begins_to_listen(robot: Robot) -> None:
    brought_to(robot, "inactive")
    assert robot.change("activate")
    assert robot.state == "active"
    robot.wait_active()
    robot.fuse(clean_views(2))


def test_deactivate_stops_listening_and_keeps_what_is_known(robot: Robot) -> None:
    brought_to(robot, "active")
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
    brought_to(robot, "active")
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
    brought_to(robot, "active")
    robot.fuse(clean_views(2))
    assert robot.change("deactivate") and robot.change("cleanup")
    assert robot.state == "unconfigured"
    assert_not_active(robot)
    topics = ("cloud", "report", "overlay", "classes/background", "classes/box")
    robot.ros.wait_until(lambda: not any(publishers(robot, topic) for topic in topics), "the outputs to go")
    robot.wait_for_status(lambda status: status["scene"] == "none", "the scene to go")
    brought_to(robot, "active")
    assert robot.ask("segment").error_code == SERVICES["segment"].Response.NO_CODES


@pytest.mark.parametrize("state", ["unconfigured", "inactive", "active"])
def test_shutdown_finalizes_it_and_it_still_answers(ros: Ros, parameters: dict[str, Any], state: str) -> None:
    robot = Robot(ros)
    process = robot.start({**parameters, "autostart": False})
    brought_to(robot, state)
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
    brought_to(robot, state)
    assert not robot.change(transition)
    assert robot.state == state


def test_a_configure_that_fails_leaves_it_unconfigured_until_the_parameter_is_right(
    ros: Ros, parameters: dict[str, Any], root: Path
) -> None:
    robot = Robot(ros)
    process = robot.start({**parameters, "scene_path": root / "no.ply"})
    process.wait_for("cannot be configured")
    (line,) = (line for line in process.output.splitlines() if "[ERROR]" in line)
    assert f"parameter scene_path: {root}/no.ply does not exist; expected a 3DGS PLY" in line
    assert robot.state == "unconfigured"
    assert not robot.change("configure")
    (root / "broken.ply").write_text("no PLY")
    assert robot.set("scene_path", str(root / "broken.ply")) == (True, "")
    assert not robot.change("configure")
    assert "broken.ply: truncated or not a PLY file" in process.output
    assert robot.state == "unconfigured"
    assert_not_active(robot)
    assert robot.set("scene_path", str(parameters["scene_path"])) == (True, "")
    brought_to(robot, "active").fuse(clean_views(1))
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
    assert robot.state == "inactive"
    assert_not_active(robot)
    assert not robot.change("activate")
    assert robot.state == "inactive"
    assert robot.change("cleanup")
    assert robot.set("pose_source", "topic") == (True, "")
    brought_to(robot, "active").fuse(clean_views(1))


# Parameters


def test_every_parameter_is_typed_described_and_ranged(robot: Robot) -> None:
    names = [declaration.name for declaration in DECLARATIONS]
    descriptors = robot.ask("describe_parameters", names=names).descriptors
    assert [descriptor.name for descriptor in descriptors] == names
    kinds = {str: "STRING", int: "INTEGER", float: "DOUBLE", bool: "BOOL"}
    for declaration, descriptor in zip(DECLARATIONS, descriptors, strict=True):
        default = declaration.default
        kind = kinds[type(default)] if not isinstance(default, list) else f"{'DOUBLE' if default else 'STRING'}_ARRAY"
        assert descriptor.type == getattr(ParameterType, f"PARAMETER_{kind}"), descriptor.name
        assert descriptor.description == declaration.description != ""
    ranges = {
        descriptor.name: (limits.from_value, limits.to_value)
        for descriptor in descriptors
        for limits in (*descriptor.integer_range, *descriptor.floating_point_range)
    }
    wanted = {"k": (1, 2**20), "beta": (0.0, 1.0), "max_views": (1, 100_000), "queue_size": (1, 1000)}
    assert wanted.items() <= ranges.items()


@pytest.mark.parametrize(
    ("name", "value", "why"),
    [
        ("k", 0, "out of range"),
        ("k", 2.5, "type"),
        ("beta", 1.5, "out of range"),
        ("beta", float("nan"), "nan"),
        ("max_views", 0, "out of range"),
        ("queue_size", 1001, "out of range"),
        ("autostart", "yes", "type"),
        ("pose_source", "gps", "parameter pose_source is 'gps'; expected topic, odometry, tf"),
        ("device", "tpu", "parameter device is 'tpu'; expected cpu, cuda"),
        ("map_frame", "", "parameter map_frame is empty; expected the name of a frame"),
        ("data_root", "/no/such/folder", "parameter data_root: /no/such/folder is no folder; expected one that exists"),
        ("class_names", ["background", "a", "a"], "parameter class_names: 'a' occurs more than once"),
        ("class_names", ["background", ""], "parameter class_names: name 1 is empty"),
        ("scene_to_map.scale", 0.0, "scene_to_map.scale"),
        ("scene_to_map.translation", [1.0, 2.0], "scene_to_map.translation is [1.0, 2.0]; expected 3 finite numbers"),
        ("scene_to_map.rotation", [0.0] * 4, "scene_to_map.rotation is all zeros"),
        ("camera_in_base.rotation", [0.0, 0.0, float("nan"), 1.0], "expected 4 finite numbers"),
    ],
)
def test_a_parameter_that_cannot_be_is_refused_when_it_is_set(robot: Robot, name: str, value: Any, why: str) -> None:
    before = robot.get(name)
    taken, reason = robot.set(name, value)
    assert not taken
    assert why.lower() in reason.lower()
    assert robot.get(name) == before


def test_a_parameter_that_does_not_exist_cannot_be_set(robot: Robot) -> None:
    taken, reason = robot.set("scene_pth", "a.ply")
    assert not taken and "undeclared parameter" in reason


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        ({"k": 0}, "k"),
        ({"max_views": 2.5}, "max_views"),
        ({"pose_source": "gps"}, "parameter pose_source is 'gps'; expected topic, odometry, tf"),
        ({"scene_to_map.rotation": [0.0, 0.0, 0.0, 0.0]}, "scene_to_map.rotation is all zeros"),
        ({"data_root": "/no/such/folder"}, "parameter data_root: /no/such/folder is no folder"),
    ],
)
def test_a_bad_parameter_at_the_start_is_one_error_and_exit_code_two(
    ros: Ros, arguments: dict[str, Any], why: str
) -> None:
    process = ros.start("segment_node", arguments)
    assert process.wait() == 2
    (line,) = process.output.splitlines()
    assert line.startswith("segment_node: error: ") and why in line


def test_arguments_that_ros_cannot_parse_are_one_error(ros: Ros) -> None:
    process = ros.start("segment_node", None, "-p", "k")
    assert process.wait() == 2 and "Traceback" not in process.output, process.output
    assert "segment_node: error: " in process.output.splitlines()[-1]


@pytest.mark.parametrize("state", ["inactive", "active"])
def test_while_it_is_configured_only_k_and_beta_can_be_set(robot: Robot, state: str) -> None:
    brought_to(robot, state)
    for declaration in DECLARATIONS:
        if declaration.name in ("k", "beta"):
            continue
        value = robot.get(declaration.name)
        message = Parameter("", value=value)
        kind = Parameter.Type.STRING_ARRAY if declaration.default == [] else message.type_
        (result,) = robot.ask(
            "set_parameters", parameters=[Parameter(declaration.name, kind, value).to_parameter_msg()]
        ).results
        assert not result.successful, declaration.name
        assert result.reason == (
            f"{declaration.name} can change only while the node is unconfigured: deactivate and clean it up first"
        )
    assert robot.set("k", 50) == robot.set("beta", 0.65) == (True, "")


def test_k_and_beta_take_effect_at_once(robot: Robot) -> None:
    brought_to(robot, "active")
    robot.fuse(clean_views(4))
    try:
        assert robot.set("k", 7) == robot.set("beta", 1.0) == (True, "")
        report = robot.done("segment").report
        assert (report.k, report.beta) == (7, 1.0)
        found = robot.exported(Path(robot.get("data_root")) / "out" / "k")
        assert found.clustered.sum() > 100, "with beta 1 the neighbours decide nearly everywhere"
    finally:
        robot.set("k", 50), robot.set("beta", 0.65)
    assert robot.done("segment").report.k == 50


def test_what_was_set_while_unconfigured_holds_after_configuring(robot: Robot) -> None:
    assert robot.set("max_views", 3) == (True, "")
    try:
        brought_to(robot, "active")
        robot.fuse(clean_views(5))
        status = robot.wait_for_status(lambda status: status.get("views fused") == "5", "five views")
        assert status["views kept"] == "3"
        assert robot.learn()[1].report.num_views == 3
    finally:
        assert robot.change("deactivate") and robot.change("cleanup")
        assert robot.set("max_views", 200) == (True, "")


def test_parameters_come_from_a_file(ros: Ros, parameters: dict[str, Any], tmp_path: Path) -> None:
    (tmp_path / "robot.yaml").write_text(
        "gsseg:\n  ros__parameters:\n    k: 20\n    beta: 0.5\n    autostart: true\n"
        f"    scene_path: {parameters['scene_path']}\n    class_names: [background, red ball, cup/mug, box, table]\n"
        "    scene_to_map:\n      scale: 2.0\n      translation: [1.0, 2.0, 3.0]\n"
    )
    defaults = str(REPOSITORY / "config" / "segment_node.yaml")
    robot = Robot(ros).started(None, "--params-file", defaults, "--params-file", str(tmp_path / "robot.yaml"))
    wanted = {declaration.name: declaration.default for declaration in DECLARATIONS} | {
        "k": 20, "beta": 0.5, "scene_path": str(parameters["scene_path"]), "scene_to_map.scale": 2.0,
        "scene_to_map.translation": [1.0, 2.0, 3.0], "class_names": [*CLASSES, "table"],
    }  # fmt: skip
    found = {name: robot.get(name) for name in wanted}
    assert {name: list(v) if isinstance(wanted[name], list) else v for name, v in found.items()} == wanted
    robot.wait_for_status(lambda status: status["classes"] == "5", "five classes")


# The end


@pytest.mark.parametrize("doing", ["idle", "learning"])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_with_exit_code_zero_within_three_seconds(
    ros: Ros, parameters: dict[str, Any], doing: str, number: signal.Signals
) -> None:
    robot = Robot(ros).started(parameters)
    robot.fuse(clean_views(2))
    if doing == "learning":
        robot.begin(dataset_path="long")
    process = robot.process
    assert process is not None
    process.send(number)
    assert process.wait(3) == 0, process.output
    assert "Traceback" not in process.output and "[ERROR]" not in process.output, process.output


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_while_it_is_not_configured(
    ros: Ros, parameters: dict[str, Any], number: signal.Signals
) -> None:
    process = Robot(ros).start({**parameters, "autostart": False})
    process.wait_for("autostart is false")
    process.send(number)
    assert process.wait(3) == 0, process.output


@pytest.fixture(scope="module")
def saved(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Segmentation:
    """Write state.npz, of so many large views that to save it again takes a while; returns what it holds."""
    scene = GaussianScene.load(root / "data" / "scene.ply")
    views = Dataset(root / "long").views()[:6]
    session = core_session(scene, renamed(views * 25))
    session.save(root / "state.npz")
    return session.segmentation()


def assert_state_loads(robot: Robot, saved: Segmentation, root: Path) -> None:
    assert robot.done("load_state", path="state.npz").num_views == 150
    found = robot.exported(root / "out" / "loaded")
    np.testing.assert_array_equal(found.probabilities, saved.probabilities)


def test_killed_while_it_learns_the_saved_state_loads_in_a_new_process(
    ros: Ros, parameters: dict[str, Any], root: Path, saved: Segmentation
) -> None:
    before = (root / "state.npz").read_bytes()
    moments: list[tuple[str, str, int]] = [("long", "observe", 0), ("long", "observe", 300), ("", "em", 1)]
    for i, (dataset, stage, done) in enumerate(moments):
        # A namespace for each, since what was killed takes a while to be forgotten.
        robot = Robot(ros, f"/learns{i}").started(parameters)
        assert_state_loads(robot, saved, root)
        goal = robot.goal(dataset_path=dataset)

        def reached(goal: Goal = goal, stage: str = stage, done: int = done) -> bool:
            return any(message.stage == stage and message.done >= done for message in goal.feedback)

        ros.wait_until(reached, f"{stage} {done}")
        assert robot.process is not None and not goal.future.done()
        robot.process.kill()
    assert (root / "state.npz").read_bytes() == before
    assert_state_loads(Robot(ros, "/afterwards").started(parameters), saved, root)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.7])
def test_killed_while_it_saves_the_earlier_state_loads_in_a_new_process(
    ros: Ros, parameters: dict[str, Any], root: Path, saved: Segmentation, share: float
) -> None:
    before = (root / "state.npz").read_bytes()
    robot = Robot(ros, "/saves").started(parameters)
    assert_state_loads(robot, saved, root)

    def written() -> list[int]:
        return [path.stat().st_size for path in root.glob(".gsseg-*.npz")]

    answer = robot.send("save_state", path="state.npz")
    ros.wait_until(lambda: any(size >= share * len(before) for size in written()), "the new file to grow")
    assert robot.process is not None
    robot.process.kill()
    assert not answer.done()
    assert written(), "it was killed before it was done"
    assert (root / "state.npz").read_bytes() == before

    robot = Robot(ros, "/loads").started(parameters)
    assert_state_loads(robot, saved, root)
    for left in root.glob(".gsseg-*.npz"):
        left.unlink()
