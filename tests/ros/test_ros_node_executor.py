"""The executor of the segmentation node, where topics go while something has come of them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from rcl_interfaces.srv import GetParameters
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros_fixtures import node_fixture, parameters_fixture, root_fixture  # noqa: F401
from ros_helpers import PATIENCE, Ros, ros_fixture  # noqa: F401
from ros_robot import CLASSES, RELIABLE
from sensor_msgs.msg import Image, PointCloud2

from gsseg_ros.node.node_executor import NodeExecutor
from gsseg_ros.node.segment_node import SegmentNode

BEST_EFFORT = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)


def test_a_topic_that_goes_while_somebody_asks_too_much_of_it_does_not_silence_the_parameters(
    ros: Ros, node: SegmentNode
) -> None:
    executor = NodeExecutor(node)
    publisher = node.create_publisher(PointCloud2, "cells", BEST_EFFORT)
    ros.node.create_subscription(PointCloud2, "cells", lambda _: None, RELIABLE)
    due: list[Any] = []

    def complains() -> bool:
        task, entity, _ = executor.wait_for_ready_callbacks(PATIENCE)
        if entity in publisher.event_handlers:
            due.append(task)
        else:
            task()
        return bool(due)

    ros.wait_until(complains, "the event of the publisher")
    node.destroy_publisher(publisher)
    executor._run(due[0])
    executor.shutdown()
    (parameters,) = (service for service in node.services if service.srv_type is GetParameters)
    assert parameters.callback_group.can_execute(parameters)


def test_a_topic_that_goes_while_callbacks_are_waited_for_is_no_error(
    node: SegmentNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    executor, said = NodeExecutor(node), []
    monkeypatch.setattr(executor, "_log", SimpleNamespace(error=said.append))
    publisher = node.create_publisher(PointCloud2, "cells", BEST_EFFORT)
    for handler in publisher.event_handlers:
        handler.destroy()  # As `destroy_publisher` does, in another thread.
    executor.spin_once(0.05)
    executor.shutdown()
    assert said == []


def test_a_message_for_which_there_is_too_little_memory_is_lost_and_its_callback_group_goes_on(
    ros: Ros, node: SegmentNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    executor, said, heard = NodeExecutor(node), list[str](), list[Any]()
    monkeypatch.setattr(executor, "_log", SimpleNamespace(error=said.append))
    group = MutuallyExclusiveCallbackGroup()
    subscription = node.create_subscription(Image, "mask", heard.append, RELIABLE, callback_group=group)
    beside = node.create_subscription(Image, "image", heard.append, RELIABLE, callback_group=group)
    publishers = [ros.node.create_publisher(Image, topic, RELIABLE) for topic in ("mask", "image")]
    ros.wait_until(lambda: all(publisher.get_subscription_count() for publisher in publishers), "both subscriptions")
    kind, subscription.msg_type = subscription.msg_type, SimpleNamespace  # As good as one that does not fit.

    def publish_until(condition: Any, what: str) -> None:
        for publisher in publishers:
            publisher.publish(Image())
        ros.wait_until(lambda: executor.spin_once(0.05) or condition(), what)

    publish_until(lambda: said and heard, "one message that cannot be taken in, and one that can")
    subscription.msg_type = kind
    publish_until(lambda: len(heard) == 3, "both messages of the second round")
    executor.shutdown()
    assert group.can_execute(subscription) and group.can_execute(beside)
    assert len(said) == 1 and said[0].startswith("/mask: what was received cannot be processed, and is lost: ")


def test_topics_of_classes_which_may_be_hundreds_are_nothing_that_the_executor_looks_at(node: SegmentNode) -> None:
    assert node.trigger_configure() == TransitionCallbackReturn.SUCCESS
    topics = [publisher for publisher in node.publishers if "/classes/" in publisher.topic_name]
    assert len(topics) == len(CLASSES) and not any(publisher.event_handlers for publisher in topics)
