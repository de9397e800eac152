"""Pairing: every mask gets the pose and camera_info of its stamp, in whatever order the three arrive, or is counted."""

from __future__ import annotations

import threading
from collections.abc import Iterable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pairing_events import MS, Event, S, at_all, expire, pose, send

from gsseg_core.scene.camera import rigid_motion
from gsseg_ros.node.pairing import Paired, Pairing, PairingSettings
from gsseg_ros.node.pose_sources import GivenPose, InterpolatedPoses, MessagePoses


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
        pairing = Pairing(MessagePoses() if exact else InterpolatedPoses())
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
    pairing = Pairing(MessagePoses())
    send(pairing, at_all([1 * S, 2 * S]))
    first, second = pairing.take()
    assert (first.stamp, first.mask, first.camera_info) == (1 * S, f"mask {1 * S}", f"info {1 * S}")
    assert np.array_equal(second.pose, pose(2))
    assert first.name != second.name
    assert pairing.take() == []


def test_a_mask_gets_the_pose_of_its_own_stamp_and_never_the_latest() -> None:
    pairing = Pairing(MessagePoses())
    send(pairing, [("info", 1 * S), ("pose", 1 * S), ("mask", 1 * S + 1)])
    expire(pairing)
    assert pairing.take() == []
    assert pairing.dropped == {"no_pose": 1}


def test_a_lost_pose_costs_its_mask_alone() -> None:
    pairing = Pairing(MessagePoses())
    stamps = [1 * S + i * 100 * MS for i in range(20)]
    send(pairing, [event for event in at_all(stamps) if event != ("pose", stamps[3])])
    # A later pose by a second shows that the lost one will not come, before the mask's time is over.
    assert {p.stamp for p in pairing.take()} == set(stamps) - {stamps[3]}
    assert pairing.dropped == {"no_pose": 1}


def test_a_pose_out_of_order_still_finds_its_mask() -> None:
    pairing = Pairing(MessagePoses())
    send(pairing, [("info", 1 * S), ("mask", 1 * S), ("pose", 1 * S + 900 * MS), ("pose", 1 * S)])
    assert [p.stamp for p in pairing.take()] == [1 * S]


def test_without_its_own_camera_info_a_mask_takes_the_newest_earlier_one_once_a_later_one_is_there() -> None:
    pairing = Pairing(MessagePoses())
    send(pairing, [("info", 1 * S), ("info", 2 * S), ("pose", 3 * S), ("mask", 3 * S)])
    assert pairing.take() == []
    send(pairing, [("info", 4 * S)])
    assert [p.camera_info for p in pairing.take()] == [f"info {2 * S}"]


def test_a_lost_camera_info_is_counted_as_such() -> None:
    pairing = Pairing(MessagePoses())
    send(pairing, [("info", 4 * S), ("pose", 3 * S), ("mask", 3 * S)])
    expire(pairing)
    assert pairing.take() == []
    assert pairing.dropped == {"no_camera_info": 1}


def test_a_repeated_stamp_is_counted_and_ignored() -> None:
    pairing = Pairing(MessagePoses())
    send(pairing, [*at_all([1 * S]), ("mask", 1 * S), ("mask", 2 * S), ("mask", 2 * S)])
    assert pairing.dropped == {"repeated_stamp": 2}
    send(pairing, at_all([2 * S]))
    assert [p.stamp for p in pairing.take()] == [1 * S, 2 * S]


class CameraPoses(MessagePoses):
    """Poses of cameras by frame_id, as TF has them: a pose's x is that of `MessagePoses`, its y tells the camera."""

    knows_frames = True

    def at(self, stamp: int, frame_id: str = "", last_chance: bool = False, several: bool = False) -> np.ndarray | None:
        found = super().at(stamp)
        return None if found is None else rigid_motion(np.eye(3), [found[0, 3], len(frame_id), 0])


def test_depth_images_of_one_stamp_go_with_the_masks_of_their_camera() -> None:
    image = SimpleNamespace(data=b"")
    pairing = Pairing(CameraPoses(), PairingSettings(with_depth=True))
    send(pairing, [("pose", S), ("pose", 2 * S)])
    for frame in ("left", "right", "rear"):
        pairing.add_camera_info(S, f"info {frame}", frame)
    for frame in ("left", "right", "left"):
        pairing.add_depth(S, (f"{frame} depth", image), frame)
    for frame in ("right", "left", "rear"):
        pairing.add_mask(S, f"{frame} mask", frame)
    paired = {p.mask: p.depth[0] for p in pairing.take()}
    assert paired == {"right mask": "right depth", "left mask": "left depth"} and pairing.waiting == 1
    expire(pairing)
    # What is wrong with a frame is said where the image is read.
    assert [(p.mask, p.depth[0]) for p in pairing.take()] == [("rear mask", "left depth")]
    pairing.add_camera_info(2 * S, "info", "left")
    pairing.add_depth(2 * S, ("any", image))
    pairing.add_mask(2 * S, "mask", "left")
    assert [p.depth[0] for p in pairing.take()] == ["any"]


