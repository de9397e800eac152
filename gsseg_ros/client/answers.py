"""Makes results of answers: arrays and plain values in place of messages."""

from __future__ import annotations

from typing import Any

import numpy as np

from gsseg_ros.client.results import PickedObject, RenderedView, SegmentResult, seconds_of
from gsseg_ros.conversions import CloudArrays, arrays_from_cloud, labels_from_image, picture_from_image
from gsseg_ros.object_messages import box_from_object


def segment_result(answer: Any, cloud: CloudArrays) -> SegmentResult:
    """Read an answer of Segment with the cloud of its run, of which the classes that were asked for are taken."""
    report, image = answer.report, answer.label_image
    asked = np.isin(cloud.labels, [summary.class_id for summary in report.classes])
    boxes = {thing.id: box_from_object(thing) for thing in answer.objects}
    labels = labels_from_image(image, "label_image") if image.width else None
    return SegmentResult(
        cloud.points[asked], cloud.labels[asked], cloud.confidence[asked], cloud.rgb[asked], report, labels, boxes
    )


def picked_object(answer: Any) -> PickedObject:
    """Read an answer of Pick."""
    cloud, index = arrays_from_cloud(answer.cloud), np.array(answer.indices, np.int64)
    box = box_from_object(answer.object) if len(index) else None
    return PickedObject(index, cloud.points, cloud.confidence, box, seconds_of(answer.stages))


def rendered_view(answer: Any) -> RenderedView:
    """Read an answer of RenderView."""
    confidence, overlay = answer.confidence_image, answer.overlay_image
    return RenderedView(
        labels_from_image(answer.label_image, "label_image"),
        picture_from_image(confidence, "confidence_image") if confidence.width else None,
        picture_from_image(overlay, "overlay_image") if overlay.width else None,
        seconds_of(answer.stages),
    )
