"""How long masks wait for what belongs to them: as long as it may still come, within bounds of number and memory."""

from __future__ import annotations

import threading
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pairing_events import MS, S, at_all, expire, send, wait

from gsseg_ros.node.jobs import Worker
from gsseg_ros.node.pairing import Pairing, PairingSettings
from gsseg_ros.node.pose_sources import InterpolatedPoses, MessagePoses


@given(st.permutations(["mask", "info", "pose"]), st.floats(0, 4.4), st.floats(0, 4.4))
def test_whatever_stream_is_late_by_seconds_each_mask_is_paired_with_its_own(
    order: list[str], first_pause: float, second_pause: float
) -> None:
    pairing = Pairing(MessagePoses())
    stamps = [1 * S + i * 100 * MS for i in range(30)]
    for kind, pause in zip(order, (first_pause, second_pause, 0.0), strict=True):
        send(pairing, [(kind, stamp) for stamp in stamps])
        wait(pairing, pause)
    assert [(p.stamp, p.camera_info) for p in pairing.take()] == [(stamp, f"info {stamp}") for stamp in stamps]
    assert pairing.dropped.total() == 0


def test_time_in_which_the_node_stood_still_does_not_count() -> None:
    pairing = Pairing(MessagePoses())
    send(pairing, [("pose", 3 * S), ("mask", 3 * S)])
    for minute in range(10):
        pairing.expire(60.0 * minute)
    assert pairing.waiting == 1
    send(pairing, [("info", 3 * S)])
    assert [p.camera_info for p in pairing.take()] == [f"info {3 * S}"]


def test_an_earlier_camera_info_does_not_serve_while_that_of_the_mask_may_be_late() -> None:
    pairing = Pairing(MessagePoses())
    send(pairing, [*at_all([1 * S, 2 * S]), ("pose", 3 * S), ("mask", 3 * S)])
    pairing.take()
    wait(pairing, 6)
    assert pairing.take() == []
    send(pairing, [("info", 3 * S)])
    assert [p.camera_info for p in pairing.take()] == [f"info {3 * S}"]


