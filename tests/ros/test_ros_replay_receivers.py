"""Replayed messages wait for who is busy, within bounds."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import cast

import pytest
import ros_helpers  # noqa: F401 - skips this file where ROS is not installed

from gsseg_ros.replay import replay_node
from gsseg_ros.replay.replay_node import ReplayNode, Stopped, Topic


class Frozen:
    """A publisher whose subscriber takes nothing in, until it is thawed."""

    topic_name = "/mask"

    def __init__(self) -> None:
        self.on_the_way: list[int] = []
        self.most = 0

    def publish(self, message: int) -> None:
        self.on_the_way.append(message)
        self.most = max(self.most, len(self.on_the_way))

    def thaw(self, _: float = 0) -> None:
        self.on_the_way.clear()

    def wait_for_all_acked(self, _: object) -> bool:
        return not self.on_the_way


def test_it_stays_until_a_busy_subscriber_has_everything() -> None:
    publisher, waits = Frozen(), list(range(50))

    def wait(deadline: float) -> None:
        waits.pop()
        if not waits:
            publisher.thaw()

    topic = Topic(publisher, wait, pytest.fail)
    topic.publish(0)
    ReplayNode.linger(cast(ReplayNode, SimpleNamespace(_topics={"mask": topic})))
    assert not waits and not publisher.on_the_way


def test_it_publishes_no_more_than_is_kept_for_a_subscriber_that_is_busy() -> None:
    publisher = Frozen()
    topic = Topic(publisher, publisher.thaw, pytest.fail)
    for message in range(1000):
        topic.publish(message)
    assert (topic.published, publisher.most) == (1000, replay_node._QOS.depth)


def test_a_subscriber_that_hangs_does_not_keep_it_for_ever_nor_from_being_stopped(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def stopped(_: float) -> None:
        raise Stopped

    topic = Topic(Frozen(), stopped, pytest.fail)
    topic.publish(0)
    with pytest.raises(Stopped):
        topic.settle()
    monkeypatch.setattr(replay_node, "_PATIENCE_S", 0.01)
    waits: list[float] = []
    topic = Topic(Frozen(), waits.append, pytest.fail)
    for message in range(1000):
        topic.publish(message)
    topic.settle()
    assert topic.published == 1000 and waits


def test_it_says_once_what_it_waits_for_where_a_subscriber_was_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(replay_node, "_PATIENCE_S", 0.05)
    monkeypatch.setattr(replay_node, "_USUAL_S", 0.02)
    said: list[str] = []
    topic = Topic(Frozen(), lambda deadline: time.sleep(0.005), said.append)
    for message in range(1000):
        topic.publish(message)
    topic.settle()
    (line,) = said
    assert "'/mask'" in line and "killed" in line and "0.05 s" in line
