"""The executor of the segmentation node, where topics go while something has come of them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from rcl_interfaces.srv import GetParameters
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros_fixtures import node_fixture, parameters_fixture, root_fixture  # noqa: F401
from ros_helpers import PATIENCE, Ros, ros_fixture  # noqa: F401
from ros_robot import CLASSES, RELIABLE
from sensor_msgs.msg import PointCloud2

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


def test_topics_of_classes_which_may_be_hundreds_are_nothing_that_the_executor_looks_at(node: SegmentNode) -> None:
    assert node.trigger_configure() == TransitionCallbackReturn.SUCCESS
    topics = [publisher for publisher in node.publishers if "/classes/" in publisher.topic_name]
    assert len(topics) == len(CLASSES) and not any(publisher.event_handlers for publisher in topics)
