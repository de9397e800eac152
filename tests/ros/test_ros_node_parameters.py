"""The parameters of the segmentation node: what they may be, when they may change, and what a change does."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any

import pytest
import yaml
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterType
from rclpy.parameter import Parameter, get_parameter_value, parameter_value_to_python
from ros_fixtures import idle_fixture, idle_robot_fixture, parameters_fixture, root_fixture, shared_fixture  # noqa: F401
from ros_helpers import REPOSITORY, Ros, ros_fixture  # noqa: F401
from ros_robot import CLASSES, Robot
from small_scenes import clean_views

from gsseg_ros.node.declarations import AT_ONCE, DECLARATIONS
from gsseg_ros.node.parameters import Settings, check


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


STEMS = ("0_background", "1_red_ball", "2_cup_mug", "3_box")


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
        ("device", "tpu", "parameter device is 'tpu'; expected cpu, cuda (the first GPU) or cuda:1 and so on"),
        ("device", "cuda:x", "parameter device is 'cuda:x'"),
        (
            "palette",
            ["#000000", "red"],
            "parameter palette: label 1 has the colour 'red'; expected one such as",
        ),
        ("mask_transport", "zip", "parameter mask_transport is 'zip'; expected raw, compressed"),
        ("export_format", "obj", "parameter export_format is 'obj'; expected one of ply, compressed-ply, spz"),
        ("rectified", "maybe", "parameter rectified is 'maybe'; expected auto, true, false"),
        ("ids", "mine", "parameter ids is 'mine'; expected auto, given, per-view"),
        ("ids", "per-view", "parameter class_names gives 4 names, but with ids 'per-view' the node finds the objects"),
        ("granularity", 0.5, "parameter granularity is 0.5, but with ids 'given' objects have no parts; expected -1"),
        ("granularity", 1.5, "out of range"),
        ("map_frame", "", "parameter map_frame is empty; expected the name of a frame"),
        ("map_frame", "/map", "parameter map_frame is '/map'; expected no slash before it, as TF takes none"),
        ("scene_frame", "/scene", "parameter scene_frame is '/scene'; expected no slash before it"),
        ("scene_frame", "map", "parameter scene_frame is 'map', as map_frame; expected another name"),
        ("detections_topic", "no topic", "parameter detections_topic: Invalid topic name"),
        ("data_root", "/", "read-only"),
        ("max_pixels", 2**31 - 1, "read-only"),
        ("scene_path", "/etc/passwd", "parameter scene_path, set after the start: path '/etc/passwd' is not below"),
        ("class_names", ["background", "a", "a"], "parameter class_names: 'a' occurs more than once"),
        ("class_names", ["background", ""], "parameter class_names: label 1 has the name ''"),
        ("scene_to_map.scale", 0.0, "scene_to_map.scale"),
        ("scene_to_map.translation", [1.0, 2.0], "scene_to_map.translation is [1.0, 2.0]; expected 3 finite numbers"),
        ("scene_to_map.translation", [1e308, 0.0, 0.0], "; expected metres, at most 1e+12"),
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


@pytest.mark.parametrize("value", [True, "false", "auto"])
def test_rectified_may_be_a_word_or_a_truth_value_as_yaml_makes_of_it(robot: Robot, value: Any) -> None:
    assert robot.set("rectified", value) == (True, "")
    assert robot.get("rectified") == value


@pytest.mark.parametrize("name", ["obstacle_classes", "class_names", "palette", "cameras"])
def test_a_list_can_be_emptied_as_ros2_param_set_does_which_sends_an_empty_one_as_truth_values(
    robot: Robot, name: str
) -> None:
    before, given = robot.get(name), {"palette": ["#000000"], "cameras": ["front"]}.get(name, CLASSES)
    assert robot.set(name, given) == (True, "")
    empty = ParameterMessage(name=name, value=get_parameter_value("[]"))
    (result,) = robot.ask("set_parameters", parameters=[empty]).results
    assert (result.successful, robot.get(name) or []) == (True, []), result.reason
    if before:
        robot.set(name, before)


def test_detections_below_the_name_of_a_camera_cannot_have_an_absolute_name(robot: Robot) -> None:
    robot.set("cameras", ["front"])
    taken, reason = robot.set("detections_topic", "/detections")
    robot.set("cameras", [])
    assert not taken and "expected a name below that of each camera" in reason


def test_a_parameter_that_does_not_exist_cannot_be_set(robot: Robot) -> None:
    taken, reason = robot.set("scene_pth", "a.ply")
    assert not taken and "undeclared parameter" in reason


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        ({"k": 0}, "k"),
        ({"k": []}, "parameter k is an empty list; expected a value such as 50"),
        ({"max_views": 2.5}, "max_views"),
        ({"pose_source": "gps"}, "parameter pose_source is 'gps'; expected topic, odometry, tf"),
        ({"scene_to_map.rotation": [0.0, 0.0, 0.0, 0.0]}, "scene_to_map.rotation is all zeros"),
        ({"data_root": "/no/such/folder"}, "parameter data_root: /no/such/folder is not a folder"),
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
def test_while_it_is_configured_only_what_takes_effect_at_once_can_be_set(robot: Robot, state: str) -> None:
    robot.brought_to(state)
    for declaration in DECLARATIONS:
        if declaration.name in AT_ONCE:
            continue
        value = robot.get(declaration.name)
        message = Parameter("", value=value)
        kind = Parameter.Type.STRING_ARRAY if declaration.default == [] else message.type_
        (result,) = robot.ask(
            "set_parameters", parameters=[Parameter(declaration.name, kind, value).to_parameter_msg()]
        ).results
        assert not result.successful, declaration.name
        if declaration.at_start:
            assert "read-only" in result.reason
            continue
        assert result.reason == (
            f"{declaration.name} can change only while the node is unconfigured: deactivate and clean it up first"
        )
    assert {"k", "beta", "export_format", "obstacle_classes"} < AT_ONCE
    assert robot.set("k", 50) == robot.set("beta", 0.65) == robot.set("export_format", "ply") == (True, "")
    assert robot.set("obstacle_classes", ["box"]) == (True, "")


@pytest.mark.parametrize(
    ("name", "files"), [("glb", [f"classes/{k}.glb" for k in STEMS]), ("usd", ["classes/objects.usdc"])]
)
def test_classes_are_exported_in_the_format_that_is_set(robot: Robot, name: str, files: list[str]) -> None:
    robot.brought_to("active")
    robot.fuse(clean_views(4))
    try:
        assert robot.set("export_format", name) == (True, "")
        folder = robot.out(f"as_{name}")
        exported = robot.done("export", directory=str(folder))
        assert exported.files == ["segmentation.npz", *files, "report.json"]
        assert all((folder / file).is_file() for file in exported.files)
    finally:
        robot.set("export_format", "ply")


def test_a_request_chooses_the_format_and_meshes_to_collide_with(robot: Robot) -> None:
    robot.brought_to("active")
    robot.fuse(clean_views(4))
    folder = robot.out("meshes")
    exported = robot.done("export", directory=str(folder), format="glb", collision="hull", classes=["box"])
    assert exported.files == ["segmentation.npz", "classes/3_box.glb", "classes/3_box.obj", "report.json"]
    report = json.loads((folder / "report.json").read_text())
    assert report["settings"]["scene_format"] == "glb" and report["settings"]["collision"] == "hull"
    assert [entry.get("collision") for entry in report["classes"]] == [None, None, None, "classes/3_box.obj"]
    assert robot.get("export_format") == "ply"


def test_k_and_beta_take_effect_at_once(robot: Robot) -> None:
    robot.brought_to("active")
    robot.fuse(clean_views(4))
    try:
        assert robot.set("k", 7) == robot.set("beta", 1.0) == (True, "")
        report = robot.done("segment").report
        assert (report.k, report.beta) == (7, 1.0)
        found = robot.exported(robot.out("k"))
        assert found.clustered.sum() > 100, "with beta 1 the neighbours decide nearly everywhere"
    finally:
        robot.set("k", 50), robot.set("beta", 0.65)
    assert robot.done("segment").report.k == 50


def test_what_was_set_while_unconfigured_holds_after_configuring(robot: Robot) -> None:
    assert robot.set("max_views", 3) == (True, "")
    try:
        robot.brought_to("active")
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
    robot.wait_for_status(lambda status: status.get("classes") == "5", "five classes")


def test_all_parameters_can_be_dumped_at_once_and_a_node_that_is_given_them_has_the_same(
    ros: Ros, root: Path, tmp_path: Path
) -> None:
    def dumped(robot: Robot) -> dict[str, Any]:
        names = sorted(robot.ask("list_parameters").result.names)
        values = robot.ask("get_parameters", names=names).values
        assert len(values) == len(names), "one without a value hides all others"
        found = zip(names, map(parameter_value_to_python, values), strict=True)
        return {name: value if isinstance(value, bool | int | float | str) else list(value) for name, value in found}

    first = Robot(ros)
    first.start({"data_root": root, "autostart": False, "k": 44}).wait_for("autostart is false")
    found, tree = dumped(first), {}
    assert found["k"] == 44 and {found[name] == [] for name in ("class_names", "palette", "cameras")} == {True}
    for name, value in found.items():  # As `ros2 param dump` has it.
        *above, last = name.split(".")
        functools.reduce(lambda part, key: part.setdefault(key, {}), above, tree)[last] = value
    (tmp_path / "dump.yaml").write_text(yaml.dump({"/gsseg": {"ros__parameters": tree}}))
    assert first.process is not None and first.process.stop() == 0
    again = Robot(ros)
    again.process = ros.start("segment_node", None, "--params-file", str(tmp_path / "dump.yaml"))
    again.process.wait_for("autostart is false")
    assert dumped(again) == found


def test_parameters_that_the_node_does_not_have_are_named_with_those_that_were_meant(ros: Ros) -> None:
    process = ros.start("segment_node", {"autostart": False, "max_view": 10, "controller.rate": 5.0, "k": 44})
    process.wait_for("autostart is false")
    assert (
        "[gsseg]: parameters that this node does not have are ignored: controller.rate, max_view (did you mean "
        "max_views?)\n" in process.output
    )


def test_parameters_of_ros_itself_may_change_without_a_look_at_those_of_the_node(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A node declares dozens of them, and its own may have thousands of class names."""
    monkeypatch.setattr(Settings, "read", lambda *_: pytest.fail("settings were read"))
    changed = [Parameter("qos_overrides./mask.subscription.depth", value=3)]
    assert check(None, changed, True, lambda _: None).successful
