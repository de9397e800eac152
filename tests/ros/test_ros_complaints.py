"""What the node says of itself, without a node: warnings by kind, the clock's standstill, and the verdict."""

from __future__ import annotations

from collections import Counter, deque
from types import SimpleNamespace
from typing import Any

import pytest
import ros_helpers  # noqa: F401
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.clock import ROSClock
from rclpy.time import Time

from gsseg_core.live import results as live_results
from gsseg_ros.node import diagnostics
from gsseg_ros.node.complaints import KINDS, REASONS, REFUSED_POSE, Complaints
from gsseg_ros.node.frame_check import FrameCheck
from gsseg_ros.node.pairing import Pairing
from gsseg_ros.node.pose_sources import MessagePoses
from gsseg_ros.node.sim_time import SimTime, on_set_back

SECOND = 1_000_000_000


class Steady:
    """A clock that goes on when it is told to."""

    def __init__(self) -> None:
        self.seconds = 100.0

    def __call__(self) -> float:
        return self.seconds


@pytest.fixture
def steady(monkeypatch: pytest.MonkeyPatch) -> Steady:
    steady = Steady()
    monkeypatch.setattr(diagnostics, "time", SimpleNamespace(monotonic=steady))
    return steady


# Warnings


def test_two_hundred_complaints_of_one_kind_are_two_lines_and_the_second_counts_the_others(steady: Steady) -> None:
    lines: list[str] = []
    complaints = Complaints(lines.append, steady)
    for i in range(200):
        complaints.add(REFUSED_POSE, f"position is (nan, {i}, 0)")
        complaints.flush()
    assert lines == ["position is (nan, 0, 0)"]
    steady.seconds += 5
    complaints.flush()
    assert lines[1:] == ["position is (nan, 199, 0) (198 more of this kind since the last such line)"]
    steady.seconds += 5
    complaints.flush()
    complaints.add(REFUSED_POSE, "again")
    assert lines[2:] == ["again"]


def test_kinds_do_not_keep_each_other_silent_and_their_number_does_not_grow(steady: Steady) -> None:
    lines: list[str] = []
    complaints = Complaints(lines.append, steady)
    for kind in ("no_pose", "queue_full", *(f"something new {i}" for i in range(100))):
        complaints.add(kind, kind)
    assert lines == ["no_pose", "queue_full", "something new 0"]
    assert set(complaints._said) == KINDS


def test_every_reason_of_the_core_is_a_kind_of_its_own() -> None:
    assert {*live_results._REASONS.values(), "unusable"} <= set(REASONS)


# The clock


class Node:
    """A node whose /clock is what a test says; `publishers` have it."""

    def __init__(self, simulated: bool = True) -> None:
        self.clock = ROSClock()
        self.clock._set_ros_time_is_active(simulated)
        self.publishers = 0

    def get_clock(self) -> ROSClock:
        return self.clock

    def count_publishers(self, topic: str) -> int:
        return self.publishers

    def tick(self, seconds: float) -> None:
        self.clock.set_ros_time_override(Time(nanoseconds=round(seconds * SECOND)))


def test_a_clock_that_never_comes_is_a_problem_after_five_seconds(steady: Steady) -> None:
    node = Node()
    watch = SimTime(node, steady)
    steady.seconds += 4.9
    assert watch.problem() == ""
    steady.seconds += 0.1
    assert watch.problem().startswith("use_sim_time is true, but no /clock has come for 5 s, and nobody publishes it; ")
    assert watch.stamp().sec > 1e9


def test_a_clock_that_stops_is_a_problem_until_it_goes_on(steady: Steady) -> None:
    node = Node()
    node.publishers = 1
    watch = SimTime(node, steady)
    for i in range(20):
        node.tick(12.5 + 0.001 * i)
        assert watch.problem() == ""
        steady.seconds += 1
    steady.seconds += 4
    found = watch.problem()
    assert "/clock has stood still at 12.519 s for 5 s, and it has 1 publisher (is it paused?)" in found
    assert (watch.stamp().sec, watch.stamp().nanosec) == (12, 519_000_000)
    node.tick(12.6)
    assert watch.problem() == ""


def test_without_use_sim_time_the_clock_is_never_a_problem(steady: Steady) -> None:
    node = Node(simulated=False)
    watch = SimTime(node, steady)
    steady.seconds += 100
    assert watch.problem() == ""
    node.clock._set_ros_time_is_active(True)
    assert watch.problem() == ""
    steady.seconds += 5
    assert "no /clock has come for 5 s" in watch.problem()


