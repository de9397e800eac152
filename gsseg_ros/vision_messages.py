"""Objects as vision_msgs has them, for programs that know detectors. Imported only where vision_msgs is installed."""

from __future__ import annotations

from geometry_msgs.msg import PoseWithCovariance
from gsseg_msgs.msg import Object, ObjectArray
from std_msgs.msg import Header
from vision_msgs.msg import BoundingBox3D, Detection3D, Detection3DArray, ObjectHypothesis, ObjectHypothesisWithPose

__all__ = ["Detection3DArray", "detections_of"]


def detections_of(objects: ObjectArray) -> Detection3DArray:
    """Describe objects as detections, in the same order, frame and time.

    `class_id` is the name of the object, `id` its number, the same from one message to the next. Covariances are zeros:
    those of an `Object` say how far it reaches, not how uncertain its pose is.
    """
    return Detection3DArray(
        header=objects.header, detections=[_detection(thing, objects.header) for thing in objects.objects]
    )


def _detection(thing: Object, header: Header) -> Detection3D:
    hypothesis = ObjectHypothesis(class_id=thing.name, score=float(thing.confidence))
    result = ObjectHypothesisWithPose(hypothesis=hypothesis, pose=PoseWithCovariance(pose=thing.box_pose))
    box = BoundingBox3D(center=thing.box_pose, size=thing.box_size)
    return Detection3D(header=header, results=[result], bbox=box, id=str(thing.id))
