"""Pairing: every mask gets the pose and camera_info of its stamp, in whatever order the three arrive, or is counted."""

from __future__ import annotations

import importlib.util
import threading
from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsseg_core.errors import SettingsError
from gsseg_ros.frames import rigid
from gsseg_ros.node.pairing import ExactPoses, InterpolatedPoses, Paired, Pairing, PairingSettings

MS = 1_000_000
S = 1000 * MS
HAS_TF = importlib.util.find_spec("tf2_ros") is not None

Event = tuple[str, int]


def pose(x: float) -> np.ndarray:
    return rigid(np.eye(3), [x, 0, 0])


def send(pairing: Pairing, events: Iterable[Event]) -> None:
    """Send messages whose content tells where they come from: a pose's x is its stamp in seconds."""
    for kind, stamp in events:
        if kind == "mask":
            pairing.add_mask(stamp, f"mask {stamp}")
        elif kind == "info":
            pairing.add_camera_info(stamp, f"info {stamp}")
        else:
            pairing.add_pose(stamp, pose(stamp / S))


def at_all(stamps: Iterable[int]) -> list[Event]:
    return [(kind, stamp) for stamp in stamps for kind in ("info", "pose", "mask")]


def expire(pairing: Pairing) -> None:
    """Let all waiting time pass."""
    pairing.expire(0.0)
    pairing.expire(1000.0)


def summary(paired: Iterable[Paired]) -> set[tuple[Any, ...]]:
    return {(p.name, p.stamp, p.mask, p.camera_info, round(p.pose[0, 3] * S)) for p in paired}


@st.composite
def interleavings(draw: st.DrawFn) -> tuple[list[Event], list[Event]]:
    """Two interleavings of the same three streams, each of which keeps its own order."""
    ticks = st.lists(st.integers(0, 40), max_size=15, unique=True).map(sorted)
    streams = {kind: [1 * S + 50 * MS * tick for tick in draw(ticks)] for kind in ("mask", "info", "pose")}
    kinds = [kind for kind, stamps in streams.items() for _ in stamps]
    orders = []
    for _ in range(2):
        left = {kind: iter(stamps) for kind, stamps in streams.items()}
        orders.append([(kind, next(left[kind])) for kind in draw(st.permutations(kinds))])
    return orders[0], orders[1]


@given(interleavings(), st.booleans())
def test_any_interleaving_of_the_inputs_gives_the_same_pairs(orders: tuple[list[Event], ...], exact: bool) -> None:
    results = []
    for events in orders:
        pairing = Pairing(ExactPoses() if exact else InterpolatedPoses())
        send(pairing, events)
        expire(pairing)
        results.append((summary(pairing.take()), pairing.dropped))
        assert pairing.time_jumps == 0
        assert pairing.waiting == 0
    assert results[0] == results[1]
    stamps = {kind: {stamp for k, stamp in orders[0] if k == kind} for kind in ("mask", "info", "pose")}
    paired, dropped = results[0]
    assert len(paired) + dropped.total() == len(stamps["mask"])
    if exact:
        assert {p[1] for p in paired} == {
            stamp for stamp in stamps["mask"] & stamps["pose"] if any(i <= stamp for i in stamps["info"])
        }


def test_a_pair_holds_what_was_sent_for_its_stamp() -> None:
    pairing = Pairing(ExactPoses())
    send(pairing, at_all([1 * S, 2 * S]))
    first, second = pairing.take()
    assert (first.stamp, first.mask, first.camera_info) == (1 * S, f"mask {1 * S}", f"info {1 * S}")
    assert np.array_equal(second.pose, pose(2))
    assert first.name != second.name
    assert pairing.take() == []


def test_a_mask_gets_the_pose_of_its_own_stamp_and_never_the_latest() -> None:
    pairing = Pairing(ExactPoses())
    send(pairing, [("info", 1 * S), ("pose", 1 * S), ("mask", 1 * S + 1)])
    expire(pairing)
    assert pairing.take() == []
    assert pairing.dropped == {"no_pose": 1}


