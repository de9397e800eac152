"""Subscribes to detections, of whichever type they turn out to be, and joins those that need a mask with it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from typing import Any, TypeAlias

from rclpy.node import Node

from gsseg_ros.conversions import stamp_ns
from gsseg_ros.node.history import too_many
from gsseg_ros.node.masks import vision_detections, yolo_detections
from gsseg_ros.node.masks.detections import Adapter, Detected
from gsseg_ros.node.pairing import MOST_BYTES

ADAPTERS = {
    adapter.type: adapter
    for adapter in (
        Adapter("yolo_msgs", "DetectionArray", False, yolo_detections.named_mask),
        Adapter("vision_msgs", "Detection2DArray", True, vision_detections.named_mask),
    )
}
"""By type of message: what the parameter detections_topic takes."""

Take: TypeAlias = Callable[[str, Any], None]
"""A function that takes in the name of a topic and a message."""

_Key: TypeAlias = tuple[int, str]  # stamp and frame_id

_WAITING = 30  # Masks, and detections, that wait for each other.


class DetectionsInput:
    """Detections of one camera, on a topic by its name before remapping; each goes on to `forward` once it is whole.

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
        self._node, self._name, self._forward, self._lost = node, topic, forward, lost
        self._topic = node.resolve_topic_name(topic)
        self._listen, self._listen_to_mask = listen, listen_to_mask
        self.adapter: Adapter | None = None
        self._lock, self._closed = threading.Lock(), False
        self._subscriptions: list[Any] = []
        self._messages: dict[_Key, Any] = {}
        self._masks: dict[_Key, tuple[str, Any]] = {}
        self._frames: set[str] = set()  # of the masks, two at most

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
        types = sorted({info.topic_type for info in self._node.get_publishers_info_by_topic(self._name)})
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
            key = stamp_ns(message.header.stamp), message.header.frame_id
            self._messages[key] = message
            self._join(self._partner(key, self._masks), key)

    def add_mask(self, topic: str, message: Any) -> None:
        """Take in a mask that belongs to detections of its stamp."""
        with self._lock:
            key = stamp_ns(message.header.stamp), message.header.frame_id
            self._masks[key] = (topic, message)
            if len(self._frames) < 2:
                self._frames.add(key[1])
            self._join(key, self._partner(key, self._messages))

    def _partner(self, key: _Key, others: Iterable[_Key]) -> _Key:
        """Find what is of the same stamp and camera; of which camera, need not be said where all masks are of one."""
        same = [other for other in others if other[0] == key[0]]
        alike = [o for o in same if len(self._frames) < 2 or "" in (o[1], key[1])]
        return key if key in same else next(iter(alike), key)

    def _join(self, mask_key: _Key, key: _Key) -> None:
        if self.adapter is not None and key in self._messages and mask_key in self._masks:
            message, mask = self._messages.pop(key), self._masks.pop(mask_key)
            self._forward(self._topic, Detected(message.header, self.adapter, message, mask))
        expected = "expected detections and mask to carry the stamp of the same image"
        while too_many([len(mask.data) for _, mask in self._masks.values()], _WAITING, MOST_BYTES):
            topic, _ = self._masks.pop(next(iter(self._masks)))
            self._lost("no_detections", f"{topic}: no detections with its stamp came on {self._topic}; {expected}")
        if len(self._messages) > _WAITING:
            self._messages.pop(next(iter(self._messages)))
            self._lost("no_mask", f"{self._topic}: no mask with their stamp came; {expected}")
