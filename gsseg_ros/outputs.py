"""Everything that the node publishes, but for diagnostics."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from gsseg_msgs.msg import ObjectArray, SegmentationReport
from rclpy.duration import Duration
from rclpy.lifecycle import LifecycleNode
from rclpy.publisher import Publisher
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import Image, PointCloud2
from std_msgs.msg import Header
from visualization_msgs.msg import MarkerArray

from gsseg_ros.conversions import cloud, topic_tokens
from gsseg_ros.object_messages import object_markers
from gsseg_ros.qos import clear_overrides, latched
from gsseg_ros.reports import Selection

FLOW_SECONDS = 0.5
"""How long the clouds of one run wait, all together, for subscribers to take in those before."""


class Outputs:
    """Publishes clouds, objects, report and overlay.

    A cloud that is latched always belongs to the last run: a class that this run was not asked for, or that is no more,
    gets an empty one.

    Attributes
    ----------
    objects_count : int
        How often objects were published.
    """

    def __init__(self, node: LifecycleNode) -> None:
        self._node = node
        self._lock = threading.Lock()
        self.objects_count = 0
        self._always: list[Publisher] = []
        self._classes: dict[str, Publisher] = {}
        self._filled: set[str] = set()
        try:
            self._cloud = self._overridable(PointCloud2, "~/cloud")
            self._report = self._overridable(SegmentationReport, "~/report")
            self._overlay = self._overridable(Image, "~/overlay")
            self._objects = self._overridable(ObjectArray, "~/objects")
            self._markers = self._overridable(MarkerArray, "~/object_markers")
        except Exception:
            self.close()
            raise

    @property
    def wants_overlay(self) -> bool:
        """Whether anybody listens to `~/overlay`."""
        return self._overlay.get_subscription_count() > 0

    @property
    def wants_objects(self) -> bool:
        """Whether anybody listens to `~/objects` or `~/object_markers`."""
        return max(self._objects.get_subscription_count(), self._markers.get_subscription_count()) > 0

    def announce(self, class_names: Mapping[int, str]) -> dict[int, str]:
        """Make a topic for every class, so that subscribers find it before its first cloud; return their full names."""
        with self._lock:
            return {k: self._class(token).topic_name for k, token in topic_tokens(class_names).items()}

    def publish_clouds(self, selection: Selection, header: Header) -> None:
        """Publish one cloud per class that was asked for, empty ones for all others, and that of all objects."""
        tokens = topic_tokens(selection.result.class_names)
        with self._lock:
            flow, filled = _Flow(), set()
            for k in selection.chosen:
                message = selection.class_cloud(k, header)
                flow.publish(self._class(tokens[k]), message)
                if message.width:
                    filled.add(tokens[k])
            for token in self._filled - {tokens[k] for k in selection.chosen}:
                flow.publish(self._class(token), _empty(header))
            self._filled = filled
            flow.publish(self._cloud, selection.objects_cloud(header))

    def publish_objects(self, objects: ObjectArray, since: int | None = None) -> bool:
        """Publish the objects, and draw them for people; with `since`, only if `objects_count` is still that.

        Returns whether they were published.
        """
        with self._lock:
            if since is not None and since != self.objects_count:
                return False
            self.objects_count += 1
            self._objects.publish(objects)
            self._markers.publish(object_markers(objects))
            return True

    def publish_report(self, report: SegmentationReport) -> None:
        """Publish the report of a run."""
        self._report.publish(report)

    def publish_overlay(self, image: Image) -> None:
        """Publish a picture."""
        self._overlay.publish(image)

    def clear(self, header: Header) -> None:
        """Replace all latched clouds by empty ones, and say that there is no object."""
        self.publish_objects(ObjectArray(header=header))
        with self._lock:
            for token in self._filled:
                self._class(token).publish(_empty(header))
            self._filled = set()
            self._cloud.publish(_empty(header))

    def close(self) -> None:
        """Take all topics away."""
        with self._lock:
            for publisher in (*self._always, *self._classes.values()):
                self._node.destroy_publisher(publisher)
            self._always.clear()
            self._classes.clear()

    def _overridable(self, kind: Any, topic: str) -> Publisher:
        overridable = QoSOverridingOptions.with_default_policies()
        with clear_overrides(topic):
            self._always.append(self._node.create_publisher(kind, topic, latched(), qos_overriding_options=overridable))
        return self._always[-1]

    def _class(self, token: str) -> Publisher:
        if token not in self._classes:
            self._classes[token] = self._node.create_publisher(PointCloud2, f"~/classes/{token}", latched())
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
        if self._patience > 0 and message.width and publisher.get_subscription_count():
            started = time.monotonic()
            publisher.wait_for_all_acked(Duration(seconds=self._patience))
            self._patience -= time.monotonic() - started
