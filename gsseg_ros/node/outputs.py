"""Publishes clouds, objects, reports and overlays, each only if it is of the newest run."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from gsseg_msgs.msg import ObjectArray, SegmentationReport
from gsseg_msgs.srv import Segment
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode
from rclpy.publisher import Publisher
from sensor_msgs.msg import Image, PointCloud2
from std_msgs.msg import Header
from visualization_msgs.msg import MarkerArray

from gsseg_ros.cloud_messages import cloud
from gsseg_ros.node.masks.label_info import label_info, label_info_class
from gsseg_ros.node.reports import Selection
from gsseg_ros.object_messages import object_markers
from gsseg_ros.qos import latched, overridable_publisher
from gsseg_ros.topic_tokens import topic_tokens

InvalidHandle = rclpy_implementation.InvalidHandle

FLOW_SECONDS = 0.5
"""How long the clouds of one run wait, all together, for subscribers to take in those before."""

_POLL = 0.002  # s, between two looks at whether a cloud has arrived


class Outputs:
    """Publishes clouds, objects, report and overlay. Its methods may be called from any thread.

    A cloud that is latched always belongs to the last run, of all classes. A class has a topic while it has Gaussians
    in the last run; the names that were announced have theirs all the time. `cameras` have overlays of their own,
    `~/overlay/<camera>`. Once closed, nothing is published.
    """

    def __init__(self, node: LifecycleNode, cameras: Sequence[str] = ()) -> None:
        self._node = node
        self._lock = threading.RLock()
        self._revision, self._closed = 0, False
        self.objects_count = 0  # how often objects were published
        self.latched: Segment.Request | None = None  # what the run was asked for whose clouds are latched, if any are
        self._always: list[Publisher] = []
        self._classes: dict[str, Publisher] = {}
        self._announced: set[str] = set()
        self._filled: set[str] = set()
        self._shown: set[str] = set()  # Cameras that have an overlay latched.
        self._names: dict[int, str] = {}  # on ~/label_info
        try:
            self._cloud = self._overridable(PointCloud2, "~/cloud")
            self._report = self._overridable(SegmentationReport, "~/report")
            self._overlays = {"": self._overridable(Image, "~/overlay")}
            self._overlays |= {name: self._overridable(Image, f"~/overlay/{name}") for name in cameras}
            self._objects = self._overridable(ObjectArray, "~/objects")
            self._markers = self._overridable(MarkerArray, "~/object_markers")
            self._detections = self._vision_publisher()
            kind = label_info_class()
            self._label_info = None if kind is None else self._overridable(kind, "~/label_info")
        except Exception:
            self.close()
            raise

    def wants_overlay(self, camera: str = "") -> bool:
        """Whether anybody listens to the overlay of a camera, or to `~/overlay`."""
        return self._heard(self._overlays[camera])

    @property
    def wants_objects(self) -> bool:
        """Whether anybody listens to `~/objects`, `~/object_markers` or `~/detections_3d`."""
        detections = [self._detections[0]] if self._detections else []
        return self._heard(self._objects, self._markers, *detections)

    def announce(self, class_names: Mapping[int, str]) -> None:
        """Make a topic for every class, so that subscribers find it before its first cloud."""
        with self._lock:
            self._announced = set(topic_tokens(class_names).values())
            for token in self._announced:
                self._class(token)
            if class_names and self._label_info is not None:
                self._publish_names(class_names, Header(stamp=self._node.get_clock().now().to_msg()))

    def topics(self, class_names: Mapping[int, str]) -> dict[int, str]:
        """Full names of the topics of those classes that have one."""
        with self._lock:
            tokens = topic_tokens(class_names).items()
            return {k: self._classes[token].topic_name for k, token in tokens if token in self._classes}

    @contextmanager
    def turn(self, revision: int, holds: Callable[[], bool] = lambda: True) -> Iterator[bool]:
        """Let one run publish all that it has in the body, and no other meanwhile.

        Yields whether it may: not if a newer run has, nor once closed, nor if what it goes by no longer `holds`.
        """
        with self._lock:
            newest = not self._closed and revision > self._revision and holds()
            if newest:
                self._revision = revision
            yield newest

    def publish_clouds(self, selection: Selection, header: Header) -> None:
        """Publish one cloud per class, empty ones for those that are no more, and that of all objects."""
        tokens = topic_tokens(selection.result.class_names)
        kept = self._announced | {tokens[k] for k in selection.present}
        with self._lock:
            flow, filled = _Flow(), set()
            for k in selection.chosen:
                if tokens[k] in kept:
                    message = selection.class_cloud(k, header)
                    flow.publish(self._class(tokens[k]), message)
                    if message.width:
                        filled.add(tokens[k])
            self._empty(self._filled - {tokens[k] for k in selection.chosen if tokens[k] in kept}, header)
            self._filled = filled
            flow.publish(self._cloud, selection.objects_cloud(header))
            self._publish_names(selection.result.class_names, header)
            self._take_away(self._classes.keys() - kept, flow)

    def publish_objects(self, objects: ObjectArray, since: int | None = None) -> bool:
        """Publish the objects, and draw them for people; with `since`, only if `objects_count` is still that.

        Returns whether they were published.
        """
        with self._lock:
            if self._closed or (since is not None and since != self.objects_count):
                return False
            self.objects_count += 1
            self._objects.publish(objects)
            self._markers.publish(object_markers(objects))
            if self._detections is not None:
                publisher, detections_of = self._detections
                publisher.publish(detections_of(objects))
            return True

    def publish_report(self, report: SegmentationReport) -> None:
        """Publish the report of a run."""
        with self._lock:
            if not self._closed:
                self._report.publish(report)

    def publish_overlay(self, image: Image, wanted: Callable[[], bool] = lambda: True, camera: str = "") -> None:
        """Publish a picture of a camera, or on `~/overlay`, if it still is `wanted` when its turn has come."""
        with self._lock:
            if not self._closed and wanted():
                self._overlays[camera].publish(image)
                self._shown.add(camera)

    def clear(self, report: SegmentationReport, class_names: Mapping[int, str]) -> None:
        """Replace all that is latched: clouds, objects and overlay by empty ones, report and names by these."""
        header = report.header
        with self.turn(report.revision) as newest:
            if not newest:
                return
            self.latched = None
            self.publish_objects(ObjectArray(header=header, revision=report.revision))
            self._empty(self._filled, header)
            self._filled = set()
            self._take_away(self._classes.keys() - self._announced, _Flow())
            self._cloud.publish(_empty(header))
            for camera in self._shown:
                self._overlays[camera].publish(Image(header=header))
            self._shown.clear()
            self._publish_names(class_names, header)
            self._report.publish(report)

    def close(self) -> None:
        """Take all topics away."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            for publisher in (*self._always, *self._classes.values()):
                self._node.destroy_publisher(publisher)
            self._always.clear()
            self._classes.clear()

    def _publish_names(self, class_names: Mapping[int, str], header: Header) -> None:
        """Publish the names of the classes, where there are any, vision_msgs is installed and they are news."""
        if self._label_info is not None and class_names and dict(class_names) != self._names:
            self._names = dict(class_names)
            self._label_info.publish(label_info(class_names, header))

    def _heard(self, *publishers: Publisher) -> bool:
        # Without the lock: whoever asks must not wait for a run that is being published.
        try:
            return any(publisher.get_subscription_count() for publisher in publishers)
        except InvalidHandle:  # Closed.
            return False

    def _empty(self, tokens: Iterable[str], header: Header) -> None:
        for token in tokens:
            self._class(token).publish(_empty(header))

    def _take_away(self, tokens: Iterable[str], flow: _Flow) -> None:
        for token in list(tokens):
            publisher = self._classes.pop(token)
            flow.settle(publisher)  # Whoever listens should hear that it is empty now.
            self._node.destroy_publisher(publisher)

    def _overridable(self, kind: Any, topic: str) -> Publisher:
        self._always.append(overridable_publisher(self._node, kind, topic, latched()))
        return self._always[-1]

    def _vision_publisher(self) -> tuple[Publisher, Callable[[ObjectArray], Any]] | None:
        """Make `~/detections_3d`, and what makes its messages of objects, where vision_msgs is installed."""
        try:
            from gsseg_ros.vision_messages import Detection3DArray, detections_of
        except ImportError:
            return None
        return self._overridable(Detection3DArray, "~/detections_3d"), detections_of

    def _class(self, token: str) -> Publisher:
        if token not in self._classes:
            # Latched topics go with every subscription but one with a deadline, whose own side says so. To be told here
            # of that, the executor would look at each topic again with every callback, and there may be hundreds.
            silent = PublisherEventCallbacks(use_default_callbacks=False)
            self._classes[token] = self._node.create_publisher(
                PointCloud2, f"~/classes/{token}", latched(), event_callbacks=silent
            )
        return self._classes[token]


def _empty(header: Header) -> PointCloud2:
    nothing = np.empty((0, 3), np.float32)
    return cloud(header, nothing, nothing.astype(np.uint8), np.empty(0, np.int32), np.empty(0, np.float32))


class _Flow:
    """Publishes clouds one after the other, each once the one before has arrived.

    All at once they overflow the buffers between the two processes; what is lost there is sent again only when the
    middleware next asks for it, seconds later. A subscriber that does not answer is not waited for beyond a limit, over
    all the clouds together.
    """

    def __init__(self) -> None:
        self._patience = FLOW_SECONDS

    def publish(self, publisher: Publisher, message: PointCloud2) -> None:
        publisher.publish(message)
        if message.width:
            self.settle(publisher)

    def settle(self, publisher: Publisher) -> None:
        """Wait until all that was published there has arrived."""
        if self._patience <= 0 or not publisher.get_subscription_count():
            return
        started = time.monotonic()
        # With a time to wait, rclpy would hold the interpreter for as long.
        while not publisher.wait_for_all_acked(Duration()) and time.monotonic() - started < self._patience:
            time.sleep(_POLL)
        self._patience -= time.monotonic() - started
