"""Subscribes to detections, of whichever type they turn out to be, and joins those that need a mask with it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, TypeAlias

from rclpy.node import Node

from gsseg_ros.conversions import stamp_ns
from gsseg_ros.node.masks.detections import ADAPTERS, Adapter, Detected
from gsseg_ros.node.pairing import MOST_BYTES

Take: TypeAlias = Callable[[str, Any], None]
"""A function that takes in the name of a topic and a message."""

_WAITING = 30  # Masks, and detections, that wait for each other.


class DetectionsInput:
    """Detections of one camera, on a topic by its full name; each goes on to `forward` once it is whole.

    `listen` subscribes to them, once their type is known, and `listen_to_mask` to the masks that belong to them. `lost`
    is told why, and in which words, one went on without its other part.
    """

    def __init__(
        self,
        node: Node,
        topic: str,
        listen: Callable[[Any, Take], Any],
        listen_to_mask: Callable[[Take], Any],
        forward: Callable[[str, Detected], None],
        lost: Callable[[str, str], None],
    ) -> None:
        self._node, self._topic, self._forward, self._lost = node, topic, forward, lost
        self._listen, self._listen_to_mask = listen, listen_to_mask
        self.adapter: Adapter | None = None
        self._lock, self._closed = threading.Lock(), False
        self._subscriptions: list[Any] = []
        self._messages: dict[int, Any] = {}
        self._masks: dict[int, tuple[str, Any]] = {}

    def clear(self) -> int:
        """Forget the masks, and the detections, that wait for each other; return how many they were."""
        with self._lock:
            forgotten = len(self._messages) + len(self._masks)
            self._messages.clear()
            self._masks.clear()
            return forgotten

    def look(self) -> str:
        """Subscribe once somebody publishes a type that is known; returns what stands in the way, or nothing."""
        with self._lock:
            return "" if self._closed or self.adapter is not None else self._look()

    def close(self) -> None:
        """Stop to listen, for good."""
        with self._lock:
            self._closed = True
            while self._subscriptions:
                self._subscriptions.pop().close()

    def _look(self) -> str:
        types = sorted({info.topic_type for info in self._node.get_publishers_info_by_topic(self._topic)})
        adapter = next((ADAPTERS[name] for name in types if name in ADAPTERS), None)
        if adapter is None:
            found = f"is of type {', '.join(types)}; expected {' or '.join(ADAPTERS)}"
            return f"{self._topic}: {found}" if types else ""
        try:
            kind = adapter.message_class
        except ImportError:
            return f"{self._topic}: is of type {adapter.type}, but {adapter.package} cannot be imported; is it sourced?"
        self.adapter = adapter
        if adapter.takes_mask:
            self._subscriptions.append(self._listen_to_mask(self.add_mask))
        self._subscriptions.append(self._listen(kind, self.add))
        return ""

    def add(self, topic: str, message: Any) -> None:
        """Take in detections."""
        if self.adapter is None:
            raise AssertionError("detections come once there is a subscription")
        if not self.adapter.takes_mask:
            self._forward(topic, Detected(message.header, self.adapter, message))
            return
        with self._lock:
            self._messages[stamp_ns(message.header.stamp)] = message
            self._join(stamp_ns(message.header.stamp))

    def add_mask(self, topic: str, message: Any) -> None:
        """Take in a mask that belongs to detections of its stamp."""
        with self._lock:
            self._masks[stamp_ns(message.header.stamp)] = (topic, message)
            self._join(stamp_ns(message.header.stamp))

    def _join(self, stamp: int) -> None:
        if self.adapter is not None and stamp in self._messages and stamp in self._masks:
            message, mask = self._messages.pop(stamp), self._masks.pop(stamp)
            self._forward(self._topic, Detected(message.header, self.adapter, message, mask))
        expected = "expected detections and mask to carry the stamp of the same image"
        while len(self._masks) > _WAITING or (len(self._masks) > 1 and self._mask_bytes() > MOST_BYTES):
            topic, _ = self._masks.pop(next(iter(self._masks)))
            self._lost("no_detections", f"{topic}: no detections with its stamp came on {self._topic}; {expected}")
        if len(self._messages) > _WAITING:
            self._messages.pop(next(iter(self._messages)))
            self._lost("no_mask", f"{self._topic}: no mask with their stamp came; {expected}")

    def _mask_bytes(self) -> int:
        return sum(len(mask.data) for _, mask in self._masks.values())
