"""Subscriptions that are as reliable as the publishers of their topic."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from ros_helpers import Ros, ros_fixture  # noqa: F401
from ros_robot import LATCHED

# isort: split
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.event_handler import UnsupportedEventTypeError
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo

from gsseg_ros.node.matched_subscription import MatchedSubscription

RELIABLE, BEST_EFFORT = ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT


def subscribed(node: Node, heard: list[Any]) -> MatchedSubscription:
    return MatchedSubscription(node, CameraInfo, "info", heard.append, MutuallyExclusiveCallbackGroup())


def asked_of(ros: Ros) -> list[ReliabilityPolicy]:
    return [info.qos_profile.reliability for info in ros.node.get_subscriptions_info_by_topic("/info")]


def test_a_subscription_is_reliable_while_all_publishers_are_and_hears_each_of_them(ros: Ros) -> None:
    heard: list[CameraInfo] = []
    subscription = subscribed(ros.node, heard)
    assert asked_of(ros) == [RELIABLE]
    publishers = []

    def hears(width: int, publisher: Any) -> bool:
        subscription.look()
        publisher.publish(CameraInfo(width=width))
        return any(message.width == width for message in heard)

    for width, reliability, asked in ((1, RELIABLE, RELIABLE), (2, BEST_EFFORT, BEST_EFFORT)):
        publisher = ros.node.create_publisher(CameraInfo, "info", QoSProfile(depth=1, reliability=reliability))
        publishers.append(publisher)
        ros.wait_until(lambda width=width, publisher=publisher: hears(width, publisher), f"publisher {width}")
        ros.wait_until(lambda asked=asked: asked_of(ros) == [asked], f"only {asked.name}")
    ros.wait_until(lambda: hears(3, publishers[0]), "the reliable one again")
    assert subscription.policies == "best effort, volatile"
    ros.node.destroy_publisher(publishers.pop())
    ros.wait_until(lambda: hears(4, publishers[0]) and subscription.policies == "reliable, volatile", "a change back")
    subscription.close()
    subscription.look()
    ros.wait_until(lambda: asked_of(ros) == [], "the end")


def test_a_latched_camera_info_of_before_is_heard_and_so_are_others_beside_it(ros: Ros) -> None:
    latched = ros.node.create_publisher(CameraInfo, "info", LATCHED)
    latched.publish(CameraInfo(width=1))
    heard: list[CameraInfo] = []
    subscription = subscribed(ros.node, heard)

    def hears(width: int) -> bool:
        subscription.look()
        return any(message.width == width for message in heard)

    ros.wait_until(lambda: hears(1), "what was published once, before")
    other = ros.node.create_publisher(CameraInfo, "info", 1)
    ros.wait_until(lambda: other.publish(CameraInfo(width=2)) or hears(2), "one that is not latched")
    ros.node.destroy_publisher(other)
    heard.clear()
    ros.wait_until(lambda: hears(1) and subscription.policies == "reliable, transient local", "a change back")
    subscription.close()


def test_where_nothing_counts_what_is_lost_it_subscribes_all_the_same(
    ros: Ros, monkeypatch: pytest.MonkeyPatch
) -> None:
    create = ros.node.create_subscription

    def without_counts(*arguments: Any, event_callbacks: Any, **options: Any) -> Any:
        if event_callbacks.message_lost is not None:
            raise UnsupportedEventTypeError
        return create(*arguments, event_callbacks=event_callbacks, **options)

    monkeypatch.setattr(ros.node, "create_subscription", without_counts)
    subscription = subscribed(ros.node, [])
    assert asked_of(ros) == [RELIABLE] and subscription.lost == 0
    subscription.close()


def test_a_publisher_that_offers_less_than_an_override_asks_for_is_complained_of(
    ros: Ros, monkeypatch: pytest.MonkeyPatch
) -> None:
    lines: list[str] = []
    monkeypatch.setattr(ros.node, "get_logger", lambda: SimpleNamespace(warning=lines.append, info=lines.append))
    declared = "qos_overrides./info.subscription.reliability"
    ros.node.declare_parameter(declared, "reliable")
    subscription = subscribed(ros.node, [])
    ros.node.create_publisher(CameraInfo, "info", QoSProfile(depth=1, reliability=BEST_EFFORT))
    ros.wait_until(lambda: lines, "a complaint")
    subscription.look()
    assert asked_of(ros) == [RELIABLE]
    assert lines == [
        "/info: the qos_overrides of this side (reliable, volatile) ask for more than a publisher offers: nothing will "
        "come from it"
    ]
    subscription.close()


def test_what_is_lost_is_counted_once_also_where_the_middleware_counts_otherwise(ros: Ros) -> None:
    subscription = subscribed(ros.node, [])
    # In these ways Fast DDS says of 1, 0, 2, 1 and 1 that they were lost.
    for change in (1, 2**31 - 1, 2, 2**31, 2**64 - 2**31):
        subscription._count_lost(SimpleNamespace(total_count_change=change))
    assert subscription.lost == 5
    subscription.close()
