"""Starts the segmentation node: `ros2 launch gsseg_ros segment.launch.py scene_path:=/data/scene.ply`.

Every parameter of the node is an argument, too: `max_views:=100`, `scene_to_map.scale:=0.5`,
`class_names:="[background, chair]"`. Nodes side by side differ in `name` or `namespace`, each with an RViz of its own.
"""

from pathlib import Path
from typing import Any, List  # noqa: UP035 - launch knows no other list type.

import yaml
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

SHARE = Path(__file__).resolve().parents[1]
DEFAULTS = SHARE / "config" / "segment_node.yaml"
# Name, default, description.
ARGUMENTS = (
    ("params_file", str(DEFAULTS), "parameters of the node"),
    ("name", "gsseg", "name of the node, and so of its topics and services"),
    ("namespace", "", "namespace of the node and of its topics"),
    ("mask", "mask", "topic with the masks"),
    ("camera_info", "camera_info", "topic with the CameraInfo of the masks"),
    ("pose", "pose", "topic with the camera's pose in the map"),
    ("odometry", "odometry", "topic with the odometry, where pose_source is odometry"),
    ("image", "image", "topic with the camera's pictures, for the overlay"),
    ("depth", "depth", "topic with depths of the camera's image"),
    ("remap", "", "more of that, between blanks: 'front/mask:=/a/mask left/mask:=/b/mask'"),
    ("use_sim_time", "false", "whether time comes from /clock: true or false"),
    ("log_level", "info", "debug, info, warn, error or fatal"),
    ("rviz", "false", "whether to show what the node publishes in RViz: true or false"),
)
INPUTS = ("mask", "camera_info", "pose", "odometry", "image", "depth")
# What the argument of a parameter is unless given, as a default would hide what params_file says: empty, unless that is
# a value of its own.
NOT_GIVEN = {"scene_frame": "(params_file)"}
# Topics of the node that rviz/gsseg.rviz shows, below the name gsseg and relative to the namespace.
SHOWN = ("cloud", "object_markers", "overlay")


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments; the node itself is put together once their values are known."""
    own = [DeclareLaunchArgument(name, default_value=value, description=text) for name, value, text in ARGUMENTS]
    parameters = [
        DeclareLaunchArgument(
            name, default_value=NOT_GIVEN.get(name, ""), description=f"parameter of the node, {value} by default"
        )
        for name, value in _defaults().items()
    ]
    return LaunchDescription([*own, *parameters, OpaqueFunction(function=_nodes)])


def _defaults() -> dict[str, Any]:
    """All parameters of the node with their defaults, which tell their types."""
    (node,) = yaml.safe_load(DEFAULTS.read_text(encoding="utf-8")).values()
    return _flat(node["ros__parameters"])


def _flat(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in tree.items():
        flat.update(_flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value})
    return flat


def _type_of(default: Any) -> Any:
    if isinstance(default, list):
        return List[type(default[0]) if default else str]  # type: ignore[misc]  # noqa: UP006
    return type(default)


def _nodes(context: LaunchContext) -> list[Node]:
    defaults = _defaults()
    names = [*(name for name, _, _ in ARGUMENTS), *defaults]
    value = {name: LaunchConfiguration(name).perform(context) for name in names}
    sim_time = {"use_sim_time": value["use_sim_time"].lower() in ("true", "1")}
    given = {
        name: ParameterValue(value[name], value_type=_type_of(default))
        for name, default in defaults.items()
        if value[name] != NOT_GIVEN.get(name, "")
    }
    segment = Node(  # Not a LifecycleNode: it configures and activates itself, unless its parameter autostart is false.
        package="gsseg_ros",
        executable="segment_node",
        name=value["name"],
        namespace=value["namespace"],
        parameters=[value["params_file"], sim_time | given],
        remappings=[
            *((name, value[name]) for name in INPUTS),
            *(tuple(rule.split(":=")) for rule in value["remap"].split()),
        ],
        ros_arguments=["--log-level", value["log_level"]],
        output="screen",
        emulate_tty=True,
    )
    fixed_frame = ["-f", value["map_frame"]] if value["map_frame"] else []
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        namespace=value["namespace"],
        arguments=["-d", str(SHARE / "rviz" / "gsseg.rviz"), *fixed_frame],
        parameters=[sim_time],
        remappings=[(f"gsseg/{topic}", f"{value['name']}/{topic}") for topic in SHOWN],
        condition=IfCondition(value["rviz"]),
    )
    return [segment, rviz]
