"""States of several robots come together as if one had seen all, or are refused with one clear error."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_scenes import NAMES, balls_on_a_table, clean_views

from gsseg_core.cli.main import main
from gsseg_core.data.view import View
from gsseg_core.errors import StateFileError
from gsseg_core.learn.learner_state import State
from gsseg_core.learn.merged_states import merge_states
from gsseg_core.live import living_session
from gsseg_core.live.living_session import LivingSession
from gsseg_core.live.living_votes import LivingVotes, without_views
from gsseg_core.live.per_view_session import PerViewSession
from gsseg_core.raster.vote_total import VoteTotal
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.scene_delta import GroupMove, SceneDelta
from gsseg_core.scene.similarity import Similarity

SCENE, TRUTH = balls_on_a_table()
VIEWS = clean_views(6)


def robot(path: Path, views: list[View], scene: GaussianScene = SCENE, names: dict[int, str] | None = NAMES) -> str:
    session = LivingSession(scene, names)
    for view in views:
        assert session.fuse(view) is None
    session.save(path)
    return str(path)


def load(path: str | Path) -> LivingSession:
    session = LivingSession(SCENE, NAMES)
    session.load(path)
    return session


def test_merged_votes_are_those_of_one_robot_that_saw_all_and_every_view_is_kept(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one, other = robot(tmp_path / "a.npz", VIEWS[:4]), robot(tmp_path / "b.npz", VIEWS[3:])
    assert main(["merge", one, other, "-o", str(tmp_path / "c.npz")]) == 0
    assert "7 views of 2 states, 7 with masks" in capsys.readouterr().out
    merged = load(tmp_path / "c.npz")
    again = View.from_arrays(replace(VIEWS[3].camera, name="view3_2"), VIEWS[3].read_labels())
    whole = load(robot(tmp_path / "all.npz", [*VIEWS[:4], again, *VIEWS[4:]]))
    np.testing.assert_array_equal(merged._live._votes.dense(), whole._live._votes.dense())
    assert [view.name for view in merged.views] == ["view0", "view1", "view2", "view3", "view3_2", "view4", "view5"]
    merged._live.retract("view3_2")
    np.testing.assert_array_equal(
        merged._live._votes.dense(), load(robot(tmp_path / "six.npz", VIEWS))._live._votes.dense()
    )


def test_a_session_takes_in_what_others_saved_also_before_its_scene_changed(tmp_path: Path) -> None:
    saved = robot(tmp_path / "a.npz", VIEWS[:3])
    session = LivingSession(SCENE, NAMES)
    for view in VIEWS[3:]:
        session.fuse(view)
    session.update(SceneDelta(removed=np.arange(50)))
    assert session.merge([saved]) == 3
    assert session.num_fused == session.num_views == 6
    whole = LivingSession(session.living, NAMES)
    for view in VIEWS:
        whole.fuse(view)
    np.testing.assert_array_equal(session._live._votes.dense(), whole._live._votes.dense())


def test_states_that_do_not_belong_together_are_refused_with_one_error_and_nothing_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one, out = robot(tmp_path / "a.npz", VIEWS[:2]), tmp_path / "c.npz"
    cases = {
        robot(tmp_path / "scene.npz", VIEWS[:2], SCENE.subset(np.arange(600))): "belongs to the scene",
        robot(tmp_path / "names.npz", VIEWS[:2], names={**NAMES, 2: "vase"}): "calls class 2 'vase'; expected",
        str(tmp_path / "none.npz"): "does not exist",
    }
    for other, message in cases.items():
        assert main(["merge", one, other, "-o", str(out)]) == 2
        told = capsys.readouterr().err
        assert message in told and told.count("\n") == 1 and not out.exists()
        session = load(robot(tmp_path / "b.npz", VIEWS[2:]))
        before = session._live._votes.dense()
        with pytest.raises(Exception, match=Path(other).name):
            session.merge([one, other])
        np.testing.assert_array_equal(session._live._votes.dense(), before)


def test_a_state_that_is_given_twice_or_is_known_already_is_refused_and_a_later_one_of_the_same_robot_is_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one, later, out = robot(tmp_path / "a.npz", VIEWS[:2]), robot(tmp_path / "b.npz", VIEWS[:3]), tmp_path / "c.npz"
    again = robot(tmp_path / "again.npz", VIEWS[:2])
    for same in (one, again):
        assert main(["merge", one, later, same, "-o", str(out)]) == 2
        assert f"{same}: {one} has all its votes and views already, which would count twice" in capsys.readouterr().err
    session = load(one)
    with pytest.raises(StateFileError, match=r"again\.npz: what is known here has all its votes and views already"):
        session.merge([later, again])
    assert session.num_fused == 2 and not out.exists()


@pytest.mark.parametrize("others", [VIEWS[3:], [View.from_arrays(VIEWS[5].camera, VIEWS[0].read_labels())]])
def test_a_state_that_was_merged_already_is_refused_when_it_is_merged_again(tmp_path: Path, others: list[View]) -> None:
    """As a client does that did not wait for the answer; names of views may have been taken."""
    named = [
        View.from_arrays(replace(view.camera, name=f"view{i}"), view.read_labels()) for i, view in enumerate(others)
    ]
    state = robot(tmp_path / "b.npz", named)
    session = load(robot(tmp_path / "a.npz", VIEWS[:3]))
    assert session.merge([state]) == len(others)
    session.fuse(VIEWS[4])
    before = session._live._votes.dense()
    with pytest.raises(StateFileError, match=r"b\.npz: what is known here has all its votes and views already"):
        session.merge([state])
    np.testing.assert_array_equal(session._live._votes.dense(), before)


def test_a_robot_that_sends_its_state_again_and_again_has_each_view_counted_once(tmp_path: Path) -> None:
    session = load(robot(tmp_path / "own.npz", VIEWS[4:]))
    for count, came in ((1, 1), (3, 2), (4, 1)):
        assert session.merge([robot(tmp_path / "other.npz", VIEWS[:count])]) == came
    assert session.num_fused == session.num_views == 6
    whole = load(robot(tmp_path / "all.npz", VIEWS))
    np.testing.assert_array_equal(session._live._votes.dense(), whole._live._votes.dense())


def test_own_views_that_come_back_under_other_names_are_known(tmp_path: Path) -> None:
    own, seen_elsewhere = (
        robot(tmp_path / "own.npz", VIEWS[:2]),
        View.from_arrays(VIEWS[5].camera, VIEWS[5].read_labels()),
    )
    other = load(
        robot(tmp_path / "other.npz", [replace(seen_elsewhere, camera=replace(VIEWS[5].camera, name="view0"))])
    )
    other.merge([own])
    assert [view.name for view in other.views] == ["view0", "view0_2", "view1"]
    other.save(tmp_path / "both.npz")
    session = load(own)
    assert session.merge([tmp_path / "both.npz"]) == 1
    assert [view.name for view in session.views] == ["view0", "view1", "view0_2"]
    np.testing.assert_array_equal(session._live._votes.dense(), other._live._votes.dense())
    with pytest.raises(StateFileError, match=r"both\.npz: what is known here has all its votes and views already"):
        session.merge([tmp_path / "both.npz"])


def test_a_camera_that_stands_still_has_as_many_views_as_it_sent(tmp_path: Path) -> None:
    """Views of one pose and mask are told apart by how many there are."""
    still = [replace(VIEWS[0], camera=replace(VIEWS[0].camera, name=f"stamp{i}")) for i in range(3)]
    session = load(robot(tmp_path / "own.npz", [*VIEWS[4:], *still[:2]]))
    assert session.merge([robot(tmp_path / "other.npz", still)]) == 1
    whole = load(robot(tmp_path / "all.npz", [*VIEWS[4:], *still]))
    np.testing.assert_array_equal(session._live._votes.dense(), whole._live._votes.dense())


@pytest.mark.parametrize("soft", [False, True])
def test_masks_that_name_the_same_classes_and_say_them_otherwise_are_two_views(tmp_path: Path, soft: bool) -> None:
    camera, labels = VIEWS[0].camera, VIEWS[0].read_labels()
    unsure = (labels == np.arange(4)[:, None, None]) * np.float32(0.5)
    if soft:
        others = [View.from_probabilities(camera, unsure), View.from_probabilities(camera, unsure * 2 - unsure / 2)]
    else:
        others = [View.from_arrays(camera, labels), View.from_arrays(camera, labels, supervised=[1, 2, 3])]
    session = load(robot(tmp_path / "a.npz", [VIEWS[1], others[0]]))
    assert session.merge([robot(tmp_path / "b.npz", [others[1]])]) == 1
    again = replace(others[1], camera=replace(camera, name="view0_2"))
    whole = load(robot(tmp_path / "all.npz", [VIEWS[1], *others[:1], again]))
    np.testing.assert_array_equal(session._live._votes.dense(), whole._live._votes.dense())
    assert session.merge([robot(tmp_path / "c.npz", [*others[:1], VIEWS[2]])]) == 1


@pytest.mark.parametrize("names", [("frame_001", "frame_002"), ("view_2", "view_3"), ("", "_2"), ("7", "8")])
def test_a_camera_that_stands_still_and_counts_its_views_has_all_of_them(
    tmp_path: Path, names: tuple[str, ...]
) -> None:
    """Names may end as those do that merging gives."""
    one, two = (replace(VIEWS[0], camera=replace(VIEWS[0].camera, name=name)) for name in names)
    session = load(robot(tmp_path / "a.npz", [one]))
    assert session.merge([robot(tmp_path / "b.npz", [two])]) == 1
    assert session.merge([robot(tmp_path / "c.npz", [two, one, VIEWS[1]])]) == 1
    assert session.view_names == [*names, "view1"] and session.num_fused == 3


def test_a_view_that_got_another_name_twice_is_known_by_its_first(tmp_path: Path) -> None:
    elsewhere = [
        robot(tmp_path / f"{view.name}.npz", [replace(view, camera=replace(view.camera, name="view0"))])
        for view in VIEWS[3:]
    ]
    other = load(robot(tmp_path / "own.npz", [VIEWS[0]]))
    other.merge(elsewhere[:1])
    other.save(tmp_path / "two.npz")
    session = load(robot(tmp_path / "taken.npz", [replace(VIEWS[5], camera=replace(VIEWS[5].camera, name="view0_2"))]))
    session.merge([tmp_path / "two.npz"])
    assert [(view.name, view.former_name) for view in session.views] == [
        ("view0_2", None), ("view0", None), ("view0_2_2", "view0"),
    ]  # fmt: skip
    with pytest.raises(StateFileError, match=r"view3\.npz: what is known here has all its votes and views already"):
        session.merge(elsewhere[:1])
    assert session.merge(elsewhere[1:]) == 2


@pytest.mark.parametrize("kept", [1, 2, 200])
def test_where_all_but_a_few_views_of_a_state_are_known_only_those_are_lifted(
    tmp_path: Path, kept: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also if the robot has dropped most of them since."""
    late = LivingSession(SCENE, NAMES, max_views=kept)
    states = []
    for view in VIEWS[:4]:
        late.fuse(view)
        late.save(tmp_path / f"{view.name}.npz")
        states.append(tmp_path / f"{view.name}.npz")
    session, lifted = load(states[2]), list[tuple[str, int]]()
    lift = LivingVotes._lift

    def counted(votes: LivingVotes, view: View, sign: int) -> bool:
        lifted.append((view.name, sign))
        return lift(votes, view, sign)

    monkeypatch.setattr(LivingVotes, "_lift", counted)
    session.merge([states[3]])
    assert lifted == [("view3", 1)] and session.num_fused == late.num_fused == 4
    np.testing.assert_array_equal(session._live._votes.dense(), late._live._votes.dense())
    with pytest.raises(StateFileError, match="has all its votes and views already"):
        session.merge([states[3]])


