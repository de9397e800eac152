"""What a change of the scene leaves as it was, what it takes along, and what it is refused for."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from living_sessions import FAR, SCENE, TRUTH, VIEWS, K, as_refused, other_room, session, votes
from small_scenes import NAMES, clean_views, true_labels

from gsseg_core.data.label_images import write_mask
from gsseg_core.data.view import View
from gsseg_core.errors import (
    EmptySceneError,
    SceneDeltaError,
)
from gsseg_core.learn.vote_learner import VoteLearner
from gsseg_core.live.living_session import LivingSession
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.scene_delta import GroupMove, SceneDelta
from gsseg_core.scene.similarity import Similarity
from gsseg_core.segmentation import Segmentation


def test_a_group_that_moves_with_its_keyframes_keeps_their_votes_bit_for_bit() -> None:
    moving = session(group=0)
    before = votes(moving).copy()
    for _ in range(3):
        changed = moving.update(SceneDelta(moves=(GroupMove(0, FAR),)))
        assert (changed.num_views_kept, changed.num_views_lifted) == (4, 0)
    np.testing.assert_array_equal(votes(moving), before)
    np.testing.assert_allclose(moving.scene.means, FAR.points(FAR.points(FAR.points(SCENE.means))), rtol=1e-5)
    # What the robot renders from where the keyframe went is what it saw.
    posed = moving._posed_views()[0]
    labels = true_labels(moving.scene, TRUTH, posed.camera)
    assert (labels == VIEWS[0].read_labels()).mean() > 0.999


def test_views_that_are_named_in_a_move_go_along_and_others_stay_where_they_are() -> None:
    moving = session()
    changed = moving.update(SceneDelta(moves=(GroupMove(0, FAR, ("view0", "view1", "long gone")),)))
    assert (changed.num_views_kept, changed.num_views_lifted, changed.num_views_unknown) == (2, 2, 1)
    np.testing.assert_array_equal(votes(moving), as_refused(moving))
    assert [view.group for view in moving.views] == [0, 0, None, None]
    alone = LivingSession(SCENE, NAMES)
    for view in VIEWS[:2]:
        alone.fuse(view)
    np.testing.assert_array_equal(votes(moving), votes(alone))


def test_a_change_out_of_sight_lifts_nothing_and_one_in_sight_only_those_that_see_it() -> None:
    growing = session()
    before = votes(growing).copy()
    changed = growing.update(other_room((0, 0, 50)))
    assert (changed.num_added, changed.num_views_kept, changed.num_views_lifted) == (len(SCENE), 4, 0)
    np.testing.assert_array_equal(votes(growing)[: len(SCENE)], before)
    corner = np.array([int(SCENE.means[:, :2].sum(axis=1).argmax())])
    changed = growing.update(SceneDelta(removed=corner))
    assert changed.num_removed == 1 and changed.num_views_lifted > 0
    np.testing.assert_array_equal(votes(growing), as_refused(growing))


def test_what_changes_behind_a_wall_touches_no_view_and_in_front_of_it_does() -> None:
    wall = GaussianScene.from_arrays(
        np.zeros((8, 3)), np.tile([1.0, 0, 0, 0], (8, 1)), np.full((8, 3), 9.0), np.full(8, 0.999), np.zeros((8, 1, 3))
    )
    walled = LivingSession(wall, NAMES)
    pose = np.eye(4)
    pose[2, 3] = 1
    camera = replace(VIEWS[0].camera, world_to_camera=pose)
    labels = VIEWS[0].read_labels()
    labels[:16] = -1
    assert walled.fuse(View.from_arrays(camera, labels)) is None
    before = votes(walled).copy()
    behind, in_front = other_room((0, 0, 12)), other_room((0, 0, 0), group=2)
    changed = walled.update(behind)
    assert (changed.num_views_kept, changed.num_views_lifted) == (1, 0)
    np.testing.assert_array_equal(votes(walled)[:8], before)
    np.testing.assert_array_equal(votes(walled), as_refused(walled))
    assert walled.update(replace(in_front, added_ids=in_front.added_ids + 10**6)).num_views_lifted == 1
    np.testing.assert_array_equal(votes(walled), as_refused(walled))
    assert walled.update(SceneDelta(removed=behind.added_ids)).num_views_lifted == 0
    np.testing.assert_array_equal(votes(walled), as_refused(walled))


def test_those_that_stay_keep_their_order_and_added_ones_come_behind_with_their_ids(tmp_path: Path) -> None:
    growing = session()
    delta = other_room((0, 0, 9))
    growing.update(replace(delta, removed=np.array([3, 0, 7])))
    expected = np.concatenate([np.setdiff1d(np.arange(len(SCENE)), [0, 3, 7]), delta.added_ids])
    np.testing.assert_array_equal(growing.living.ids, expected)
    result = growing.segmentation()
    assert len(result.labels) == len(growing.scene) == len(expected)
    result.save(tmp_path / "segmentation.npz")
    with np.load(tmp_path / "segmentation.npz") as file:
        np.testing.assert_array_equal(file["ids"], expected)
    growing.scene.save(tmp_path / "grown.ply")
    again = GaussianScene.load(tmp_path / "grown.ply")
    np.testing.assert_array_equal(again.ids, expected)
    np.testing.assert_array_equal(Segmentation.load(tmp_path / "segmentation.npz", again).ids, expected)
    session().segmentation().save(tmp_path / "plain.npz")
    with np.load(tmp_path / "plain.npz") as file:
        assert "ids" not in file.files


def test_what_was_learnt_goes_along_with_its_gaussians_also_while_it_is_learnt() -> None:
    growing = session()
    growing.learn("votes")
    learnt = growing.learnt
    growing.update(SceneDelta(removed=np.array([5])))
    np.testing.assert_array_equal(growing.learnt.codes.dense(K), np.delete(learnt.codes.dense(K), 5, axis=0))
    np.testing.assert_array_equal(growing.learnt.evidence, np.delete(learnt.evidence, 5))

    def remove_once(*_: object) -> None:
        if 6 in growing.living.ids:
            growing.update(SceneDelta(removed=np.array([6])))

    outcome = growing.learn("votes", report=remove_once)
    assert outcome.learnt.codes.num_rows == len(growing.scene) == len(SCENE) - 2
    assert len(growing.segmentation().labels) == len(growing.scene)


def test_a_gaussian_that_takes_the_id_of_a_removed_one_while_it_is_learnt_gets_nothing_of_that() -> None:
    growing, again = session(), other_room((0, 0, 9))
    growing.learn("votes")
    seen = int(growing.learnt.codes.dense(K).any(axis=1).argmax())
    one = SCENE.subset(np.array([seen]))

    def take_the_place(*_: object) -> None:
        if growing.living.revision is None:
            growing.update(SceneDelta(removed=np.array([seen])))
            growing.update(replace(again, added=one, added_ids=np.array([seen]), added_groups=np.zeros(1, np.int64)))

    codes = growing.learn("votes", report=take_the_place).learnt.codes.dense(K)
    assert growing.living.ids[-1] == seen and not codes[-1].any() and codes[:-1].any()


def test_votes_of_views_that_are_not_kept_any_more_go_along_with_their_gaussians() -> None:
    short = LivingSession(SCENE, NAMES, max_views=1)
    for view in VIEWS:
        short.fuse(view)
    last = LivingSession(SCENE, NAMES)
    last.fuse(VIEWS[-1])
    forgotten = votes(short) - votes(last)
    short.update(SceneDelta(removed=np.arange(100)))
    np.testing.assert_array_equal(votes(short) - as_refused(short), forgotten[100:])


@pytest.mark.parametrize(
    ("delta", "message"),
    [
        (SceneDelta(revision=5), "its revision is 5; expected 2, as the scene is at 1"),
        (SceneDelta(revision=1), "its revision is 1; expected 2"),
        (SceneDelta(removed=np.array([626])), "removes 1 ids that the scene does not have .first 626."),
        (replace(other_room((0, 0, 9)), added_ids=np.arange(626)), "adds 626 ids that the scene has already .first 0."),
        (SceneDelta(moves=(GroupMove(9, FAR),)), "moves group 9, which holds no Gaussian"),
    ],
)
def test_a_change_that_does_not_fit_is_refused_in_one_line_and_changes_nothing(delta: SceneDelta, message: str) -> None:
    refusing = session()
    refusing.update(SceneDelta(revision=1))
    before, scene = votes(refusing).copy(), refusing.living
    with pytest.raises(SceneDeltaError, match=message):
        refusing.update(delta)
    np.testing.assert_array_equal(votes(refusing), before)
    assert refusing.living is scene


@pytest.mark.parametrize("starved_at", range(1, 10))
def test_a_change_that_there_is_no_memory_for_changes_nothing(starved_at: int, monkeypatch: pytest.MonkeyPatch) -> None:
    session = LivingSession(SCENE, NAMES)
    for view in clean_views(6):
        assert session.fuse(view) is None
    session.fuse(blank_view := replace(clean_views(6)[0], group=0))
    before, votes, views = session.living, session._live._votes.dense(), dict(session._live.views)
    calls, lift = itertools.count(1), VoteLearner._lift

    def without_memory(learner: VoteLearner, *given: Any) -> bool:
        if next(calls) == starved_at:
            raise MemoryError
        return lift(learner, *given)

    moved = Similarity(translation=np.array([0.2, 0.0, 0.0]))
    delta = SceneDelta(removed=np.arange(3), moves=(GroupMove(0, moved, (blank_view.name,)),))
    with monkeypatch.context() as patch:
        patch.setattr(VoteLearner, "_lift", without_memory)
        try:
            session.update(delta)
        except MemoryError:
            assert session.living is before and session.scene is before.scene
            np.testing.assert_array_equal(session._live._votes.dense(), votes)
            assert dict(session._live.views) == views
            patch.undo()
            session.update(delta)
    fresh = LivingSession(session.living, NAMES)
    for view in session.views:
        assert fresh.fuse(view) is None
    np.testing.assert_array_equal(session._live._votes.dense(), fresh._live._votes.dense())


def test_the_last_gaussian_is_not_removed() -> None:
    with pytest.raises(EmptySceneError, match="removes the last Gaussian"):
        session().update(SceneDelta(removed=np.arange(len(SCENE))))


def test_a_mask_counts_as_it_was_fused_whatever_becomes_of_its_file(tmp_path: Path) -> None:
    of_files, in_memory = session(), session()
    view = View(replace(VIEWS[0].camera, name="file"), tmp_path / "mask.png")
    write_mask(view.source, VIEWS[0].read_labels(), 8)
    in_memory.fuse(View.from_arrays(view.camera, VIEWS[0].read_labels()))
    of_files.fuse(view)
    (tmp_path / "mask.png").unlink()
    of_files.save(tmp_path / "state.npz")
    for one in (of_files, in_memory):
        one.update(SceneDelta(removed=np.arange(30)))
    np.testing.assert_array_equal(votes(of_files), votes(in_memory))


def test_a_view_of_a_group_that_the_scene_has_not_is_refused() -> None:
    rejection = LivingSession(SCENE, NAMES).fuse(replace(VIEWS[0], group=7))
    assert rejection is not None and "belongs to group 7, which the scene does not have" in rejection.message


def test_a_group_that_is_moved_back_is_where_it_was_for_new_views() -> None:
    moving = session()
    moving.update(SceneDelta(moves=(GroupMove(0, Similarity(translation=np.array([1.0, 0, 0]))),)))
    moving.update(SceneDelta(moves=(GroupMove(0, Similarity(translation=np.array([-1.0, 0, 0]))),)))
    np.testing.assert_array_equal(moving.scene.means, SCENE.means)
    np.testing.assert_array_equal(votes(moving), votes(session()))
