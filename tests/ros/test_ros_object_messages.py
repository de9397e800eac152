"""Objects as messages and back, and as markers."""

from __future__ import annotations

import numpy as np
import pytest
import ros_helpers  # noqa: F401
from gsseg_msgs.msg import Object, ObjectArray
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker

from gsseg_core.errors import PoseError
from gsseg_core.objects.oriented_boxes import OrientedBox
from gsseg_ros.frames import rotation_from_quaternion
from gsseg_ros.object_messages import THINNEST, box_from_object, object_markers, object_message

TURN = rotation_from_quaternion(0.1, 0.5, -0.3, 0.8)
SHAPE = TURN * [0.04, 0.02, 0.01] @ TURN.T
BOX = OrientedBox(np.array([1.0, 2.0, 3.0]), TURN, np.array([0.6, 0.4, 0.1]), np.array([1.1, 2.0, 2.9]), SHAPE)
COLOR = ColorRGBA(r=0.5, g=0.25, b=1.0, a=1.0)


def message(box: OrientedBox = BOX) -> Object:
    return object_message(7, "mug", COLOR, np.array([0.5, 1.0], np.float32), box)


def test_what_is_written_is_read_again() -> None:
    thing = message()
    assert (thing.id, thing.name, thing.num_gaussians, thing.confidence) == (7, "mug", 2, 0.75)
    found = box_from_object(thing)
    for name in ("center", "axes", "size", "mean", "covariance"):
        np.testing.assert_allclose(getattr(found, name), getattr(BOX, name), atol=1e-12, err_msg=name)


def test_a_box_without_a_pose_is_refused() -> None:
    with pytest.raises(PoseError, match="object 'empty': box_pose: orientation is all zeros"):
        thing = Object(name="empty")
        thing.box_pose.orientation.w = 0.0
        box_from_object(thing)


def test_a_box_without_thickness_is_still_drawn() -> None:
    flat = OrientedBox(BOX.center, TURN, np.array([0.6, 0.4, 0.0]), BOX.mean, SHAPE)
    header = Header(frame_id="map")
    clear, box, name = object_markers(ObjectArray(header=header, objects=[message(flat)])).markers
    assert (clear.action, box.action, name.action) == (Marker.DELETEALL, Marker.ADD, Marker.ADD)
    assert (box.scale.x, box.scale.y, box.scale.z) == (0.6, 0.4, THINNEST)
    assert name.text == "mug" and 0 < name.scale.z < 0.4
    assert name.pose.position.z > box_from_object(message(flat)).corners[:, 2].max()
    assert {marker.header.frame_id for marker in (clear, box, name)} == {"map"}


def test_without_objects_all_markers_are_taken_away() -> None:
    (only,) = object_markers(ObjectArray()).markers
    assert only.action == Marker.DELETEALL
