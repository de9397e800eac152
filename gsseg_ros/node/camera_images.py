"""Subscribes to a camera's pictures, which are large, only while its overlay has subscribers."""

from __future__ import annotations

import threading
import time
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.lifecycle import LifecycleNode
from sensor_msgs.msg import CompressedImage, Image

from gsseg_ros.conversions import stamp_ns
from gsseg_ros.node.camera_streams import CameraStreams
from gsseg_ros.node.live_outputs import LiveOutputs
from gsseg_ros.node.masks.compressed import compressed_topic
from gsseg_ros.node.matched_subscription import MatchedSubscription
from gsseg_ros.node.outputs import Outputs
from gsseg_ros.node.pairing import Pairing


class CameraImages:
    """Listens to a camera's `image`, or `image/compressed`, while its overlay has subscribers, and finds their poses.

    Pictures are paired as masks are, with poses of their own: those of masks are forgotten when the time of masks is
    set back, and these when that of the pictures is. Raises `SettingsError`: the quality of service is overridden by
    something impossible.
    """

    def __init__(
        self,
        node: LifecycleNode,
        outputs: Outputs,
        live: LiveOutputs,
        camera: CameraStreams,
        group: CallbackGroup,
        *,
        compressed: bool = False,
    ) -> None:
        self._node, self._outputs, self._live, self._group = node, outputs, live, group
        self._camera, self._kind, self._topic = camera.name, Image, camera.topic("image")
        if compressed:
            self._kind, self._topic = CompressedImage, compressed_topic(node, camera.topic("image"))
        self.pairing = Pairing(camera.poses(), stream=camera.name)
        camera.share(self.pairing)
        self._subscription: MatchedSubscription | None = None
        self._lock, self._closed = threading.Lock(), False
        self._listen(True)  # Only to have an override that cannot be used refused now, and not when somebody looks.
        self._listen(False)

    def tick(self) -> None:
        """Begin or stop to listen, and hand over what has found its pose; call it some ten times a second."""
        with self._lock:
            if self._closed:
                return
            self._listen(self._outputs.wants_overlay(self._camera))
            if self._subscription is not None:
                self._subscription.look()
        self.pairing.expire(time.monotonic())
        self._hand_over()

    def close(self) -> None:
        """Stop to listen, for good."""
        with self._lock:
            self._closed = True
            self._listen(False)

    def _listen(self, wanted: bool) -> None:
        if wanted and self._subscription is None:
            self._subscription = MatchedSubscription(self._node, self._kind, self._topic, self._arrived, self._group)
        elif not wanted and self._subscription is not None:
            self._subscription.close()
            self._subscription = None

    def _arrived(self, message: Any) -> None:
        stamp, frame_id, size = stamp_ns(message.header.stamp), message.header.frame_id, len(message.data)
        self.pairing.add_mask(stamp, (self._node.resolve_topic_name(self._topic), message), frame_id, size=size)
        self._hand_over()

    def _hand_over(self) -> None:
        for paired in self.pairing.take():
            self._live.image(paired)