def test_where_a_state_does_not_list_what_it_has_dropped_the_views_that_are_known_are_taken_out(tmp_path: Path) -> None:
    """As an older version did not."""
    robot_of_old = load(robot(tmp_path / "a.npz", VIEWS[:4]))
    robot_of_old._live.keep_last(2)
    robot_of_old._live.dropped = ()
    robot_of_old.save(tmp_path / "old.npz")
    session = load(robot(tmp_path / "b.npz", VIEWS[3:5]))
    assert session.merge([tmp_path / "old.npz"]) == 3
    whole = load(robot(tmp_path / "all.npz", VIEWS[:5]))
    np.testing.assert_array_equal(session._live._votes.dense(), whole._live._votes.dense())


@pytest.mark.parametrize("count", [1, 2, 3, 6])
def test_a_session_that_keeps_few_views_counts_each_view_that_comes_again_once(tmp_path: Path, count: int) -> None:
    session = LivingSession(SCENE, NAMES, max_views=count)
    for views in (VIEWS[:3], VIEWS[3:5], VIEWS[:4], VIEWS[2:]):
        try:
            session.merge([robot(tmp_path / "other.npz", views)])
        except StateFileError as error:
            assert views == VIEWS[:4] and "has all its votes and views already" in str(error)
        session.save(tmp_path / "own.npz")
        session = LivingSession(SCENE, NAMES, max_views=count)
        session.load(tmp_path / "own.npz")
    assert session.num_fused == 6 and session.num_views == count
    whole = load(robot(tmp_path / "all.npz", VIEWS))
    np.testing.assert_array_equal(session._live._votes.dense(), whole._live._votes.dense())


