"""A subscription that asks for as much as the publishers of its topic offer, and counts what is lost on the way."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial
from typing import Any

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import CallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks, UnsupportedEventTypeError
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import CameraInfo

from gsseg_ros.qos import clear_overrides, input_data

_SMALL, _SMALL_DEPTH, _DEPTH = (CameraInfo, PoseStamped, Odometry), 600, 100
"""Messages that come while the node is busy wait in the middleware: for seconds, of an odometry at 200 Hz too."""

LATCHED = "transient local"
"""How a durability is called of which one message may be all that ever comes."""

_TRANSIENT_LOCAL = DurabilityPolicy.TRANSIENT_LOCAL
_ONCE = {"CameraInfo": DurabilityPolicy.VOLATILE, "LabelInfo": _TRANSIENT_LOCAL}
"""By class of which one latched message may be all that ever comes: what is assumed while there is no publisher."""

_INT32, _UINT32 = 2**31 - 1, 2**32 - 1


class MatchedSubscription:
    """A subscription that is reliable while every publisher of its topic is, and best effort while one is not.

    What a best-effort stream loses is lost for good, and of large images that may be half; but a reliable subscription
    hears no best-effort publisher. So it is made anew when the publishers have changed. Likewise, of camera_infos, and
    of names of labels, that are all latched it gets those of before, too, and hears others while one is not. Where the
    parameter qos_overrides says how reliable it is to be, it stays so. Raises `SettingsError`: its quality of service
    is overridden by something impossible.
    """

    def __init__(
        self, node: Node, kind: Any, topic: str, callback: Callable[[Any], None], group: CallbackGroup
    ) -> None:
        self.topic_name = node.resolve_topic_name(topic)
        self.lost = 0  # messages that did not arrive, as far as the middleware knows
        self._node, self._kind, self._topic, self._callback, self._group = node, kind, topic, callback, group
        self._matches = False  # Whether nobody has said how reliable it is to be.
        self._lock, self._closed = threading.Lock(), False
        self._quality, self._subscription = self._subscribe()

    @property
    def policies(self) -> str:
        """What has to match between publisher and subscription; ends in `LATCHED` if one message may be all."""
        return f"{self._quality.reliability.short_key}, {self._quality.durability.short_key}".replace("_", " ")

    def look(self) -> None:
        """Subscribe anew if the publishers have changed; call it some ten times a second."""
        with self._lock:
            if self._closed or self._offered(self._quality) == (self._quality.reliability, self._quality.durability):
                return
            self._node.destroy_subscription(self._subscription)
            self._quality, self._subscription = self._subscribe()
        self._node.get_logger().info(
            f"{self.topic_name}: the QoS of its publishers has changed; subscribed again: {self.policies}"
        )

    def close(self) -> None:
        """Stop to listen, for good."""
        with self._lock:
            self._closed = True
            self._node.destroy_subscription(self._subscription)

    def _subscribe(self) -> tuple[QoSProfile, Any]:
        quality = input_data(_SMALL_DEPTH if self._kind in _SMALL else _DEPTH)
        # No validation, but rclpy's only word between reading the overrides and subscribing.
        overridable = QoSOverridingOptions.with_default_policies(callback=self._match)
        create = partial(
            self._node.create_subscription, self._kind, self._topic, self._callback, quality,
            callback_group=self._group, qos_overriding_options=overridable,
        )  # fmt: skip
        events = partial(SubscriptionEventCallbacks, incompatible_qos=self._complain)
        with clear_overrides(self._topic):
            try:
                return quality, create(event_callbacks=events(message_lost=self._count_lost))
            except UnsupportedEventTypeError:  # Not every middleware counts.
                return quality, create(event_callbacks=events())

    def _match(self, quality: QoSProfile) -> SetParametersResult:
        self._matches = quality.reliability == ReliabilityPolicy.BEST_AVAILABLE
        quality.reliability, quality.durability = self._offered(quality)
        return SetParametersResult(successful=True)

    def _offered(self, quality: QoSProfile) -> tuple[ReliabilityPolicy, DurabilityPolicy]:
        """Find out what all publishers offer; reliable while there is none, so that of the first nothing is lost."""
        # By the name before remapping, as rclpy remaps it here: of two exchanged topics it would find the other.
        offers = [info.qos_profile for info in self._node.get_publishers_info_by_topic(self._topic)]
        reliability = quality.reliability
        if self._matches:
            reliable = all(offer.reliability == ReliabilityPolicy.RELIABLE for offer in offers)
            reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        # Not of masks: those of before this node listened have no pose any more.
        latched = {offer.durability for offer in offers} or {_ONCE.get(self._kind.__name__)}
        once = self._kind.__name__ in _ONCE and latched == {_TRANSIENT_LOCAL}
        return reliability, _TRANSIENT_LOCAL if once else DurabilityPolicy.VOLATILE

    def _count_lost(self, event: Any) -> None:
        # Of a large message that a later one has overtaken Fast DDS says besides that 2^31 - 1 are lost.
        self.lost += (event.total_count_change & _UINT32) % _INT32

    def _complain(self, event: Any) -> None:
        if not self._matches:  # Else `look` sees to it.
            self._node.get_logger().warning(
                f"{self.topic_name}: the qos_overrides of this side ({self.policies}) ask for more than a publisher "
                "offers: nothing will come from it"
            )
