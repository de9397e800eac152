"""Pairing where time is set back, as by a bag that loops, and where messages are late or carry a wrong stamp."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pairing_events import MS, S, at_all, expire, pose, send

from gsseg_ros.node.pairing import Pairing, PairingSettings
from gsseg_ros.node.pose_sources import MessagePoses


def test_a_mask_out_of_order_by_less_than_a_second_is_paired_and_counted() -> None:
    pairing = Pairing(MessagePoses())
    send(pairing, at_all([5 * S, 5 * S - 999 * MS]))
    assert [p.stamp for p in pairing.take()] == [5 * S, 5 * S - 999 * MS]
    assert (pairing.out_of_order, pairing.time_jumps) == (1, 0)


def test_time_set_back_by_a_second_starts_afresh() -> None:
    pairing = Pairing(MessagePoses())
    send(pairing, at_all([5 * S, 4 * S]))
    first, second = pairing.take()
    assert (pairing.time_jumps, pairing.out_of_order) == (1, 0)
    assert (first.name, second.name) == (f"0_{5 * S}", f"1_{4 * S}")


@given(st.data())
def test_a_bag_in_a_loop_is_paired_whole_each_time_under_names_of_its_own(data: st.DataObject) -> None:
    pairing = Pairing(MessagePoses())
    stamps = [1 * S + i * 100 * MS for i in range(30)]
    for _ in range(3):
        for stamp in stamps:
            send(pairing, data.draw(st.permutations(at_all([stamp]))))
    paired = pairing.take()
    assert [p.stamp for p in paired] == stamps * 3
    assert len({p.name for p in paired}) == len(paired)
    assert pairing.time_jumps == 2
    assert pairing.dropped.total() == 0


def test_a_pose_from_before_time_was_set_back_is_not_used_after_it() -> None:
    pairing = Pairing(MessagePoses())
    send(pairing, [*at_all([1 * S]), *at_all([9 * S])])
    send(pairing, [("mask", 1 * S), ("info", 1 * S), ("pose", 1 * S + 1)])
    expire(pairing)
    assert pairing.dropped == {"no_pose": 1}
    assert [p.stamp for p in pairing.take()] == [1 * S, 9 * S]
    assert pairing.last_jump == (9 * S, 1 * S)


def test_a_camera_info_of_before_all_that_comes_again_serves_in_each_round_of_a_bag() -> None:
    pairing = Pairing(MessagePoses())
    send(pairing, [("info", 0)])  # Latched: it does not come again.
    for _ in range(3):
        send(pairing, [(kind, second * S) for second in (1, 9) for kind in ("pose", "mask")])
        expire(pairing)
    assert (pairing.time_jumps, pairing.dropped) == (2, {})
    assert [p.camera_info for p in pairing.take()] == ["info 0"] * 6


def test_masks_that_wait_when_time_is_set_back_are_counted() -> None:
    pairing = Pairing(MessagePoses())
    send(pairing, [("info", 9 * S), ("mask", 9 * S), ("pose", 8 * S)])
    send(pairing, [("mask", 1 * S), ("info", 1 * S), ("pose", 1 * S + 1)])
    assert pairing.dropped == {"no_pose": 1}
    assert pairing.waiting == 1


@pytest.mark.parametrize("late", [500 * MS, 1500 * MS, 5 * S])
def test_a_late_mask_is_paired_with_what_belongs_to_it_and_is_no_time_jump(late: int) -> None:
    pairing = Pairing(MessagePoses())
    stamps = [10 * S + i * 100 * MS for i in range(80)]
    missing = stamps[-1] - late
    send(pairing, [event for event in at_all(stamps) if event != ("mask", missing)])
    on_time = len(pairing.take())
    # Two late ones in a row, and a third: a segmenter with several workers.
    send(pairing, [("mask", missing), ("mask", missing + 10 * MS), ("mask", missing)])
    assert pairing.waiting == (3 if late >= S else 1)
    send(pairing, at_all([stamps[-1] + 100 * MS]))
    found = pairing.take()
    assert on_time == 79
    assert [(p.stamp, p.camera_info) for p in found] == [
        (stamp, f"info {stamp}") for stamp in (missing, stamps[-1] + 100 * MS)
    ]
    assert np.array_equal(found[0].pose, pose(missing / S))
    expire(pairing)
    assert (pairing.time_jumps, pairing.out_of_order) == (0, 2)
    assert pairing.dropped == {"repeated_stamp": 1, "no_pose": 1}


def test_a_late_mask_after_which_no_other_comes_is_paired_two_seconds_later_while_other_streams_go_on() -> None:
    pairing = Pairing(MessagePoses())
    stamps = [10 * S + i * 100 * MS for i in range(80)]
    send(pairing, [event for event in at_all(stamps) if event != ("mask", stamps[40])])
    pairing.take()
    send(pairing, [("mask", stamps[40])])
    found = []
    for i in range(25):
        send(pairing, [(kind, stamps[-1] + (i + 1) * 100 * MS) for kind in ("info", "pose")])
        pairing.expire(i / 10)
        found.append([p.stamp for p in pairing.take()])
    assert found == [[]] * 20 + [[stamps[40]]] + [[]] * 4
    assert pairing.time_jumps == 0


def test_a_second_of_silence_after_masks_that_are_behind_shows_that_time_was_set_back() -> None:
    pairing = Pairing(MessagePoses())
    send(pairing, [*at_all([8 * S, 9 * S]), ("mask", 1 * S), ("pose", 1 * S)])
    pairing.expire(5.0)
    send(pairing, [("info", 10 * S)])  # Was under way.
    for now in (5.4, 5.8, 6.2, 6.3):
        pairing.expire(now)
    assert pairing.time_jumps == 0
    pairing.expire(6.5)
    assert pairing.time_jumps == 1
    send(pairing, [("info", 1 * S)])
    assert [p.stamp for p in pairing.take()] == [8 * S, 9 * S, 1 * S]


def test_a_reset_is_seen_by_poses_alone_while_slow_masks_still_come_from_before_it() -> None:
    pairing = Pairing(MessagePoses())
    stamps = [1 * S + i * 100 * MS for i in range(80)]
    send(pairing, at_all(stamps))
    pairing.take()
    behind = [event for stamp in stamps[:10] for event in (("pose", stamp), ("mask", stamps[-1] + stamp))]
    send(pairing, behind)
    assert pairing.time_jumps == 1
    assert pairing.dropped == {"no_pose": 9, "time_jump": 1}
    send(pairing, [("mask", stamps[-1] + stamp) for stamp in stamps[10:15]])
    assert pairing.dropped == {"no_pose": 9, "time_jump": 6}
    send(pairing, [(kind, stamp) for stamp in stamps[:10] for kind in ("info", "mask")])
    assert [p.stamp for p in pairing.take()] == stamps[:10]
    assert pairing.time_jumps == 1


def test_when_the_clock_is_set_back_nothing_of_a_later_time_is_used_any_more() -> None:
    pairing = Pairing(MessagePoses())
    send(pairing, at_all([1 * S, 2 * S, 9 * S]))
    send(pairing, [("mask", 5 * S)])
    pairing.take()
    pairing.set_back(1 * S)
    send(pairing, [("mask", 9 * S + 1), ("mask", 1 * S), ("info", 1 * S)])
    assert pairing.take() == []
    send(pairing, [("pose", 1 * S)])
    assert [p.stamp for p in pairing.take()] == [1 * S]
    assert pairing.dropped == {"time_jump": 2}


@pytest.mark.parametrize("clock_first", [True, False])
def test_a_clock_and_streams_that_are_set_back_together_are_one_jump(clock_first: bool) -> None:
    pairing = Pairing(MessagePoses())
    send(pairing, at_all([8 * S, 9 * S]))
    if clock_first:
        pairing.set_back(1 * S)
    send(pairing, at_all([1 * S]))
    if not clock_first:
        pairing.set_back(1 * S)
    send(pairing, at_all([1 * S + 100 * MS]))
    assert [p.stamp for p in pairing.take()] == [8 * S, 9 * S, 1 * S, 1 * S + 100 * MS]
    assert pairing.time_jumps == 1
    assert pairing.dropped.total() == 0


@pytest.mark.parametrize("kind", ["mask", "pose", "info"])
def test_after_a_stamp_far_ahead_the_stream_is_paired_on(kind: str) -> None:
    pairing = Pairing(MessagePoses())
    send(pairing, [*at_all([9 * S]), (kind, 9000 * S)])
    later = [9 * S + i * 100 * MS for i in range(1, 100)]
    for i, stamp in enumerate(later):
        send(pairing, at_all([stamp]))
        pairing.expire(i / 10)
    assert {p.stamp for p in pairing.take()} >= set(later[40:])


def test_stragglers_from_before_time_was_set_back_are_not_a_second_jump() -> None:
    pairing = Pairing(MessagePoses())
    send(pairing, at_all([8 * S, 9 * S]))
    send(pairing, [("pose", 1 * S), ("mask", 10 * S), ("info", 10 * S), ("mask", 1 * S), ("info", 1 * S)])
    assert [p.stamp for p in pairing.take()] == [8 * S, 9 * S, 1 * S]
    assert pairing.time_jumps == 1
    assert pairing.dropped == {"no_pose": 1}


@pytest.mark.parametrize("kind", ["mask", "pose", "info"])
def test_a_single_wrong_stamp_does_not_stop_the_pairing(kind: str) -> None:
    pairing = Pairing(MessagePoses(), PairingSettings(max_waiting=5))
    send(pairing, at_all([9 * S]))
    send(pairing, [(kind, 0)])
    later = [9 * S + i * 100 * MS for i in range(1, 30)]
    send(pairing, at_all(later))
    assert {p.stamp for p in pairing.take()} >= {9 * S, *later[6:]}


def test_a_stream_that_ends_with_a_wrong_stamp_does_not_stop_the_others() -> None:
    pairing = Pairing(MessagePoses(), PairingSettings(max_waiting=5))
    send(pairing, [*at_all([9 * S]), ("info", 0)])
    later = [9 * S + i * 100 * MS for i in range(1, 30)]
    send(pairing, [(kind, stamp) for stamp in later for kind in ("mask", "pose")])
    expire(pairing)
    assert {p.stamp for p in pairing.take()} >= {9 * S, *later[6:]}


def test_a_rare_camera_info_belongs_to_each_round_of_a_loop() -> None:
    pairing = Pairing(MessagePoses())
    stamps = [1 * S + i * 100 * MS for i in range(30)]
    for _ in range(3):
        send(pairing, [("mask", stamps[0]), ("pose", stamps[0]), ("info", stamps[0])])
        send(pairing, [(kind, stamp) for stamp in stamps[1:] for kind in ("mask", "pose")])
    expire(pairing)
    assert len(pairing.take()) == 3 * len(stamps)
    assert pairing.time_jumps == 2


def test_a_slow_stream_may_come_in_late_after_time_was_set_back() -> None:
    pairing = Pairing(MessagePoses())
    send(pairing, [*at_all([9 * S]), ("mask", 1 * S), ("pose", 1 * S), ("info", 3 * S), *at_all([3 * S + 1])])
    assert {p.camera_info for p in pairing.take()} >= {f"info {3 * S + 1}"}
    send(pairing, [("pose", 3 * S), ("mask", 3 * S)])
    assert [p.camera_info for p in pairing.take()] == [f"info {3 * S}"]
