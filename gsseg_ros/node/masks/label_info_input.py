"""Subscribes to the names of a segmenter's labels, `label_info`, where vision_msgs is installed."""

from __future__ import annotations

from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.qos_overriding_options import QoSOverridingOptions

from gsseg_core.data.class_names import listed
from gsseg_ros.errors import LabelInfoError
from gsseg_ros.node.complaints import REFUSED_LABELS, Complaints
from gsseg_ros.node.masks.label_info import label_info_class, names_of
from gsseg_ros.node.masks.label_space import LabelSpace
from gsseg_ros.qos import clear_overrides, latched

TOPIC = "label_info"


class LabelInfoInput:
    """Hears names of labels. It is none of the inputs that are missed: they come once, if at all.

    Parameters
    ----------
    node : Node
        Listens.
    label_space : LabelSpace
        Gets the names.
    group : CallbackGroup
        Of the other inputs.
    complaints : Complaints
        Get what is wrong with names.
    """

    def __init__(self, node: Node, label_space: LabelSpace, group: CallbackGroup, complaints: Complaints) -> None:
        self._node, self._label_space, self._complaints = node, label_space, complaints
        self._subscription: Any = None
        if (kind := label_info_class()) is not None:
            with clear_overrides(TOPIC):
                self._subscription = node.create_subscription(
                    kind,
                    TOPIC,
                    self.on_label_info,
                    latched(),
                    callback_group=group,
                    qos_overriding_options=QoSOverridingOptions.with_default_policies(),
                )

    def on_label_info(self, message: Any) -> None:
        """Take in names."""
        topic = self._node.resolve_topic_name(TOPIC)
        try:
            names = names_of(message, topic)
        except LabelInfoError as error:
            self._complaints.add(REFUSED_LABELS, str(error))
            return
        if self._label_space.hear(names):
            self._node.get_logger().info(f"{topic}: labels are called {listed(names.values())}")

    def close(self) -> None:
        """Stop to listen."""
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
