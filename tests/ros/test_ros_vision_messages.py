"""Objects as detections of vision_msgs, with stand-ins that have the fields of its definitions (4.1.1, Jazzy).

With these definitions compiled by hand, a message of `Outputs` arrived over DDS, its fields checked.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
from geometry_msgs.msg import Point, Pose, PoseWithCovariance, Vector3
from gsseg_msgs.msg import Object, ObjectArray
from ros_helpers import Context  # noqa: F401 - skips where ROS is not installed.
from std_msgs.msg import Header

from gsseg_ros.node.outputs import Outputs


@dataclass
class ObjectHypothesis:
    class_id: str
    score: float


@dataclass
class ObjectHypothesisWithPose:
    hypothesis: ObjectHypothesis
    pose: PoseWithCovariance


@dataclass
class BoundingBox3D:
    center: Pose
    size: Vector3


@dataclass
class Detection3D:
    header: Header
    results: list[ObjectHypothesisWithPose]
    bbox: BoundingBox3D
    id: str


@dataclass
class Detection3DArray:
    header: Header
    detections: list[Detection3D] = field(default_factory=list)


@pytest.fixture
def vision(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """vision_msgs is installed."""
    module = ModuleType("vision_msgs.msg")
    for kind in (ObjectHypothesis, ObjectHypothesisWithPose, BoundingBox3D, Detection3D, Detection3DArray):
        setattr(module, kind.__name__, kind)
    monkeypatch.setitem(sys.modules, "vision_msgs", ModuleType("vision_msgs"))
    monkeypatch.setitem(sys.modules, "vision_msgs.msg", module)
    yield
    sys.modules.pop("gsseg_ros.vision_messages", None)


def outputs() -> tuple[Outputs, dict[str, list[Any]]]:
    """Outputs of no node, and what they publish, by topic."""
    sent: dict[str, list[Any]] = {}

    def publisher(kind: type, topic: str, *_: Any, **__: Any) -> SimpleNamespace:
        messages = sent.setdefault(topic, [])
        return SimpleNamespace(publish=messages.append, topic_name=topic, get_subscription_count=lambda: 0)

    node: Any = SimpleNamespace(create_publisher=publisher, destroy_publisher=lambda publisher: None)
    return Outputs(node), sent


def mug() -> ObjectArray:
    pose, size = Pose(position=Point(x=1.0, y=2.0, z=0.5)), Vector3(x=0.3, y=0.2, z=0.1)
    thing = Object(id=7, name="mug", num_gaussians=9, confidence=0.75, box_pose=pose, box_size=size)
    return ObjectArray(header=Header(frame_id="map"), revision=3, objects=[thing])


def test_detections_are_published_beside_the_objects(vision: None) -> None:
    ours, sent = outputs()
    ours.publish_objects(mug())
    (objects,), (detections,) = sent["~/objects"], sent["~/detections_3d"]
    assert detections.header == objects.header
    (thing,), (found,) = objects.objects, detections.detections
    assert (found.header, found.id) == (objects.header, "7")
    assert (found.bbox.center, found.bbox.size) == (thing.box_pose, thing.box_size)
    (result,) = found.results
    assert (result.hypothesis.class_id, result.hypothesis.score) == ("mug", 0.75)
    assert result.pose.pose == thing.box_pose and not any(result.pose.covariance)


def test_no_objects_are_no_detections(vision: None) -> None:
    ours, sent = outputs()
    ours.publish_objects(ObjectArray(header=Header(frame_id="map")))
    assert sent["~/detections_3d"] == [Detection3DArray(Header(frame_id="map"))]


def test_without_vision_msgs_there_is_no_such_topic(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "vision_msgs.msg", None)  # It may be installed here.
    sys.modules.pop("gsseg_ros.vision_messages", None)
    ours, sent = outputs()
    ours.publish_objects(mug())
    assert "~/objects" in sent and "~/detections_3d" not in sent and not ours.wants_objects
