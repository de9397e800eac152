"""Objects with their boxes as messages: for planners, and as markers for people."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from builtin_interfaces.msg import Duration
from geometry_msgs.msg import Point, Pose, Vector3
from gsseg_msgs.msg import Object, ObjectArray
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from gsseg_core.objects.oriented_boxes import OrientedBox
from gsseg_core.scene.camera import rigid_motion
from gsseg_ros.conversions import array_from_point, matrix_from_pose, pose_from_matrix, xyz

BOX_ALPHA, TEXT_SHARE, TEXT_RANGE = 0.35, 0.3, (0.03, 0.3)
"""How opaque a marker's box is; height of its name as a share of the box's middle side, and within which bounds [m]."""

THINNEST = 1e-3
"""Side of a marker's box in metres, at least: RViz draws no box that has none."""


def object_message(
    class_id: int,
    name: str,
    color: ColorRGBA,
    confidence: npt.NDArray[np.float32],  # (M,)
    box: OrientedBox,  # in the map
) -> Object:
    """Describe one object of M Gaussians."""
    return Object(
        id=class_id,
        name=name,
        color=color,
        num_gaussians=len(confidence),
        confidence=float(confidence.mean(dtype=np.float64)),
        box_pose=pose_from_matrix(rigid_motion(box.axes, box.center)),
        box_size=Vector3(**xyz(box.size)),
        center=point_message(box.mean),
        covariance=box.covariance.ravel(),
    )


def color_message(
    color: npt.NDArray[np.uint8],  # (3,)
) -> ColorRGBA:
    """Turn a colour of a palette into an opaque one."""
    red, green, blue = (float(part) / 255 for part in color)
    return ColorRGBA(r=red, g=green, b=blue, a=1.0)


def point_message(
    values: npt.NDArray[np.floating[Any]],  # (3,)
) -> Point:
    """Turn an array (3,) into a point."""
    return Point(**xyz(values))


def box_from_object(message: Object) -> OrientedBox:
    """Read the box of an object, in the frame and the metres of the message. Raises `PoseError`: its pose is none."""
    matrix = matrix_from_pose(message.box_pose, f"object '{message.name}': box_pose")
    size, center = array_from_point(message.box_size), array_from_point(message.center)
    covariance = np.array(message.covariance, np.float64).reshape(3, 3)
    return OrientedBox(matrix[:3, 3], matrix[:3, :3], size, center, covariance)


def object_markers(objects: ObjectArray) -> MarkerArray:
    """Draw the objects: a box each, with its name above it, in place of all markers before."""
    markers = [Marker(header=objects.header, action=Marker.DELETEALL)]
    for thing in objects.objects:
        color = thing.color
        size = Vector3(**{axis: max(getattr(thing.box_size, axis), THINNEST) for axis in "xyz"})
        faint = ColorRGBA(r=color.r, g=color.g, b=color.b, a=BOX_ALPHA)
        markers.append(_marker(objects, thing, "boxes", Marker.CUBE, pose=thing.box_pose, scale=size, color=faint))
        height = float(np.clip(TEXT_SHARE * thing.box_size.y, *TEXT_RANGE))
        above = _reach_up(thing) + height
        at = Point(x=thing.box_pose.position.x, y=thing.box_pose.position.y, z=thing.box_pose.position.z + above)
        label = {"pose": Pose(position=at), "scale": Vector3(z=height), "color": color, "text": thing.name}
        markers.append(_marker(objects, thing, "names", Marker.TEXT_VIEW_FACING, **label))
    return MarkerArray(markers=markers)


def _marker(objects: ObjectArray, thing: Object, namespace: str, kind: int, **fields: object) -> Marker:
    return Marker(
        header=objects.header, ns=namespace, id=thing.id, type=kind, action=Marker.ADD, lifetime=Duration(), **fields
    )


def _reach_up(thing: Object) -> float:
    """How far the box reaches along z of the map, which is up (REP 103), from its middle [m]."""
    box = box_from_object(thing)
    return float(np.abs(box.axes[2]) @ box.size / 2)
