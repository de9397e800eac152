"""Plays a dataset folder or a bag to the node: `ros2 launch gsseg_ros replay.launch.py data:=/data/room`."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

# Name, type, default, description. The parameters of replay_node, of the same names.
ARGUMENTS = (
    ("data", str, "", "dataset folder to replay; exactly one of data and bag"),
    ("bag", str, "", "bag to replay: a folder, .mcap or .db3; exactly one of data and bag"),
    ("labels", str, "labels", "sub-folder of data with the label images"),
    ("split", str, "train", "views of data to replay: train, test or all"),
    ("rate", float, "10.0", "masks per second"),
    ("loop", int, "1", "how many times; 0: for ever"),
    ("grow", bool, "False", "whether the scene of data arrives in five submaps, and a loop closes at the end"),
    ("frame_id", str, "camera", "frame of the camera, with data"),
    ("map_frame", str, "map", "frame of the poses, with data"),
    ("wait_for_subscribers", float, "60.0", "seconds to wait for somebody who listens"),
    ("mask_topic", str, "", "topic of bag with the masks; empty: the one whose name ends in mask"),
    ("camera_info_topic", str, "", "topic of bag with the CameraInfo; empty: the one whose name ends in camera_info"),
    ("pose_topic", str, "", "topic of bag with the poses; empty: the one whose name ends in pose"),
    ("image_topic", str, "", "topic of bag with the pictures; empty: the one whose name ends in image"),
)


def generate_launch_description() -> LaunchDescription:
    """Describe the node, which ends when all is published."""
    arguments = [
        DeclareLaunchArgument(name, default_value=value, description=text) for name, _, value, text in ARGUMENTS
    ]
    replay = Node(
        package="gsseg_ros",
        executable="replay_node",
        name="replay",
        namespace=LaunchConfiguration("namespace"),
        parameters=[
            {name: ParameterValue(LaunchConfiguration(name), value_type=kind) for name, kind, _, _ in ARGUMENTS}
        ],
        output="screen",
        emulate_tty=True,
    )
    namespace = DeclareLaunchArgument("namespace", default_value="", description="namespace of the node and its topics")
    return LaunchDescription([*arguments, namespace, replay])
