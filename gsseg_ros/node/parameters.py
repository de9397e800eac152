"""The parameters of `segment_node`: names, defaults, descriptions, ranges, and the settings that come of them."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from gsseg_core.data.class_names import class_ids, flaw_of_class_name
from gsseg_core.data.label_images import PER_VIEW
from gsseg_core.errors import GssegError, SettingsError
from gsseg_core.files.limits import MAX_LABEL
from gsseg_core.raster.backends import devices, rasteriser_of
from gsseg_core.raster.depth_gating import DepthTolerance
from gsseg_core.refine.settings import MAX_K, RefineSettings
from gsseg_core.scene.scene_writers import DEFAULT, SCENE_WRITERS, check_format
from gsseg_ros.camera_infos import AUTO, RECTIFIED
from gsseg_ros.frames import Similarity, pose_from_parameters
from gsseg_ros.node.masks.compressed import TRANSPORTS
from gsseg_ros.node.masks.palette import Palette

POSE_SOURCES = ("topic", "odometry", "tf", "auto")
GIVEN = "given"
IDS = (AUTO, GIVEN, PER_VIEW)
_CHOICES = {
    "pose_source": POSE_SOURCES, "ids": IDS, "rectified": RECTIFIED, "mask_transport": TRANSPORTS,
    "image_transport": TRANSPORTS,
}  # fmt: skip
_CAMERA = re.compile(r"[A-Za-z](_?[A-Za-z0-9])*")  # Such that it may be part of the name of a topic.


@dataclass(frozen=True)
class Declaration:
    """One parameter.

    Attributes
    ----------
    name : str
        Its name.
    default : object
        Its default; its type is the parameter's.
    description : str
        What it is, with its unit.
    low, high : float, optional
        Least and largest value.
    at_once : bool
        Whether a change takes effect at once; others are accepted only while the node is unconfigured.
    at_start : bool
        Whether it is given at the start of the process, once for all: it bounds what peers may reach.
    any_type : bool
        Whether a value may be of another type than the default: true and false are no strings in YAML.
    """

    name: str
    default: Any
    description: str
    low: float | None = None
    high: float | None = None
    at_once: bool = False
    at_start: bool = False
    any_type: bool = False


MAX_PIXELS = 1 << 24
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
    Declaration("queue_size", 30, "masks waiting to be fused; of more, the oldest are dropped [count]", 1, 1000),
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


@dataclass(frozen=True, eq=False)
class Settings:
    """The parameters as the node uses them; see `DECLARATIONS`.

    Raises
    ------
    SettingsError
        A value is impossible; the message names the parameter.
    """

    scene_path: str
    data_root: str
    max_pixels: int
    class_names: tuple[str, ...]
    ids: str
    label_map: str
    detections_topic: str
    palette: Palette | None
    mask_transport: str
    image_transport: str
    cameras: tuple[str, ...]
    pose_source: str
    pose_tolerance: float
    depth_gating: bool
    depth_tolerance: DepthTolerance
    rectified: str
    map_frame: str
    scene_frame: str
    max_views: int
    max_classes: int
    k: int
    beta: float
    export_format: str
    obstacle_classes: tuple[str, ...]
    obstacle_rate: float
    obstacle_resolution: float
    obstacle_min_height: float
    obstacle_max_height: float
    device: str
    autostart: bool
    queue_size: int
    scene_to_map: Similarity
    camera_in_base: npt.NDArray[np.float64]  # (4, 4)

    def __post_init__(self) -> None:
        """Validate."""
        for name, allowed in _CHOICES.items():
            if getattr(self, name) not in allowed:
                raise SettingsError(f"parameter {name} is '{getattr(self, name)}'; expected {', '.join(allowed)}")
        try:
            rasteriser_of(self.device)
        except SettingsError as error:
            raise SettingsError(f"parameter {error}") from error
        try:
            check_format(self.export_format)
        except SettingsError as error:
            raise SettingsError(f"parameter export_{error}") from error
        if len(self.cameras) > 1 and self.detections_topic.startswith("/"):
            found = f"{self.detections_topic}, but there are {len(self.cameras)} cameras"
            raise SettingsError(f"parameter detections_topic is {found}; expected a name below that of each camera")
        if self.ids == PER_VIEW and self.label_map and not self.detections_topic:
            found = f"{self.label_map}, but with ids '{PER_VIEW}' masks have no classes"
            raise SettingsError(f"parameter label_map is {found}; expected it to be empty")
        if self.ids == PER_VIEW and self.class_names:
            raise SettingsError(
                f"parameter class_names gives {len(self.class_names)} names, but with ids '{PER_VIEW}' the node finds "
                "the objects and names them itself; expected it to be empty"
            )
        for name in self.cameras:
            if not _CAMERA.fullmatch(name) or self.cameras.count(name) > 1:
                found = f"parameter cameras: {name[:60]!r} is no name, or there twice"
                raise SettingsError(f"{found}; expected distinct names of letters, digits and single underscores")
        if not self.map_frame:
            raise SettingsError("parameter map_frame is empty; expected the name of a frame, such as 'map'")
        for index, flaw in enumerate(map(flaw_of_class_name, self.class_names)):
            if flaw:
                raise SettingsError(f"parameter class_names: label {index} has the name {flaw}")
        twice = sorted({name for name in self.class_names if self.class_names.count(name) > 1})
        if twice:
            raise SettingsError(f"parameter class_names: {twice[0]!r} occurs more than once; expected distinct names")
        if self.obstacle_min_height > self.obstacle_max_height:
            raise SettingsError(
                f"parameter obstacle_min_height is {self.obstacle_min_height:g}; expected at most "
                f"{self.obstacle_max_height:g}, the parameter obstacle_max_height"
            )
        if self.class_names and not self.label_map:  # Which may make more.
            try:
                class_ids(self.obstacle_classes, dict(enumerate(self.class_names)))
            except SettingsError as error:
                raise SettingsError(f"parameter obstacle_classes: {error}") from error
        if self.data_root and not Path(self.data_root).is_dir():
            raise SettingsError(f"parameter data_root: {self.data_root} is no folder; expected one that exists")

    @classmethod
    def of(cls, values: dict[str, Any]) -> Settings:
        """Build from the values of all parameters, by name."""
        similarity = Similarity.from_parameters(*_triple(values, "scene_to_map", with_scale=True))
        camera = pose_from_parameters("camera_in_base", *_triple(values, "camera_in_base"))
        plain = {f.name: values[f.name] for f in fields(cls) if f.name in values}
        for name in ("scene_path", "data_root", "label_map"):
            plain[name] = os.path.expanduser(plain[name])
        plain["rectified"] = str(plain["rectified"]).lower()  # Both true and "true", as YAML and shells have it.
        for name in ("class_names", "cameras", "obstacle_classes"):
            plain[name] = tuple(values[name] or ())
        plain["palette"] = Palette(values["palette"]) if values["palette"] else None
        if plain["ids"] == AUTO:
            plain["ids"] = PER_VIEW if plain["detections_topic"] and not plain["class_names"] else GIVEN
        tolerance = DepthTolerance(*(values[f"depth_tolerance.{part}"] for part in ("absolute", "relative")))
        return cls(**plain, scene_to_map=similarity, camera_in_base=camera, depth_tolerance=tolerance)

    @classmethod
    def read(cls, node: Node, changed: Sequence[Parameter] = ()) -> Settings:
        """Build from a node's parameters, some of them about to change."""
        values = {d.name: node.get_parameter_or(d.name, None) for d in DECLARATIONS}
        values = {name: None if parameter is None else parameter.value for name, parameter in values.items()}
        return cls.of({**values, **{p.name: p.value for p in changed if p.name in values}})