def test_where_camera_infos_are_rare_only_the_first_mask_waits_for_long() -> None:
    pairing = Pairing(MessagePoses())
    stamps = [2 * S + i * 100 * MS for i in range(10)]
    infos = [("info", stamp) for stamp in (S // 2, 1 * S)]
    send(pairing, [*infos, *((kind, stamp) for stamp in stamps for kind in ("pose", "mask"))])
    wait(pairing, 9.9)
    assert pairing.take() == []
    wait(pairing, 0.3)
    assert [p.stamp for p in pairing.take()] == stamps
    send(pairing, [("pose", 4 * S), ("mask", 4 * S)])
    wait(pairing, 0.8)
    assert pairing.take() == []
    wait(pairing, 0.4)
    assert [p.camera_info for p in pairing.take()] == [f"info {1 * S}"]


def test_where_one_camera_info_is_all_that_has_come_no_mask_waits_for_long() -> None:
    pairing = Pairing(MessagePoses())
    send(pairing, [("info", 1 * S), ("pose", 2 * S), ("mask", 2 * S)])
    wait(pairing, 0.8)
    assert pairing.take() == []
    wait(pairing, 0.4)
    assert [p.camera_info for p in pairing.take()] == [f"info {1 * S}"]


def test_of_camera_infos_whose_stamps_are_all_zero_the_last_one_serves() -> None:
    pairing = Pairing(MessagePoses())
    for second, info in enumerate(("small", "large"), start=1):
        pairing.add_camera_info(0, info)
        send(pairing, [("pose", second * S), ("mask", second * S)])
        wait(pairing, 10.2)
        assert [p.camera_info for p in pairing.take()] == [info]


@pytest.mark.parametrize(("kind", "reason"), [("info", "no_camera_info"), ("pose", "no_pose")])
def test_a_mask_is_given_up_once_what_it_waits_for_has_gone_on_by_a_second(kind: str, reason: str) -> None:
    pairing = Pairing(MessagePoses())
    others = [event for event in at_all([5 * S]) if event[0] != kind]
    send(pairing, [*others, (kind, 6 * S - 1)])
    assert (pairing.waiting, pairing.dropped.total()) == (1, 0)
    send(pairing, [(kind, 6 * S)])
    assert (pairing.waiting, pairing.dropped) == (0, {reason: 1})


def test_a_lost_depth_image_costs_its_mask_alone_and_soon() -> None:
    image = ("depth", SimpleNamespace(data=b""))
    pairing = Pairing(MessagePoses(), PairingSettings(with_depth=True))
    for stamp in (5 * S, 6 * S - 1, 6 * S):
        send(pairing, at_all([stamp]))
        if stamp > 5 * S:
            assert pairing.dropped.total() == 0
            pairing.add_depth(stamp, image)
    assert [p.stamp for p in pairing.take()] == [6 * S - 1, 6 * S]
    assert pairing.dropped == {"no_depth": 1}


@pytest.mark.parametrize("mask_first", [True, False])
def test_a_mask_whose_pose_is_refused_goes_at_once_and_is_said_to(mask_first: bool) -> None:
    pairing = Pairing(MessagePoses())
    send(pairing, [("info", 1 * S), *[("mask", 1 * S)] * mask_first])
    pairing.refuse_pose(1 * S)
    send(pairing, [*[("mask", 1 * S)] * (not mask_first), ("mask", 2 * S)])
    assert (pairing.waiting, pairing.dropped) == (1, {"bad_pose": 1})


@pytest.mark.parametrize("poses", [MessagePoses(tolerance_s=0.2), InterpolatedPoses()])
def test_where_poses_are_interpolated_those_around_a_refused_one_serve(poses: MessagePoses) -> None:
    pairing = Pairing(poses)
    send(pairing, [("info", 1 * S), ("pose", 1 * S - 100 * MS), ("mask", 1 * S)])
    pairing.refuse_pose(1 * S)
    assert pairing.waiting == 1
    send(pairing, [("pose", 1 * S + 100 * MS)])
    assert [p.stamp for p in pairing.take()] == [1 * S]


def test_what_is_silent_is_waited_for_ten_seconds() -> None:
    pairing = Pairing(MessagePoses())
    send(pairing, [("info", 1 * S), ("mask", 1 * S)])
    wait(pairing, 9.9)
    assert pairing.waiting == 1
    expire(pairing)
    assert (pairing.waiting, pairing.dropped) == (0, {"no_pose": 1})


def test_masks_that_wait_take_no_more_memory_than_is_said_and_the_oldest_go() -> None:
    pairing = Pairing(MessagePoses())
    for i in range(100):
        pairing.add_mask(1 * S + i * MS, "mask", size=4 << 20)
    assert (pairing.waiting, pairing.waiting_bytes) == (64, 256 << 20)
    assert pairing.dropped == {"no_pose": 36}
    pairing.clear()
    pairing.add_mask(2 * S, "mask", size=1 << 30)
    assert (pairing.waiting, pairing.waiting_bytes) == (1, 1 << 30)
    pairing.add_mask(3 * S, "mask", size=1)
    assert (pairing.waiting, pairing.waiting_bytes) == (1, 1)


def test_masks_that_wait_to_be_fused_take_no_more_memory_than_is_said_and_the_oldest_go() -> None:
    begun, go_on, handled = threading.Event(), threading.Event(), []

    def handle(item: int) -> None:
        begun.set()
        go_on.wait()
        handled.append(item)

    worker = Worker(handle, 5, lambda item: item, 100)
    worker.submit(1)
    begun.wait()
    for item in (60, 30, 20, 10, 200):
        worker.submit(item)
    assert (worker.waiting, worker.dropped) == (1, 4)
    worker.submit(3)
    assert (worker.waiting, worker.dropped) == (1, 5)
    for _ in range(6):
        worker.submit(4)
    assert (worker.waiting, worker.dropped) == (5, 7)
    go_on.set()
    worker.stop()
    assert handled == [1]


def test_masks_that_wait_for_long_are_not_looked_up_with_every_message() -> None:
    class NoTransforms(MessagePoses):
        asked = 0

        def at(self, *_: object) -> None:
            self.asked += 1

    poses = NoTransforms()
    pairing = Pairing(poses)
    send(pairing, [(kind, 2 * S + i * MS) for i in range(200) for kind in ("info", "mask")])
    wait(pairing, 2)
    before = poses.asked
    send(pairing, [(kind, 3 * S + i * MS) for i in range(10) for kind in ("info", "mask")])
    assert pairing.waiting == 210 and poses.asked - before < 200
    send(pairing, [("info", 2 * S), ("mask", 4 * S)])
    assert pairing.dropped.total() == 0