def test_a_clock_set_back_is_heard_of_and_one_that_goes_on_is_not() -> None:
    node, heard = Node(), []
    handle = on_set_back(node, lambda *times: heard.append(times))
    for seconds in (5.0, 900.0, 899.5, 3.0, 4.0):
        node.tick(seconds)
    assert heard == [(899.5 * SECOND, 3 * SECOND)]
    handle.unregister()
    node.tick(1.0)
    assert heard == [(899.5 * SECOND, 3 * SECOND)]


# The verdict


class Hears:
    """Inputs with the counts that a test gives them, and their verdict."""

    def __init__(self, steady: Steady) -> None:
        self.pairing = SimpleNamespace(time_jumps=0, last_jump=(0, 0), out_of_order=0, waiting=0, waiting_bytes=0)
        self.pairing.unmatched_frame, self.pairing.camera_frames = "left", ["right"]
        self.pairing.negative_stamp = -1_500_000_000
        self.inputs: Any = SimpleNamespace(
            cameras={"": SimpleNamespace(name="", pairing=self.pairing, topic=lambda role: role)},
            dropped=Counter(), gated=Counter(), rejected=Counter(), accepted=0, explained={},
            worker=SimpleNamespace(dropped=0, waiting=0), arrivals={}, roles={}, tf=None,
            lost={"/mask": 7, "/pose": 0}, policies={"/mask": "best effort, volatile"},
            last_refusal=(-100.0, ""), refused_poses=0, logged=Counter(), namesakes=0,
            counted=deque([(steady.seconds, Counter())]),
        )  # fmt: skip
        self.refused_change = (-100.0, "")
        self.lines: list[str] = []
        self._complaints = Complaints(self.lines.append, steady)

    def verdict(self, clock_problem: str = "") -> tuple[bytes, str]:
        scene = type("Scene", (list,), {"path": "scene.ply"})()
        session = SimpleNamespace(
            learnt=None,
            scene=scene,
            class_names={},
            renamed=[],
            has_codes=False,
            num_fused=0,
            num_views=0,
            version=0,
            era=0,
        )
        workspace: Any = SimpleNamespace(
            active=True,
            loaded=session,
            last_job="none",
            changes=Counter(),
            frames=FrameCheck(),
            refused_change=self.refused_change,
        )
        (status,) = diagnostics.diagnostic_array("gsseg", workspace, self.inputs, Time().to_msg(), clock_problem).status
        diagnostics.complain(self._complaints, self.inputs, clock_problem)
        return status.level, status.message


@pytest.fixture
def hears(steady: Steady) -> Hears:
    return Hears(steady)


def test_the_verdict_names_the_most_frequent_reason_and_forgets_it_after_ten_seconds(
    steady: Steady, hears: Hears
) -> None:
    hears.inputs.accepted = 28
    hears.inputs.rejected.update(size_mismatch=9, mask_format=3)
    hears.inputs.explained["size_mismatch"] = "mask is 64 x 47 pixels; expected 64 x 48"
    assert hears.verdict() == (
        DiagnosticStatus.WARN,
        "12 of 40 masks of the last 10 s were refused, 9 of them as size_mismatch: mask is 64 x 47 pixels; expected "
        "64 x 48",
    )
    for _ in range(9):
        steady.seconds += 1
        hears.inputs.accepted += 1
        assert hears.verdict()[0] == DiagnosticStatus.WARN
    steady.seconds += 1
    hears.inputs.accepted += 1
    assert hears.verdict() == (DiagnosticStatus.OK, "fusing")
    assert len(hears.inputs.counted) <= 12


@pytest.mark.parametrize(
    ("accepted", "refused", "level"),
    [(99, 1, DiagnosticStatus.OK), (9, 1, DiagnosticStatus.WARN), (0, 2, DiagnosticStatus.WARN),
     (0, 3, DiagnosticStatus.ERROR), (1, 30, DiagnosticStatus.WARN)],
)  # fmt: skip
def test_the_level_says_whether_few_many_or_all_masks_are_refused(
    hears: Hears, accepted: int, refused: int, level: bytes
) -> None:
    hears.inputs.accepted = accepted
    hears.inputs.dropped["no_pose"] = refused
    assert hears.verdict()[0] == level