def test_votes_of_dropped_views_come_with_a_state_whose_other_views_are_known(tmp_path: Path) -> None:
    other = LivingSession(SCENE, NAMES, max_views=1)
    for view in VIEWS[:3]:
        other.fuse(view)
    other.save(tmp_path / "other.npz")
    session = load(robot(tmp_path / "own.npz", VIEWS[2:]))
    assert session.merge([tmp_path / "other.npz"]) == 2
    whole = load(robot(tmp_path / "all.npz", VIEWS))
    np.testing.assert_array_equal(session._live._votes.dense(), whole._live._votes.dense())


def test_the_command_says_how_many_dropped_views_count_twice(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    early, late = robot(tmp_path / "early.npz", VIEWS[:3]), LivingSession(SCENE, NAMES, max_views=2)
    for view in VIEWS:
        late.fuse(view)
    late.save(tmp_path / "late.npz")
    assert main(["merge", early, str(tmp_path / "late.npz"), "-o", str(tmp_path / "c.npz")]) == 0
    assert "3 views count twice" in capsys.readouterr().out
    assert load(tmp_path / "c.npz").num_fused == 9


def test_while_views_are_taken_out_others_are_fused_and_the_scene_may_change(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = load(robot(tmp_path / "a.npz", VIEWS[:3]))
    late = robot(tmp_path / "late.npz", VIEWS[1:5])
    meanwhile = [lambda: session.update(SceneDelta(removed=np.arange(50))), lambda: session.fuse(VIEWS[5])]

    def taken_out(*given: Any, **scene: Any) -> State:
        while meanwhile:
            other = threading.Thread(target=meanwhile.pop())
            other.start()
            other.join(60)
            assert not other.is_alive()
        return without_views(*given, **scene)

    monkeypatch.setattr(living_session, "without_views", taken_out)
    assert session.merge([late]) == 2
    whole = LivingSession(session.living, NAMES)
    for view in VIEWS:
        whole.fuse(view)
    assert session.num_fused == 6 and not meanwhile
    np.testing.assert_array_equal(session._live._votes.dense(), whole._live._votes.dense())


def test_where_nothing_came_meanwhile_states_are_added_up_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    session, other = load(robot(tmp_path / "a.npz", VIEWS[:3])), robot(tmp_path / "b.npz", VIEWS[2:5])
    sums = list[object]()
    monkeypatch.setattr(living_session, "merge_states", lambda *given: sums.append(given) or merge_states(*given))
    assert session.merge([other]) == 2 and session.num_fused == 5 and len(sums) == 1


def test_views_of_groups_that_moved_since_are_counted_once(tmp_path: Path) -> None:
    session = LivingSession(SCENE, NAMES)
    new = np.arange(len(SCENE), len(SCENE) + 40)
    session.update(SceneDelta(added=SCENE.subset(np.arange(40)), added_ids=new, added_groups=np.full(40, 7)))
    for view in VIEWS[:3]:
        session.fuse(view)
    session.save(tmp_path / "early.npz")
    other = LivingSession(session.living, NAMES)
    assert other.merge([tmp_path / "early.npz"]) == 3
    loop = GroupMove(7, Similarity(translation=np.array([0.1, 0.0, 0.05])), ("view0",))
    for robots in (session, other):
        robots.update(SceneDelta(removed=np.arange(30), moves=(loop,)))
    session.fuse(VIEWS[3])
    session.save(tmp_path / "late.npz")
    assert other.merge([tmp_path / "late.npz"]) == 1
    assert other.num_fused == session.num_fused == 4
    np.testing.assert_array_equal(other._live._votes.dense(), session._live._votes.dense())


def test_with_too_little_memory_for_what_comes_nothing_has_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session, state = load(robot(tmp_path / "a.npz", VIEWS[:2], names=None)), robot(tmp_path / "b.npz", VIEWS[2:])
    before, names = session._live._votes.dense(), session.class_names

    def fails(*_: object) -> None:
        raise MemoryError

    with monkeypatch.context() as patched:
        patched.setattr(VoteTotal, "from_rows", fails)
        with pytest.raises(MemoryError):
            session.merge([state])
    assert session.class_names == names and session.num_fused == session.num_views == 2
    np.testing.assert_array_equal(session._live._votes.dense(), before)


def test_objects_that_robots_have_numbered_themselves_are_not_added_up(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robots = [str(tmp_path / name) for name in ("a.npz", "b.npz")]
    for path, views in zip(robots, (VIEWS[:3], VIEWS[3:]), strict=True):
        finder = PerViewSession(SCENE)
        for view in views:
            assert finder.fuse(view) is None
        finder.save(path)
    session = LivingSession(SCENE)
    session.fuse(VIEWS[0])
    before = session._live._votes.dense()
    with pytest.raises(StateFileError, match=r"a\.npz: holds objects that its own session found and numbered"):
        session.merge(robots[:1])
    np.testing.assert_array_equal(session._live._votes.dense(), before)
    assert main(["merge", *robots, "-o", str(tmp_path / "c.npz")]) == 2
    assert "a.npz: holds objects that" in capsys.readouterr().err and not (tmp_path / "c.npz").exists()


def test_names_that_were_made_up_give_way_to_real_ones(tmp_path: Path) -> None:
    unnamed, named = robot(tmp_path / "a.npz", VIEWS[:2], names=None), robot(tmp_path / "b.npz", VIEWS[2:])
    assert main(["merge", unnamed, named, "-o", str(tmp_path / "c.npz")]) == 0
    assert load(tmp_path / "c.npz").class_names == NAMES
    fresh = LivingSession(SCENE)
    fresh.load(tmp_path / "c.npz")
    assert fresh.class_names == NAMES


def test_no_state_is_lost_to_what_comes_of_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one, other = robot(tmp_path / "a.npz", VIEWS[:2]), robot(tmp_path / "b.npz", VIEWS[2:])
    (tmp_path / "link.npz").symlink_to("b.npz")
    before = [Path(path).read_bytes() for path in (one, other)]
    for out in (one, other, str(tmp_path / "link.npz")):
        assert main(["merge", one, other, "-o", out]) == 2
        assert f"{out}: is the state that is read, and would be lost" in capsys.readouterr().err
    assert [Path(path).read_bytes() for path in (one, other)] == before