def test_a_lost_pose_costs_its_mask_alone() -> None:
    pairing = Pairing(ExactPoses())
    stamps = [1 * S + i * 100 * MS for i in range(20)]
    send(pairing, [event for event in at_all(stamps) if event != ("pose", stamps[3])])
    # A later pose by a second shows that the lost one will not come, before the mask's time is over.
    assert {p.stamp for p in pairing.take()} == set(stamps) - {stamps[3]}
    assert pairing.dropped == {"no_pose": 1}


def test_a_pose_out_of_order_still_finds_its_mask() -> None:
    pairing = Pairing(ExactPoses())
    send(pairing, [("info", 1 * S), ("mask", 1 * S), ("pose", 1 * S + 900 * MS), ("pose", 1 * S)])
    assert [p.stamp for p in pairing.take()] == [1 * S]


def test_without_its_own_camera_info_a_mask_takes_the_newest_earlier_one_once_a_later_one_is_there() -> None:
    pairing = Pairing(ExactPoses())
    send(pairing, [("info", 1 * S), ("info", 2 * S), ("pose", 3 * S), ("mask", 3 * S)])
    assert pairing.take() == []
    send(pairing, [("info", 4 * S)])
    assert [p.camera_info for p in pairing.take()] == [f"info {2 * S}"]


def test_without_a_later_camera_info_the_earlier_one_serves_when_the_time_is_over() -> None:
    pairing = Pairing(ExactPoses())
    send(pairing, [("info", 1 * S), ("pose", 3 * S), ("mask", 3 * S)])
    pairing.expire(10.0)
    pairing.expire(10.9)
    assert pairing.take() == []
    pairing.expire(11.0)
    assert [p.camera_info for p in pairing.take()] == [f"info {1 * S}"]


def test_a_lost_camera_info_is_counted_as_such() -> None:
    pairing = Pairing(ExactPoses())
    send(pairing, [("info", 4 * S), ("pose", 3 * S), ("mask", 3 * S)])
    expire(pairing)
    assert pairing.take() == []
    assert pairing.dropped == {"no_camera_info": 1}


def test_a_repeated_stamp_is_counted_and_ignored() -> None:
    pairing = Pairing(ExactPoses())
    send(pairing, [*at_all([1 * S]), ("mask", 1 * S), ("mask", 2 * S), ("mask", 2 * S)])
    assert pairing.dropped == {"repeated_stamp": 2}
    send(pairing, at_all([2 * S]))
    assert [p.stamp for p in pairing.take()] == [1 * S, 2 * S]


def test_a_mask_out_of_order_by_less_than_a_second_is_paired_and_counted() -> None:
    pairing = Pairing(ExactPoses())
    send(pairing, at_all([5 * S, 5 * S - 999 * MS]))
    assert [p.stamp for p in pairing.take()] == [5 * S, 5 * S - 999 * MS]
    assert (pairing.out_of_order, pairing.time_jumps) == (1, 0)


def test_time_set_back_by_a_second_starts_afresh() -> None:
    pairing = Pairing(ExactPoses())
    send(pairing, at_all([5 * S, 4 * S]))
    first, second = pairing.take()
    assert (pairing.time_jumps, pairing.out_of_order) == (1, 0)
    assert (first.name, second.name) == (f"0_{5 * S}", f"1_{4 * S}")


@given(st.data())
def test_a_bag_in_a_loop_is_paired_whole_each_time_under_names_of_its_own(data: st.DataObject) -> None:
    pairing = Pairing(ExactPoses())
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
    pairing = Pairing(ExactPoses())
    send(pairing, [*at_all([1 * S]), *at_all([9 * S])])
    send(pairing, [("mask", 1 * S), ("info", 1 * S), ("pose", 1 * S + 1)])
    expire(pairing)
    assert pairing.dropped == {"no_pose": 1}
    assert [p.stamp for p in pairing.take()] == [1 * S, 9 * S]
    assert pairing.last_jump == (9 * S, 1 * S)


