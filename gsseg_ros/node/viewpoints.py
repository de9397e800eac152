"""Renders a segmentation from the viewpoint of a request."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from gsseg_core.errors import IntrinsicsError, PoseError
from gsseg_core.export.pictures import overlay, palette
from gsseg_core.export.view_pictures import background_image
from gsseg_core.raster.backends import make_operator
from gsseg_core.scene.camera import Camera
from gsseg_ros.camera_infos import camera_from_messages
from gsseg_ros.conversions import confidence_image, mask_image, matrix_from_pose, require_size, rgb_image, stamp_ns
from gsseg_ros.errors import NoTransformError, TooManyPixelsError, ViewpointError
from gsseg_ros.node.parameters import Settings
from gsseg_ros.node.reports import Selection

Lookup: TypeAlias = Callable[[str, int], "npt.NDArray[np.float64] | None"]
"""Pose (4, 4) of a frame in the map frame at a stamp in ns, 0 being the latest; None where there is none."""


@dataclass(frozen=True, eq=False)
class Drawing:
    """Pictures from a viewpoint, as messages; `overlay` is empty unless it was asked for."""

    labels: Image
    confidence: Image
    overlay: Image


def viewpoint(request: Any, settings: Settings, lookup: Lookup | None) -> Camera:
    """Make the scene's camera of the viewpoint of a request.

    Raises `ViewpointError`: pose or camera cannot be used, or it has more pixels than the parameter max_pixels allows;
    `NoTransformError`: the pose is in a frame that is not the map and cannot be looked up.
    """
    info = request.viewpoint_camera
    try:
        require_size(info, settings.max_pixels, "viewpoint_camera")
        matrix = viewpoint_pose(request, settings, lookup)
        return camera_from_messages("viewpoint", info, matrix, settings.scene_to_map, "viewpoint_camera")
    except (PoseError, IntrinsicsError, TooManyPixelsError) as error:
        raise ViewpointError(str(error)) from error


def viewpoint_pose(request: Any, settings: Settings, lookup: Lookup | None) -> npt.NDArray[np.float64]:
    """Read the pose (4, 4) of the optical frame in the map, in metres, of the viewpoint of a request.

    Raises `PoseError`: it is none; `NoTransformError`: it is in a frame that is not the map and cannot be looked up.
    """
    pose = request.viewpoint_pose
    matrix, frame = matrix_from_pose(pose.pose, "viewpoint_pose"), pose.header.frame_id
    if not frame or frame == settings.map_frame:
        return matrix
    found = lookup(frame, stamp_ns(pose.header.stamp)) if lookup is not None else None
    if found is None:
        raise NoTransformError(
            f"viewpoint_pose: frame_id is '{frame}', and there is no transform from it to '{settings.map_frame}'; "
            f"expected '{settings.map_frame}', or pose_source tf and a known frame"
        )
    return found @ matrix


def draw(selection: Selection, camera: Camera, header: Header, *, with_overlay: bool = False) -> Drawing:
    """Draw the labels of a view: classes that were not asked for as background, but in the overlay as they are."""
    operator = make_operator(selection.scene, camera, selection.session.device)
    seen = selection.result.render(operator)
    labels = np.where(np.isin(seen.labels, selection.chosen), seen.labels, 0)
    picture = Image()
    if with_overlay:
        colors = palette(selection.result.num_classes)
        picture = rgb_image(overlay(background_image(selection.scene, operator), seen.labels, colors), header)
    return Drawing(mask_image(labels, header, 16), confidence_image(np.minimum(seen.confidence, 1.0), header), picture)