@pytest.mark.parametrize(
    ("reason", "said"),
    [
        ("no_pose", "no pose with their stamp came, neither in time nor late; expected mask and pose to carry the"),
        ("lost", "lost on the way to this node (/mask: best effort, volatile); expected a publisher that is reliable"),
        ("no_camera_info", r"(masks have the frame_id 'left', camera_infos have 'right': expected the same)"),
        ("repeated_stamp", "a mask with their stamp and frame_id came before; expected every image once"),
        ("several_cameras", "masks of several cameras (frame_id) carry one stamp, and their poses do not say whose"),
        ("negative_stamp", "their stamp is below 0 (-1.500 s on mask); expected the time at which the image was taken"),
        ("time_jump", "they are from before time was set back"),
        ("queue_full", "they come faster than they are fused"),
    ],
)
def test_every_way_to_lose_a_mask_is_in_the_verdict_and_in_the_log(
    steady: Steady, hears: Hears, reason: str, said: str
) -> None:
    def lose(count: int) -> None:
        hears.inputs.dropped[reason] += count

    lose(5)
    level, message = hears.verdict()
    assert level == DiagnosticStatus.ERROR
    assert (
        message.startswith(f"5 of 5 masks of the last 10 s were refused, 5 of them as {reason}: ") and said in message
    )
    for _ in range(5):
        lose(2)
        steady.seconds += 1
        hears.verdict()
    assert [line.split(" because ")[0] for line in hears.lines] == ["5 masks were dropped", "10 masks were dropped"]
    assert all(said in line for line in hears.lines)


def test_of_several_cameras_that_one_is_named_whose_masks_have_another_frame(hears: Hears) -> None:
    fine = SimpleNamespace(**vars(hears.pairing) | {"unmatched_frame": Pairing(MessagePoses()).unmatched_frame})
    fine.camera_frames = ["front"]
    front = SimpleNamespace(name="front", accepted=0, pairing=fine, topic=lambda role: f"front/{role}")
    hears.inputs.cameras = {"front": front} | hears.inputs.cameras
    hears.inputs.dropped["no_camera_info"] = 3
    assert "(masks have the frame_id 'left', camera_infos have 'right': expected the same)" in hears.verdict()[1]


def test_a_refused_change_of_the_scene_is_in_the_verdict_for_five_seconds(steady: Steady, hears: Hears) -> None:
    hears.refused_change = (steady.seconds, "topic scene_delta: its revision is 9; expected 8")
    assert hears.verdict() == (DiagnosticStatus.WARN, hears.refused_change[1])
    steady.seconds += 5
    assert hears.verdict() == (DiagnosticStatus.OK, "fusing")


def test_another_node_of_this_name_is_in_the_verdict_and_now_and_then_in_the_log(steady: Steady, hears: Hears) -> None:
    hears.inputs.namesakes = 1
    for _ in range(6):
        level, message = hears.verdict()
        steady.seconds += 1
    assert level == DiagnosticStatus.WARN and hears.lines == [message, message]
    assert message.startswith("1 other node has this node's name: a request is worked on by each, and answered by the")
    hears.inputs.namesakes = 0
    assert hears.verdict() == (DiagnosticStatus.OK, "fusing")


def test_an_input_of_which_a_latched_message_is_all_is_not_missed_once_it_came(steady: Steady, hears: Hears) -> None:
    hears.inputs.roles["/info"], hears.inputs.publishers_of = "camera_info", lambda topic: 1
    hears.inputs.arrivals["/info"] = (1, steady.seconds)
    steady.seconds += 6
    assert hears.verdict()[1].startswith("no data on /info for 6 s; 1 came before")
    hears.inputs.policies["/info"] = "reliable, transient local"
    assert hears.verdict() == (DiagnosticStatus.OK, "fusing")
    hears.inputs.arrivals["/info"] = (0, steady.seconds - 6)
    assert hears.verdict()[1].startswith("no data on /info for 6 s; it has 1 publisher")


def test_refused_poses_explain_masks_without_a_pose(steady: Steady, hears: Hears) -> None:
    hears.inputs.last_refusal = (steady.seconds, "/pose: position is (nan, 0, 0)")
    assert hears.verdict() == (DiagnosticStatus.WARN, "/pose: position is (nan, 0, 0)")
    hears.inputs.dropped["no_pose"] = 1
    assert "neither in time nor late (/pose: position is (nan, 0, 0)); expected" in hears.verdict()[1]
    hears.inputs.dropped["bad_pose"], hears.inputs.explained["bad_pose"] = 3, "/pose: position is (nan, 0, 0)"
    assert hears.verdict()[1].endswith("were refused, 3 of them as bad_pose: /pose: position is (nan, 0, 0)")


def test_time_that_was_set_back_is_logged_once(steady: Steady, hears: Hears) -> None:
    hears.pairing.time_jumps, hears.pairing.last_jump = 1, (9 * SECOND, SECOND)
    for _ in range(8):
        hears.verdict()
        steady.seconds += 1
    (line,) = hears.lines
    assert line.startswith("time was set back from 9.000 s to 1.000 s: poses, camera_infos and masks of before are")


def test_a_problem_of_the_clock_is_the_verdict_and_logged_every_five_seconds(steady: Steady, hears: Hears) -> None:
    for _ in range(11):
        assert hears.verdict("no /clock") == (DiagnosticStatus.WARN, "no /clock")
        steady.seconds += 1
    assert hears.lines == ["no /clock"] * 3
