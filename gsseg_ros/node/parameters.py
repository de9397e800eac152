"""The settings that come of the parameters of `segment_node`, and what of them may be changed when."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rcl_interfaces.msg import SetParametersResult
from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.validate_topic_name import validate_topic_name

from gsseg_core.data.class_names import class_ids, flaw_of_class_name
from gsseg_core.data.label_images import PER_VIEW
from gsseg_core.errors import GssegError, SettingsError
from gsseg_core.raster.backends import rasteriser_of
from gsseg_core.raster.depth_gating import DepthTolerance
from gsseg_core.scene.scene_writers import check_format
from gsseg_core.text import one_line
from gsseg_ros.camera_infos import AUTO, RECTIFIED
from gsseg_ros.frames import Similarity, pose_from_parameters
from gsseg_ros.node.declarations import AT_ONCE, DECLARATIONS, OBJECTS, POSE_SOURCES
from gsseg_ros.node.masks.compressed import TRANSPORTS
from gsseg_ros.node.masks.palette import Palette

GIVEN = "given"
IDS = (AUTO, GIVEN, PER_VIEW)
_CHOICES = {
    "pose_source": POSE_SOURCES, "ids": IDS, "rectified": RECTIFIED, "mask_transport": TRANSPORTS,
    "image_transport": TRANSPORTS,
}  # fmt: skip
_CAMERA = re.compile(r"[A-Za-z](_?[A-Za-z0-9])*")  # Such that it may be part of the name of a topic.


@dataclass(frozen=True, eq=False)
class Settings:
    """The parameters as the node uses them; see `gsseg_ros.node.declarations`.

    Raises `SettingsError`: a value is impossible; the message names the parameter.
    """

    scene_path: str
    data_root: str
    max_pixels: int
    class_names: tuple[str, ...]
    ids: str
    granularity: float
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
        self._check_meaning_of_masks()
        self._check_cameras_and_frames()
        self._check_classes()
        if self.data_root and not Path(self.data_root).is_dir():
            raise SettingsError(f"parameter data_root: {self.data_root} is not a folder; expected one that exists")

    def _check_meaning_of_masks(self) -> None:
        if self.cameras and self.detections_topic.startswith("/"):
            found = f"{self.detections_topic}, but there are cameras"
            raise SettingsError(f"parameter detections_topic is {found}; expected a name below that of each camera")
        try:
            validate_topic_name(self.detections_topic or "none")
        except InvalidTopicNameException as error:
            raise SettingsError(f"parameter detections_topic: {one_line(str(error))}") from error
        if self.ids == PER_VIEW and self.label_map and not self.detections_topic:
            found = f"{self.label_map}, but with ids '{PER_VIEW}' masks have no classes"
            raise SettingsError(f"parameter label_map is {found}; expected it to be empty")
        if self.ids != PER_VIEW and self.granularity >= 0:
            found = f"{self.granularity:g}, but with ids '{self.ids}' objects have no parts"
            raise SettingsError(f"parameter granularity is {found}; expected {OBJECTS:g}")
        if self.ids == PER_VIEW and self.class_names:
            raise SettingsError(
                f"parameter class_names gives {len(self.class_names)} names, but with ids '{PER_VIEW}' the node finds "
                "the objects and names them itself; expected it to be empty"
            )

    def _check_cameras_and_frames(self) -> None:
        for name in self.cameras:
            if not _CAMERA.fullmatch(name) or self.cameras.count(name) > 1:
                found = f"parameter cameras: {name[:60]!r} is no name, or there twice"
                raise SettingsError(f"{found}; expected distinct names of letters, digits and single underscores")
        if not self.map_frame:
            raise SettingsError("parameter map_frame is empty; expected the name of a frame, such as 'map'")
        for name in ("map_frame", "scene_frame"):
            if (frame := getattr(self, name)).startswith("/"):
                raise SettingsError(f"parameter {name} is '{frame}'; expected no slash before it, as TF takes none")
        if self.scene_frame == self.map_frame:
            raise SettingsError(f"parameter scene_frame is '{self.scene_frame}', as map_frame; expected another name")

    def _check_classes(self) -> None:
        for index, flaw in enumerate(map(flaw_of_class_name, self.class_names)):
            if flaw:
                raise SettingsError(f"parameter class_names: label {index} has the name {flaw}")
        twice = sorted(name for name, count in Counter(self.class_names).items() if count > 1)
        if twice:
            raise SettingsError(f"parameter class_names: {twice[0]!r} occurs more than once; expected distinct names")
        if self.obstacle_min_height > self.obstacle_max_height:
            raise SettingsError(
                f"parameter obstacle_min_height is {self.obstacle_min_height:g}; expected at most "
                f"{self.obstacle_max_height:g}, the parameter obstacle_max_height"
            )
        if self.class_names and not self.label_map:  # Which may make more.
            class_ids(self.obstacle_classes, dict(enumerate(self.class_names)), "parameter obstacle_classes")

    @classmethod
    def of(cls, values: dict[str, Any]) -> Settings:
        """Build from the values of all parameters, by name."""
        for one in DECLARATIONS:
            if values[one.name] is None and one.default != []:  # To ROS an empty list has no type, and so fits any.
                raise SettingsError(f"parameter {one.name} is an empty list; expected a value such as {one.default!r}")
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


def with_typed_lists(changed: Sequence[Parameter]) -> list[Parameter]:
    """Give empty lists the type of their parameter: `ros2 param set` sends them as lists of truth values."""
    lists = {declaration.name for declaration in DECLARATIONS if declaration.default == []}
    kind = Parameter.Type.STRING_ARRAY
    return [Parameter(p.name, kind, []) if p.name in lists and p.value == [] else p for p in changed]


def check(
    node: Node, changed: Sequence[Parameter], configured: bool, require_allowed: Callable[[Settings], object]
) -> SetParametersResult:
    """Decide whether a node's parameters may change, and say why not; rclpy itself refuses those of the start."""
    known = {declaration.name for declaration in DECLARATIONS}
    if known.isdisjoint(parameter.name for parameter in changed):  # Those of ROS itself, as of qualities of service.
        return SetParametersResult(successful=True)
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