def test_masks_that_wait_when_time_is_set_back_are_counted() -> None:
    pairing = Pairing(ExactPoses())
    send(pairing, [("info", 9 * S), ("mask", 9 * S), ("pose", 8 * S)])
    send(pairing, [("mask", 1 * S), ("info", 1 * S), ("pose", 1 * S + 1)])
    assert pairing.dropped == {"no_pose": 1}
    assert pairing.waiting == 1


@pytest.mark.parametrize("late", [500 * MS, 1500 * MS, 5 * S])
def test_a_late_mask_is_paired_with_what_belongs_to_it_and_is_no_time_jump(late: int) -> None:
    pairing = Pairing(ExactPoses())
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
    pairing = Pairing(ExactPoses())
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
    pairing = Pairing(ExactPoses())
    send(pairing, [*at_all([8 * S, 9 * S]), ("mask", 1 * S), ("pose", 1 * S)])
    pairing.expire(5.0)
    send(pairing, [("info", 10 * S)])  # Was under way.
    pairing.expire(5.9)
    pairing.expire(6.8)
    assert pairing.time_jumps == 0
    pairing.expire(6.9)
    assert pairing.time_jumps == 1
    send(pairing, [("info", 1 * S)])
    assert [p.stamp for p in pairing.take()] == [8 * S, 9 * S, 1 * S]


def test_a_reset_is_seen_by_poses_alone_while_slow_masks_still_come_from_before_it() -> None:
    pairing = Pairing(ExactPoses())
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
    pairing = Pairing(ExactPoses())
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
    pairing = Pairing(ExactPoses())
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
    pairing = Pairing(ExactPoses())
    send(pairing, [*at_all([9 * S]), (kind, 9000 * S)])
    later = [9 * S + i * 100 * MS for i in range(1, 100)]
    for i, stamp in enumerate(later):
        send(pairing, at_all([stamp]))
        pairing.expire(i / 10)
    assert {p.stamp for p in pairing.take()} >= set(later[40:])


class CameraPoses(ExactPoses):
    """Poses of cameras by frame_id, as TF has them: a pose's x is that of `ExactPoses`, its y tells the camera."""

    knows_frames = True

    def at(self, stamp: int, frame_id: str = "") -> np.ndarray | None:
        found = super().at(stamp)
        return None if found is None else rigid(np.eye(3), [found[0, 3], len(frame_id), 0])


@settings(max_examples=30, deadline=None)
@given(st.data())
def test_masks_of_synchronised_cameras_get_the_camera_info_and_the_pose_of_their_own(data: st.DataObject) -> None:
    pairing = Pairing(CameraPoses())
    stamps, cameras = [1 * S + i * 100 * MS for i in range(5)], ("left", "right")
    sent = [(kind, camera) for kind in ("mask", "info") for camera in cameras] + [("pose", "")]
    for stamp in stamps:
        for kind, camera in data.draw(st.permutations(sent)):
            if kind == "pose":
                pairing.add_pose(stamp, pose(stamp / S))
            else:
                add = pairing.add_mask if kind == "mask" else pairing.add_camera_info
                add(stamp, (camera, stamp), camera)
    pairing.add_mask(stamps[3], ("left", stamps[3]), "left")
    pairing.add_mask(stamps[-1] + 1, "to go on", "left")
    found = [paired for paired in pairing.take() if paired.stamp in stamps]
    assert {p.mask for p in found} == {(camera, stamp) for camera in cameras for stamp in stamps}
    assert len(found) == 10 == len({p.name for p in found})
    for p in found:
        camera, stamp = p.mask
        assert p.camera_info == (camera, stamp)
        assert np.allclose(p.pose[:2, 3], [stamp / S, len(camera)])
    assert pairing.dropped == {"repeated_stamp": 1}


def test_masks_of_one_stamp_and_several_cameras_are_refused_where_poses_do_not_say_whose_they_are() -> None:
    pairing = Pairing(ExactPoses())
    for frame in ("left", "right"):
        pairing.add_camera_info(1 * S, "info", frame)
        pairing.add_mask(1 * S, "mask", frame)
        pairing.add_mask(1 * S + 1, "mask", "left")
    send(pairing, [("pose", 1 * S), ("pose", 1 * S + 1)])
    assert pairing.take() == []
    assert pairing.dropped == {"several_cameras": 3, "repeated_stamp": 1}
    pairing.add_mask(11 * S, "mask", "left")
    pairing.add_camera_info(11 * S, "info", "left")
    send(pairing, [("pose", 11 * S)])
    assert [p.stamp for p in pairing.take()] == [11 * S]


