"""The parameters of `segment_node`: names, defaults, descriptions and ranges."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from rclpy.node import Node
from rclpy.parameter import Parameter

from gsseg_core.files.limits import MAX_LABEL
from gsseg_core.raster.backends import devices
from gsseg_core.raster.depth_gating import DepthTolerance
from gsseg_core.refine.settings import MAX_K, RefineSettings
from gsseg_core.scene.scene_writers import DEFAULT, SCENE_WRITERS
from gsseg_ros.camera_infos import AUTO
from gsseg_ros.node.masks.compressed import TRANSPORTS
from gsseg_ros.node_parameters import parameter_descriptor

POSE_SOURCES = ("topic", "odometry", "tf", "auto")


@dataclass(frozen=True)
class Declaration:
    """One parameter."""

    name: str
    default: Any  # its type is the parameter's
    description: str  # what it is, with its unit
    low: float | None = None  # least and largest value
    high: float | None = None
    at_once: bool = False  # whether a change takes effect at once; else it is accepted only while unconfigured
    at_start: bool = False  # whether it is given at the start of the process for good: it bounds what peers reach
    any_type: bool = False  # whether a value may be of another type: true and false are no strings in YAML


MAX_PIXELS, OBJECTS = 1 << 24, -1.0
SCALES, _NO_TURN = (1e-9, 1e9), [0.0, 0.0, 0.0, 1.0]
"""Least and largest scene_to_map.scale."""

DECLARATIONS = (
    Declaration(
        "scene_path",
        "",
        "scene to load when the node is configured; empty: wait for ~/load_scene; set later, it must lie below "
        "data_root",
    ),
    Declaration(
        "data_root",
        "",
        "folder below which paths in requests must lie; empty: no request may name a path; set at the start only",
        at_start=True,
    ),
    Declaration(
        "max_pixels",
        MAX_PIXELS,
        "pixels of a mask, an image or a viewpoint; larger ones are refused; set at the start only [count]",
        1,
        2**31 - 1,
        at_start=True,
    ),
    Declaration(
        "class_names",
        [],
        "names of the classes, the index being the id (0: background), which is the label in masks unless label_info "
        "names those; empty: classes are added as they turn up, named by label_info or after their numbers",
    ),
    Declaration(
        "ids",
        AUTO,
        "what the labels of a mask are: given, those of classes; per-view, numbers that hold in their own mask only, "
        "as automatic mask generators give, so that objects are found and named by the node; auto: per-view for "
        "detections without class_names, else given",
    ),
    Declaration(
        "granularity",
        OBJECTS,
        "ids per-view: what ~/segment, ~/render_view and ~/export give, from 0, objects put together to wholes, to 1, "
        "all their parts; below 0: the objects [-1..1]",
        *(-1.0, 1.0, True),
    ),
    Declaration(
        "label_map",
        "",
        "file (JSON or YAML) that renames, merges and ignores (null: unknown) the segmenter's classes; empty: none; "
        "set later, it must lie below data_root",
    ),
    Declaration(
        "detections_topic",
        "",
        "topic of yolo_msgs/DetectionArray, which takes the place of masks, or vision_msgs/Detection2DArray, which "
        "names what is in them; empty: none",
    ),
    Declaration(
        "palette",
        [],
        "colours of masks in rgb8 or bgr8, such as '#0080ff', the index being the label; a mask with another colour is "
        "rejected",
    ),
    Declaration(
        "mask_transport",
        "raw",
        f"how masks are sent: {', '.join(TRANSPORTS)} (PNG on mask/compressed, as image_transport names it)",
    ),
    Declaration(
        "image_transport",
        "raw",
        f"how camera images are sent: {', '.join(TRANSPORTS)} (JPEG or PNG on image/compressed)",
    ),
    Declaration("cameras", [], "names of cameras, with which topics begin, as front/mask; empty: a single one"),
    Declaration(
        "pose_source",
        "topic",
        f"where the camera's pose comes from: {', '.join(POSE_SOURCES)}, which is TF first and else the topic",
    ),
    Declaration(
        "pose_tolerance",
        0.0,
        "pose topics: how far a pose may lie before or after the mask's stamp; between two it is interpolated [s]",
        *(0.0, 10.0),
    ),
    Declaration("depth_gating", False, "whether masks wait for depth images; what these contradict is unknown"),
    Declaration(
        "depth_tolerance.absolute",
        DepthTolerance.absolute,
        "depth_gating: how far a measured depth may be off, and a share of the depth besides [m]",
        *(0.0, 1e6, True),
    ),
    Declaration(
        "depth_tolerance.relative",
        DepthTolerance.relative,
        "depth_gating: this share of the scene's depth [0..1]",
        *(0.0, 1.0, True),
    ),
    Declaration(
        "rectified",
        AUTO,
        "whether masks and images are rectified, as image_proc leaves them, so that p of camera_info counts: true, "
        "false, or auto, where a topic with rect in its name is; others are undistorted if d is not zero",
        any_type=True,
    ),
    Declaration("map_frame", "map", "frame of the poses and of all outputs"),
    Declaration("max_views", 200, "views kept for learning, the last ones [count]", 1, 100_000),
    Declaration(
        "max_classes",
        256,
        "without class_names: classes that may turn up, the background included; a mask that would make more is "
        "rejected [count]",
        1,
        MAX_LABEL + 1,
    ),
    Declaration("k", RefineSettings.k, "neighbours in KNN clustering and filter [count]", 1, MAX_K, True),
    Declaration(
        "beta", RefineSettings.beta, "probability below which KNN clustering decides [0..1]", 0.0, 1.0, at_once=True
    ),
    Declaration(
        "export_format",
        DEFAULT,
        f"format of the classes that ~/export writes: {', '.join(SCENE_WRITERS)}",
        at_once=True,
    ),
    Declaration(
        "obstacle_classes",
        [],
        "classes, by name or number, that ~/obstacles says the places of, for planners; empty: none",
        at_once=True,
    ),
    Declaration("obstacle_rate", 2.0, "messages on ~/obstacles per second [Hz]", 0.01, 100.0),
    Declaration("obstacle_resolution", 0.05, "side of a cell of ~/obstacles [m]", 0.001, 10.0),
    Declaration(
        "obstacle_min_height", 0.05, "lower parts of a class are no obstacle, z of the map [m]", -1e6, 1e6, at_once=True
    ),
    Declaration(
        "obstacle_max_height", 2.0, "higher parts of a class are no obstacle, z of the map [m]", -1e6, 1e6, at_once=True
    ),
    Declaration("device", "cpu", f"where views are rendered: {devices()}"),
    Declaration("autostart", True, "configure and activate at start; false: wait for a lifecycle manager"),
    Declaration("queue_size", 100, "masks waiting to be fused, 256 MiB at most; else the oldest go [count]", 1, 1000),
    Declaration(
        "scene_frame",
        "scene",
        "frame of the scene's axes, broadcast below map_frame on /tf_static where tf2_msgs is installed; empty: none",
    ),
    Declaration(
        "scene_to_map.scale", 1.0, "metres of the map per unit of the scene; views follow [m]", *SCALES, at_once=True
    ),
    Declaration(
        "scene_to_map.translation", [0.0] * 3, "origin of the scene in the map, x y z; views follow [m]", at_once=True
    ),
    Declaration(
        "scene_to_map.rotation",
        _NO_TURN,
        "axes of the scene in the map, quaternion x y z w; views follow",
        at_once=True,
    ),
    Declaration(
        "camera_in_base.translation",
        [0.0] * 3,
        "pose_source odometry: origin of the camera's optical frame in the odometry's child frame, x y z [m]",
    ),
    Declaration(
        "camera_in_base.rotation",
        _NO_TURN,
        "pose_source odometry: axes of the camera's optical frame in the odometry's child frame, quaternion x y z w",
    ),
)
AT_ONCE = frozenset(declaration.name for declaration in DECLARATIONS if declaration.at_once)


def declare(node: Node) -> None:
    """Declare all parameters; a value from outside that has another type or is out of range is refused by rclpy."""
    for declaration in DECLARATIONS:
        # An empty list has no type of its own.
        default = Parameter.Type.STRING_ARRAY if declaration.default == [] else declaration.default
        text, limits = declaration.description, (declaration.low, declaration.high)
        flags = {"read_only": declaration.at_start, "dynamic_typing": declaration.any_type}
        described = parameter_descriptor(text, declaration.default, *limits, **flags)
        node.declare_parameter(declaration.name, default, described)
    lists = [declaration.name for declaration in DECLARATIONS if declaration.default == []]
    unset = [name for name in lists if node.get_parameter_or(name).value is None]
    # Who asks for all parameters, as `ros2 param dump` does, is told none if one of them has no value.
    node.set_parameters([Parameter(name, Parameter.Type.STRING_ARRAY, []) for name in unset])
