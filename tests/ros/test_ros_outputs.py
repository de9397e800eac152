"""How the node publishes: whole runs one after the other, and without keeping other threads from their work."""

from __future__ import annotations

import gc
import os
import signal
import subprocess
import sys
import threading
import time
import weakref
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from gsseg_msgs.msg import ObjectArray, SegmentationReport
from patience import PATIENCE
from rclpy.lifecycle import LifecycleNode
from ros_fixtures import shared_fixture  # noqa: F401
from ros_helpers import Ros
from sensor_msgs.msg import Image
from small_scenes import NAMES, NUM_CLASSES, balls_on_a_table, clean_views
from std_msgs.msg import Header

from gsseg_core.export.pictures import palette
from gsseg_core.live.session import LiveSession
from gsseg_core.refine.settings import PAPER
from gsseg_ros.cloud_messages import arrays_from_cloud
from gsseg_ros.frames import Similarity
from gsseg_ros.node import outputs as outputs_module
from gsseg_ros.node.outputs import Outputs
from gsseg_ros.node.reports import Selection

SUBSCRIBER = """
import rclpy, sys
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
from gsseg_ros.qos import latched
rclpy.init()
node = Node("frozen")
node.create_subscription(PointCloud2, "/publishing/cloud", lambda message: print("heard", flush=True), latched())
rclpy.spin(node)
"""


def selection(*chosen: int) -> Selection:
    session = LiveSession(balls_on_a_table()[0], NAMES)
    for view in clean_views(2):
        session.fuse(view)
    return Selection(session, session.segmentation(PAPER), chosen, 0.0, Similarity())


def test_what_a_run_held_is_free_as_soon_as_it_ends() -> None:
    asked = selection(*range(NUM_CLASSES))
    everything = asked.of_all_classes
    header = Header()
    for k in everything.chosen:
        everything.class_cloud(k, header)
    everything.objects(header, 1)
    held = [weakref.ref(asked), weakref.ref(everything)]
    gc.disable()  # Arrays that a circle holds on to may be millions of points.
    try:
        del asked, everything
        assert [reference() for reference in held] == [None, None]
    finally:
        gc.enable()


def test_clouds_hold_their_classes_as_they_lie_in_the_map() -> None:
    similarity = Similarity.from_parameters(1.5, [0.1, -2.0, 3.0], [0.1, 0.2, 0.3, 0.9])
    some = replace(selection(0, 2, 3), similarity=similarity, min_confidence=0.6)
    result = some.result
    everywhere = similarity.points_to_map(some.scene.means)
    found = {k: arrays_from_cloud(some.class_cloud(k, Header())) for k in some.chosen}
    for k, cloud in found.items():
        members = (result.labels == k) & (result.confidence >= 0.6)
        assert members.any()
        np.testing.assert_array_equal(cloud.points, everywhere[members])
        np.testing.assert_array_equal(cloud.confidence, result.confidence[members])
        np.testing.assert_array_equal(cloud.rgb, np.tile(palette(result.num_classes)[k], (members.sum(), 1)))
        assert (cloud.labels == k).all()
    together = arrays_from_cloud(some.objects_cloud(Header()))
    for name, values in together._asdict().items():
        np.testing.assert_array_equal(values, np.concatenate([getattr(found[k], name) for k in (2, 3)]))


class Publisher:
    """In the place of one of rclpy; somebody listens who never acknowledges."""

    def __init__(self, topic: str) -> None:
        self.topic_name, self.sent, self.asked = topic, [], []  # type: ignore[var-annotated]

    def publish(self, message: Any) -> None:
        self.sent.append(message)

    def get_subscription_count(self) -> int:
        return 1

    def wait_for_all_acked(self, timeout: Any) -> bool:
        self.asked.append(timeout.nanoseconds)
        return False


