"""Picks one object of the scene from a mask of one view, or from points in it, as a request has them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from gsseg_msgs.msg import Object
from gsseg_msgs.srv import Pick as PickService
from std_msgs.msg import Header

from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.data.view import View
from gsseg_core.errors import IntrinsicsError, MaskFormatError, MaskSizeError, PoseError
from gsseg_core.export.pictures import palette
from gsseg_core.objects.oriented_boxes import class_box
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_ros.camera_infos import camera_of_image, image_size
from gsseg_ros.cloud_messages import cloud
from gsseg_ros.conversions import byte_array, require_size
from gsseg_ros.errors import InvalidRequestError, TooManyPixelsError, ViewpointError
from gsseg_ros.frames import Similarity
from gsseg_ros.node.masks.reader import read_image
from gsseg_ros.node.parameters import Settings
from gsseg_ros.node.viewpoints import Lookup, viewpoint_pose
from gsseg_ros.object_messages import color_message, object_message

if TYPE_CHECKING:
    from gsseg_core.objects.pick import Pick

OBJECT = 1
"""Label of the object in the answer's cloud, and its id; 0 would be the background."""

MOST_POINTS = 1000
"""Points of one kind that a request may give."""


def pick_object(
    request: PickService.Request, scene: GaussianScene, settings: Settings, lookup: Lookup | None, *, rectified: bool
) -> Pick:
    """Pick the object of a scene that a request shows; `rectified` says what its mask and its points are of.

    Raises `InvalidRequestError`: the mask or the points cannot be used, or there are both or neither; `ViewpointError`,
    `NoTransformError`: the view cannot be used; `NoUsableViewsError`: the view does not show both the object and what
    is not it.
    """
    from gsseg_core.objects.pick import pick_clicks, pick_mask  # A node starts without the SciPy that it needs.

    inside, outside = request.inside, request.outside
    if bool(request.mask.width) == bool(inside or outside):
        raise InvalidRequestError("mask and points: found both or neither; expected a mask, or points inside")
    camera = _camera(request, settings, lookup, rectified=rectified)
    if request.mask.width:
        view = View.from_arrays(camera, _labels(request, camera, settings))
        return pick_mask(scene, view, device=settings.device)
    if camera.undistortion is not None:
        raise ViewpointError(
            "viewpoint_camera: d is of a lens that distorts; expected points in a rectified image, and zeros, or a mask"
        )
    clicks = [_pixels(points, name) for points, name in ((inside, "inside"), (outside, "outside"))]
    return pick_clicks(scene, camera, *clicks, device=settings.device)


def fill_answer(
    response: PickService.Response, picked: Pick, name: str, scene: GaussianScene, place: Similarity, header: Header
) -> None:
    """Fill in indices, cloud and object of what was picked of a scene that has a place in the map."""
    index = picked.ids
    confidence, color = picked.membership[index], palette(OBJECT + 1)[OBJECT]
    points, rgb = place.points_to_map(scene.means[index]), np.tile(color, (len(index), 1))
    response.indices = byte_array(index.astype(np.uint32), kind="I")
    response.cloud = cloud(header, points, rgb, np.full(len(index), OBJECT), confidence)
    response.object = Object(name=name or "object")
    if len(index):
        box = place.box_to_map(class_box(scene, index, confidence))
        response.object = object_message(OBJECT, name or "object", color_message(color), confidence, box)


def _camera(request: PickService.Request, settings: Settings, lookup: Lookup | None, *, rectified: bool) -> Camera:
    """Make the scene's camera of the view, of the size of the mask if there is one."""
    info, mask = request.viewpoint_camera, request.mask
    try:
        for message, what in ((info, "viewpoint_camera"), (mask, "mask")):
            require_size(message, settings.max_pixels, what)
        size = image_size(info, "viewpoint_camera")
        size = (mask.width, mask.height) if mask.width else size
        pose = settings.scene_to_map.world_to_camera(viewpoint_pose(request, settings, lookup))
        return camera_of_image("viewpoint", info, size, pose, "mask", "viewpoint_camera", rectified=rectified)
    except (PoseError, IntrinsicsError, MaskSizeError, TooManyPixelsError) as error:
        raise ViewpointError(str(error)) from error


def _labels(request: PickService.Request, camera: Camera, settings: Settings) -> npt.NDArray[np.int32]:
    """Read the mask of a request as labels of the object (1), of what is not it (0), and of pixels not spoken of."""
    from gsseg_core.objects.pick import object_mask

    try:
        seen = read_image(request.mask, "mask", settings)
        labels = object_mask(seen.named(), request.label or None, "mask")
    except MaskFormatError as error:
        raise InvalidRequestError(str(error)) from error
    return labels if camera.undistortion is None else camera.undistortion.sample(labels, UNKNOWN)


def _pixels(points: Any, name: str) -> list[tuple[int, int]]:
    """Row and column of the pixels that points lie in."""
    if len(points) > MOST_POINTS or not all(math.isfinite(point.x) and math.isfinite(point.y) for point in points):
        raise InvalidRequestError(f"{name}: found {len(points)} points; expected {MOST_POINTS} at most, all finite")
    return [(math.floor(point.y), math.floor(point.x)) for point in points]
