"""Starts the segmentation node: `ros2 launch gsseg_ros segment.launch.py scene_path:=/data/scene.ply`."""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

SHARE = FindPackageShare("gsseg_ros")
# Name, default, description.
ARGUMENTS = (
    ("params_file", PathJoinSubstitution([SHARE, "config", "segment_node.yaml"]), "parameters of the node"),
    ("scene_path", "", "3DGS PLY to load at the start; empty: as params_file says"),
    ("data_root", "", "folder below which paths in requests must lie; empty: as params_file says"),
    ("pose_source", "", "topic, odometry or tf; empty: as params_file says"),
    ("namespace", "", "namespace of the node and of its topics"),
    ("mask", "mask", "topic with the masks"),
    ("camera_info", "camera_info", "topic with the CameraInfo of the masks"),
    ("pose", "pose", "topic with the camera's pose in the map"),
    ("odometry", "odometry", "topic with the odometry, where pose_source is odometry"),
    ("image", "image", "topic with the camera's pictures, for the overlay"),
    ("use_sim_time", "false", "whether time comes from /clock: true or false"),
    ("log_level", "info", "debug, info, warn, error or fatal"),
    ("rviz", "false", "whether to show the clouds in RViz: true or false; only where namespace is empty"),
)
INPUTS = ("mask", "camera_info", "pose", "odometry", "image")
# What a launch argument changes only where it is given: its default must not hide what params_file says.
OVERRIDES = ("scene_path", "data_root", "pose_source")


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments; the node itself is put together once their values are known."""
    return LaunchDescription(
        [
            *(DeclareLaunchArgument(name, default_value=value, description=text) for name, value, text in ARGUMENTS),
            OpaqueFunction(function=_nodes),
        ]
    )


def _nodes(context: LaunchContext) -> list[Node]:
    value = {name: LaunchConfiguration(name).perform(context) for name, _, _ in ARGUMENTS}
    sim_time = {"use_sim_time": value["use_sim_time"].lower() in ("true", "1")}
    given = {name: ParameterValue(value[name], value_type=str) for name in OVERRIDES if value[name]}
    segment = Node(  # Not a LifecycleNode: it configures and activates itself, unless its parameter autostart is false.
        package="gsseg_ros",
        executable="segment_node",
        name="gsseg",
        namespace=value["namespace"],
        parameters=[value["params_file"], sim_time | given],
        remappings=[(name, value[name]) for name in INPUTS],
        ros_arguments=["--log-level", value["log_level"]],
        output="screen",
        emulate_tty=True,
    )
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        arguments=["-d", PathJoinSubstitution([SHARE, "rviz", "gsseg.rviz"])],
        parameters=[sim_time],
        condition=IfCondition(value["rviz"]),
    )
    return [segment, rviz]