def outputs() -> tuple[Outputs, dict[str, Publisher]]:
    """Outputs of no node, and the publishers that there are at present."""
    publishers: dict[str, Publisher] = {}
    node: Any = SimpleNamespace(
        create_publisher=lambda kind, topic, *_, **__: publishers.setdefault(topic, Publisher(topic)),
        destroy_publisher=lambda publisher: publishers.pop(publisher.topic_name),
    )
    return Outputs(node), publishers


def test_who_waits_for_a_cloud_to_arrive_never_holds_the_interpreter_and_ends_in_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(outputs_module, "FLOW_SECONDS", 0.1)
    ours, publishers = outputs()
    begun = time.monotonic()
    ours.publish_clouds(selection(0, 1, 2, 3), Header())
    assert time.monotonic() - begun < PATIENCE
    asked = [timeout for publisher in publishers.values() for timeout in publisher.asked]
    assert asked and set(asked) == {0}


def test_other_threads_go_on_while_a_frozen_subscriber_is_waited_for(
    shared: Ros, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(outputs_module, "FLOW_SECONDS", 60.0)
    node = LifecycleNode("publishing", context=shared.context, use_global_arguments=False)
    ours, chosen = Outputs(node), selection(1)
    command = [sys.executable, "-c", SUBSCRIBER]
    with subprocess.Popen(command, env=shared.environment, stdout=subprocess.PIPE, text=True) as child:
        try:
            ours.publish_clouds(chosen, Header())
            assert child.stdout is not None and child.stdout.readline() == "heard\n"
            child.send_signal(signal.SIGSTOP)
            os.waitid(os.P_PID, child.pid, os.WSTOPPED | os.WNOWAIT)  # all of its threads, before they acknowledge
            ticks: list[int] = []

            def tick() -> None:
                for i in range(10):
                    time.sleep(0.01)
                    ticks.append(i)
                child.send_signal(signal.SIGCONT)

            ticking = threading.Thread(target=tick)
            ticking.start()
            ours.publish_clouds(chosen, Header())
            assert len(ticks) == 10, "it is waited for until it goes on"
            ticking.join()
        finally:
            child.kill()
            ours.close()
            node.destroy_node()


def test_a_run_that_is_older_than_what_is_published_or_no_longer_holds_gets_no_turn() -> None:
    ours, _ = outputs()
    with ours.turn(2) as newest:
        assert newest
    for revision in (1, 2):
        with ours.turn(revision) as newest:
            assert not newest
    with ours.turn(3, lambda: False) as newest:
        assert not newest
    with ours.turn(3) as newest:
        assert newest


def test_two_runs_do_not_publish_at_the_same_time() -> None:
    ours, _ = outputs()
    took: list[int] = []

    def publish() -> None:
        with ours.turn(2) as newest:
            took.append(2 if newest else 0)

    with ours.turn(1):
        thread = threading.Thread(target=publish)
        thread.start()
        thread.join(0.2)
        assert thread.is_alive() and not took
    thread.join(PATIENCE)
    assert took == [2]


def test_when_all_is_emptied_the_names_are_those_of_the_classes_that_are_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outputs_module, "label_info_class", lambda: object)
    monkeypatch.setattr(outputs_module, "label_info", lambda names, header: dict(names))
    ours, publishers = outputs()
    ours.publish_clouds(selection(0, 1, 2, 3), Header())
    ours.clear(SegmentationReport(revision=1), {0: "background"})
    ours.clear(SegmentationReport(revision=2), {})  # No scene has no names, which would be no message.
    assert publishers["~/label_info"].sent == [selection().result.class_names, {0: "background"}]


def test_nothing_is_published_once_closed_and_no_topic_comes_back() -> None:
    ours, publishers = outputs()
    ours.announce(NAMES)
    before = dict(publishers)
    ours.close()
    ours.close()
    assert not publishers
    with ours.turn(1) as newest:
        assert not newest
    assert ours.publish_objects(ObjectArray()) is False
    ours.publish_overlay(Image())
    ours.publish_report(SegmentationReport())
    ours.clear(SegmentationReport(revision=2), {})
    assert not publishers and not any(publisher.sent for publisher in before.values())
    assert ours.topics(NAMES) == {}