def _triple(values: dict[str, Any], name: str, with_scale: bool = False) -> list[Any]:
    parts = ["translation", "rotation"]
    return [values[f"{name}.{part}"] for part in (["scale", *parts] if with_scale else parts)]


def declare(node: Node) -> None:
    """Declare all parameters; a value from outside that has another type or is out of range is refused by rclpy."""
    for declaration in DECLARATIONS:
        # An empty list has no type of its own.
        default = Parameter.Type.STRING_ARRAY if declaration.default == [] else declaration.default
        node.declare_parameter(declaration.name, default, _descriptor(declaration))


def check(
    node: Node, changed: Sequence[Parameter], configured: bool, require_allowed: Callable[[Settings], object]
) -> SetParametersResult:
    """Decide whether a node's parameters may change, and say why not; rclpy itself refuses those of the start."""
    known = {declaration.name for declaration in DECLARATIONS}
    for parameter in changed:
        if configured and parameter.name in known - AT_ONCE:
            reason = (
                f"{parameter.name} can change only while the node is unconfigured: deactivate and clean it up first"
            )
            return SetParametersResult(successful=False, reason=reason)
    try:
        require_allowed(Settings.read(node, changed))
    except GssegError as error:
        return SetParametersResult(successful=False, reason=str(error))
    return SetParametersResult(successful=True)


def _descriptor(declaration: Declaration) -> ParameterDescriptor:
    descriptor = ParameterDescriptor(
        description=declaration.description, read_only=declaration.at_start, dynamic_typing=declaration.any_type
    )
    if declaration.low is not None and declaration.high is not None:
        if isinstance(declaration.default, int):
            limits = IntegerRange(from_value=int(declaration.low), to_value=int(declaration.high), step=0)
            descriptor.integer_range = [limits]
        else:
            descriptor.floating_point_range = [
                FloatingPointRange(from_value=float(declaration.low), to_value=float(declaration.high), step=0.0)
            ]
    return descriptor
