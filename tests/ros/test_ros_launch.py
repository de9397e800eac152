"""The launch file of the node, without launch: stand-ins take what it describes, and ROS itself resolves the names."""

from __future__ import annotations

import importlib.util
import sys
import typing
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import yaml
from ros_helpers import REPOSITORY, Node, private_context

from gsseg_ros.node.declarations import DECLARATIONS

FILE = REPOSITORY / "launch" / "segment.launch.py"
Launched = Callable[..., list[SimpleNamespace]]


class Configuration:
    """In the place of launch's LaunchConfiguration: the context is a dict of values by name."""

    def __init__(self, name: str) -> None:
        self.name = name

    def perform(self, context: dict[str, str]) -> str:
        return context[self.name]


def keep(*positional: Any, **fields: Any) -> SimpleNamespace:
    """What launch would be told, to be looked at."""
    return SimpleNamespace(positional=positional, **fields)


STAND_INS: dict[str, dict[str, Any]] = {
    "launch": {"LaunchContext": dict, "LaunchDescription": list},
    "launch.actions": {"DeclareLaunchArgument": keep, "OpaqueFunction": keep},
    "launch.conditions": {"IfCondition": keep},
    "launch.substitutions": {"LaunchConfiguration": Configuration},
    "launch_ros": {},
    "launch_ros.actions": {"Node": keep},
    "launch_ros.parameter_descriptions": {"ParameterValue": keep},
}


@pytest.fixture
def launched(monkeypatch: pytest.MonkeyPatch) -> Launched:
    """Describe the nodes for some launch arguments, all others at their defaults."""
    for name, content in STAND_INS.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    spec = importlib.util.spec_from_file_location("segment_launch", FILE)
    assert spec and spec.loader
    file = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(file)
    *arguments, opaque = file.generate_launch_description()
    defaults = {argument.positional[0]: argument.default_value for argument in arguments}
    assert len(defaults) == len(arguments)
    assert all(isinstance(argument.description, str) and argument.description for argument in arguments)

    def describe(**given: str) -> list[SimpleNamespace]:
        given = {name.replace("__", "."): value for name, value in given.items()}
        assert given.keys() <= defaults.keys()
        nodes: list[SimpleNamespace] = opaque.function(defaults | given)
        return nodes

    return describe


def resolved(node: SimpleNamespace, name: str, topics: list[str]) -> list[str]:
    """Full names of topics as ROS makes them of a node's name, namespace and remappings."""
    rules = [text for source, target in node.remappings for text in ("-r", f"{source}:={target}")]
    with private_context() as context:
        there = Node(
            getattr(node, "name", name), namespace=node.namespace, context=context, use_global_arguments=False,
            cli_args=["--ros-args", *rules],
        )  # fmt: skip
        return [there.resolve_topic_name(topic) for topic in topics]


def shown() -> list[str]:
    """Topics that RViz is to show, as its file has them."""
    displays = yaml.safe_load((REPOSITORY / "rviz/gsseg.rviz").read_text())["Visualization Manager"]["Displays"]
    return [display["Topic"]["Value"] for display in displays if "Topic" in display]


def test_with_nothing_given_the_node_has_its_parameters_file_and_nothing_hides_it(launched: Launched) -> None:
    segment, rviz = launched()
    file, own = segment.parameters
    assert Path(file) == REPOSITORY / "config/segment_node.yaml"
    assert own == {"use_sim_time": False}
    assert (segment.name, segment.namespace) == ("gsseg", "")
    assert rviz.condition.positional == ("false",)
    assert rviz.arguments == ["-d", str(REPOSITORY / "rviz/gsseg.rviz")]


def test_every_parameter_of_the_node_can_be_given_and_keeps_its_type(launched: Launched) -> None:
    given = {declaration.name.replace(".", "__"): "7" for declaration in DECLARATIONS}
    own = launched(**given, use_sim_time="true")[0].parameters[1]
    assert own.pop("use_sim_time") is True
    types = {name: value.value_type for name, value in own.items()}
    assert {value.positional for value in own.values()} == {("7",)}
    wanted: dict[str, Any] = {declaration.name: type(declaration.default) for declaration in DECLARATIONS}
    for declaration in DECLARATIONS:
        if isinstance(declaration.default, list):
            wanted[declaration.name] = typing.List[float] if declaration.default else typing.List[str]  # noqa: UP006
    assert types == wanted


def test_an_empty_scene_frame_is_given_to_the_node_too(launched: Launched) -> None:
    assert launched(scene_frame="")[0].parameters[1]["scene_frame"].positional == ("",)


@pytest.mark.parametrize(
    ("name", "namespace", "full"),
    [
        ("gsseg", "", "/gsseg"),
        ("gsseg", "/robot", "/robot/gsseg"),
        ("left", "", "/left"),
        ("left", "/a/b", "/a/b/left"),
    ],
)
def test_each_node_has_an_rviz_that_shows_its_own_topics(
    launched: Launched, name: str, namespace: str, full: str
) -> None:
    segment, rviz = launched(name=name, namespace=namespace, rviz="true")
    assert rviz.condition.positional == ("true",)
    topics = [topic.removeprefix("gsseg/") for topic in shown()]
    assert set(topics) == {"cloud", "object_markers", "overlay"}
    published = resolved(segment, name, [f"~/{topic}" for topic in topics])
    assert published == [f"{full}/{topic}" for topic in topics]
    assert resolved(rviz, "rviz2", shown()) == published


def test_inputs_are_in_the_namespace_of_the_node_unless_another_topic_is_given(launched: Launched) -> None:
    segment, _ = launched(namespace="/robot", mask="/segmenter/mask", image="front/image")
    assert resolved(segment, "gsseg", ["mask", "camera_info", "image"]) == [
        "/segmenter/mask", "/robot/camera_info", "/robot/front/image",
    ]  # fmt: skip


def test_those_of_several_cameras_are_given_as_remappings(launched: Launched) -> None:
    segment, _ = launched(cameras="[front, left]", remap="front/mask:=/a/mask left/mask:=b/mask")
    assert all(isinstance(rule, tuple) for rule in segment.remappings), "launch takes nothing else"
    assert resolved(segment, "gsseg", ["front/mask", "left/mask", "left/pose"]) == ["/a/mask", "/b/mask", "/left/pose"]


def test_another_map_frame_is_the_one_that_rviz_stands_in(launched: Launched) -> None:
    _, rviz = launched(map_frame="site")
    assert rviz.arguments[-2:] == ["-f", "site"]