@pytest.mark.parametrize(("mask", "info", "paired"), [("", "left", 1), ("left", "", 1), ("left", "right", 0)])
def test_a_camera_info_of_another_camera_is_not_used_but_a_frame_may_be_left_out(
    mask: str, info: str, paired: int
) -> None:
    pairing = Pairing(ExactPoses())
    pairing.add_camera_info(1 * S, "info", info)
    pairing.add_mask(1 * S, "mask", mask)
    send(pairing, [("pose", 1 * S)])
    expire(pairing)
    assert len(pairing.take()) == paired
    if not paired:
        assert pairing.dropped == {"no_camera_info": 1}
        assert (pairing.unmatched_frame, pairing.camera_frames) == ("left", ["right"])


def test_stragglers_from_before_time_was_set_back_are_not_a_second_jump() -> None:
    pairing = Pairing(ExactPoses())
    send(pairing, at_all([8 * S, 9 * S]))
    send(pairing, [("pose", 1 * S), ("mask", 10 * S), ("info", 10 * S), ("mask", 1 * S), ("info", 1 * S)])
    assert [p.stamp for p in pairing.take()] == [8 * S, 9 * S, 1 * S]
    assert pairing.time_jumps == 1
    assert pairing.dropped == {"no_pose": 1}


@pytest.mark.parametrize("kind", ["mask", "pose", "info"])
def test_a_single_wrong_stamp_does_not_stop_the_pairing(kind: str) -> None:
    pairing = Pairing(ExactPoses(), PairingSettings(max_waiting=5))
    send(pairing, at_all([9 * S]))
    send(pairing, [(kind, 0)])
    later = [9 * S + i * 100 * MS for i in range(1, 30)]
    send(pairing, at_all(later))
    assert {p.stamp for p in pairing.take()} >= {9 * S, *later[6:]}


def test_a_stream_that_ends_with_a_wrong_stamp_does_not_stop_the_others() -> None:
    pairing = Pairing(ExactPoses(), PairingSettings(max_waiting=5))
    send(pairing, [*at_all([9 * S]), ("info", 0)])
    later = [9 * S + i * 100 * MS for i in range(1, 30)]
    send(pairing, [(kind, stamp) for stamp in later for kind in ("mask", "pose")])
    expire(pairing)
    assert {p.stamp for p in pairing.take()} >= {9 * S, *later[6:]}


def test_a_rare_camera_info_belongs_to_each_round_of_a_loop() -> None:
    pairing = Pairing(ExactPoses())
    stamps = [1 * S + i * 100 * MS for i in range(30)]
    for _ in range(3):
        send(pairing, [("mask", stamps[0]), ("pose", stamps[0]), ("info", stamps[0])])
        send(pairing, [(kind, stamp) for stamp in stamps[1:] for kind in ("mask", "pose")])
    expire(pairing)
    assert len(pairing.take()) == 3 * len(stamps)
    assert pairing.time_jumps == 2


def test_a_slow_stream_may_come_in_late_after_time_was_set_back() -> None:
    pairing = Pairing(ExactPoses())
    send(pairing, [*at_all([9 * S]), ("mask", 1 * S), ("pose", 1 * S), ("info", 3 * S), *at_all([3 * S + 1])])
    assert {p.camera_info for p in pairing.take()} >= {f"info {3 * S + 1}"}
    send(pairing, [("pose", 3 * S), ("mask", 3 * S)])
    assert [p.camera_info for p in pairing.take()] == [f"info {3 * S}"]


def test_when_too_many_masks_wait_the_oldest_goes_and_is_counted() -> None:
    pairing = Pairing(ExactPoses(), PairingSettings(max_waiting=3))
    send(pairing, [("info", 1 * S)] + [("mask", 1 * S + i) for i in range(5)])
    assert pairing.waiting == 3
    assert pairing.dropped == {"no_pose": 2}
    send(pairing, [("pose", 1 * S + i) for i in range(5)] + [("info", 2 * S)])
    assert [p.stamp for p in pairing.take()] == [1 * S + i for i in (2, 3, 4)]