@given(st.data())
def test_masks_of_synchronised_cameras_get_the_camera_info_and_the_pose_of_their_own(data: st.DataObject) -> None:
    pairing = Pairing(CameraPoses())
    stamps, cameras = [1 * S + i * 100 * MS for i in range(5)], ("left", "right")
    sent = [(kind, camera) for kind in ("mask", "info") for camera in cameras] + [("pose", "")]
    for stamp in stamps:
        for kind, camera in data.draw(st.permutations(sent)):
            if kind == "pose":
                pairing.add_pose(stamp, GivenPose(pose(stamp / S)))
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
    pairing = Pairing(MessagePoses())
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


def test_what_has_a_stamp_below_zero_is_refused_by_itself_and_sets_no_time_back() -> None:
    pairing = Pairing(MessagePoses())
    for stamp in (5 * S, 6 * S, *range(-12 * S, 0, S), 7 * S):
        pairing.add_mask(stamp, "mask", "left")
        pairing.add_camera_info(stamp, "info", "left")
        send(pairing, [("pose", stamp)])
    assert [p.stamp for p in pairing.take()] == [5 * S, 6 * S, 7 * S]
    assert pairing.dropped == {"negative_stamp": 12}
    assert (pairing.time_jumps, pairing.negative_stamp) == (0, -1 * S)


@pytest.mark.parametrize(("mask", "info", "paired"), [("", "left", 1), ("left", "", 1), ("left", "right", 0)])
def test_a_camera_info_of_another_camera_is_not_used_but_a_frame_may_be_left_out(
    mask: str, info: str, paired: int
) -> None:
    pairing = Pairing(MessagePoses())
    pairing.add_camera_info(1 * S, "info", info)
    pairing.add_mask(1 * S, "mask", mask)
    send(pairing, [("pose", 1 * S)])
    expire(pairing)
    assert len(pairing.take()) == paired
    if not paired:
        assert pairing.dropped == {"no_camera_info": 1}
        assert (pairing.unmatched_frame, pairing.camera_frames) == ("left", ["right"])


def test_when_too_many_masks_wait_the_oldest_goes_and_is_counted() -> None:
    pairing = Pairing(MessagePoses(), PairingSettings(max_waiting=3))
    send(pairing, [("info", 1 * S)] + [("mask", 1 * S + i) for i in range(5)])
    assert pairing.waiting == 3
    assert pairing.dropped == {"no_pose": 2}
    send(pairing, [("pose", 1 * S + i) for i in range(5)] + [("info", 2 * S)])
    assert [p.stamp for p in pairing.take()] == [1 * S + i for i in (2, 3, 4)]


def test_memory_stays_bounded_whatever_comes_alone() -> None:
    for kind in ("mask", "info", "pose"):
        pairing = Pairing(MessagePoses())
        send(pairing, [(kind, 1 * S + i * MS) for i in range(5000)])
        for i in range(5000):
            pairing.add_mask(9 * S + i // 50, "mask", f"camera {i}")
            pairing.add_camera_info(1 * S, "info", f"camera {i}")
            pairing.add_pose(1 * S, GivenPose(pose(0)))
        infos = [history.values for history in pairing._camera_infos.values()]
        seen = list(pairing._seen.values.values())
        kept = [pairing._waiting, pairing._poses._poses.values, pairing._timeline._held, *infos, *seen]
        assert 0 < sum(map(len, kept)) <= 5000


def test_of_two_threads_each_mask_is_paired_once() -> None:
    pairing = Pairing(MessagePoses())
    stamps = [1 * S + i * MS for i in range(1000)]
    send(pairing, [("pose", stamp) for stamp in stamps] + [("info", 0), ("info", 9 * S)])
    halves = (stamps[::2], stamps[1::2])
    threads = [threading.Thread(target=send, args=(pairing, [("mask", s) for s in half])) for half in halves]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(p.stamp for p in pairing.take()) == stamps