def test_memory_stays_bounded_whatever_comes_alone() -> None:
    for kind in ("mask", "info", "pose"):
        pairing = Pairing(ExactPoses())
        send(pairing, [(kind, 1 * S + i * MS) for i in range(5000)])
        for i in range(5000):
            pairing.add_mask(9 * S + i // 50, "mask", f"camera {i}")
            pairing.add_camera_info(1 * S, "info", f"camera {i}")
            pairing.add_pose(1 * S, pose(0))
        infos = [history.values for history in pairing._camera_infos.values()]
        seen = list(pairing._seen.values.values())
        kept = [pairing._waiting, pairing._poses._poses.values, pairing._timeline._held, *infos, *seen]
        assert 0 < sum(map(len, kept)) <= 5000


def test_of_two_threads_each_mask_is_paired_once() -> None:
    pairing = Pairing(ExactPoses())
    stamps = [1 * S + i * MS for i in range(1000)]
    send(pairing, [("pose", stamp) for stamp in stamps] + [("info", 0), ("info", 9 * S)])
    halves = (stamps[::2], stamps[1::2])
    threads = [threading.Thread(target=send, args=(pairing, [("mask", s) for s in half])) for half in halves]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(p.stamp for p in pairing.take()) == stamps


def test_interpolated_poses_lie_between_their_neighbours() -> None:
    poses = InterpolatedPoses(max_gap_s=0.2)
    for stamp in (1000 * MS, 1100 * MS):
        poses.add(stamp, pose(stamp / S))
    between = poses.at(1025 * MS)
    assert between is not None
    assert np.allclose(between, pose(1.025), atol=1e-12)
    assert np.array_equal(poses.at(1100 * MS), pose(1.1))


@pytest.mark.parametrize("stamp", [999 * MS, 1301 * MS, 1200 * MS])
def test_poses_are_neither_extrapolated_nor_interpolated_over_a_gap(stamp: int) -> None:
    poses = InterpolatedPoses(max_gap_s=0.2)
    for known in (1000 * MS, 1099 * MS, 1300 * MS):
        poses.add(known, pose(known / S))
    assert poses.at(stamp) is None


@pytest.mark.skipif(HAS_TF, reason="tf2_ros is here")
def test_without_tf2_ros_the_error_names_the_parameter_and_the_package() -> None:
    pytest.importorskip("geometry_msgs")
    from gsseg_ros.node.tf_poses import TfPoses

    with pytest.raises(SettingsError, match=r"pose_source is 'tf'.*tf2_ros.*ros-jazzy-tf2-ros-py"):
        TfPoses(None, "map")


@pytest.mark.skipif(not HAS_TF, reason="tf2_ros is not here")
def test_tf_poses_are_looked_up_at_the_stamp_and_never_the_latest() -> None:
    rclpy = pytest.importorskip("rclpy")
    from geometry_msgs.msg import TransformStamped

    from gsseg_ros.conversions import stamp_message
    from gsseg_ros.node.tf_poses import TfPoses

    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node("tf_poses_test", context=context)
    try:
        poses = TfPoses(node, "map")
        for stamp in (1 * S, 2 * S):
            transform = TransformStamped(child_frame_id="camera")
            transform.header.frame_id, transform.header.stamp = "map", stamp_message(stamp)
            transform.transform.translation.x = stamp / S
            poses._buffer.set_transform(transform, "test")
        found = poses.at(1500 * MS, "camera")
        assert found is not None
        assert np.allclose(found, pose(1.5))
        for stamp, frame in ((3 * S, "camera"), (0, "camera"), (1 * S, ""), (1 * S, "no_such_frame")):
            assert poses.at(stamp, frame) is None
            assert poses.problem
        poses.clear()
        assert poses.at(1500 * MS, "camera") is None
        poses.close()
    finally:
        node.destroy_node()
        rclpy.shutdown(context=context)
