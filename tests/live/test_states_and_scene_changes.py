"""Saved states and files of scenes that have changed since, or grown: what was known goes along."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from living_sessions import FAR, SCENE, VIEWS, K, as_refused, other_room, session, votes
from small_scenes import NAMES

from gsseg_core.data.label_evidence import VOTE_UNIT
from gsseg_core.errors import (
    SettingsError,
    StateFileError,
    StateMismatchError,
)
from gsseg_core.live.living_session import LivingSession
from gsseg_core.live.per_view_session import PerViewSession
from gsseg_core.live.session import LiveSession
from gsseg_core.raster.constants import T_LIFTED
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.living_scene import LivingScene
from gsseg_core.scene.scene_delta import GroupMove, SceneDelta

ARRAYS = ("means", "quats", "scales", "opacities", "sh")


@pytest.mark.parametrize("began", ["plain", "with ids"])
def test_a_state_saved_before_changes_loads_after_them_as_if_its_views_had_been_fused_then(
    tmp_path: Path, began: str
) -> None:
    changing = session(group=0)
    if began == "with ids":
        changing.update(other_room((0, 0, 6)))
    changing.save(tmp_path / "state.npz")
    changing.reset()
    changing.update(SceneDelta(removed=np.arange(40)))
    changing.update(other_room((0.3, 0, 0), group=2) if began == "plain" else SceneDelta(moves=(GroupMove(1, FAR),)))
    changing.update(SceneDelta(moves=(GroupMove(0, FAR),)))
    assert changing.load(tmp_path / "state.npz") == 4
    assert changing.num_views == changing.num_fused == 4
    np.testing.assert_array_equal(votes(changing), as_refused(changing))
    assert votes(changing).any()
    changing.save(tmp_path / "later.npz")
    again = LivingSession(changing.living, NAMES)
    again.load(tmp_path / "later.npz")
    np.testing.assert_array_equal(votes(again), votes(changing))


def test_a_state_of_views_whose_group_is_a_number_of_numpy_can_be_saved(tmp_path: Path) -> None:
    session(group=np.int64(0)).save(tmp_path / "state.npz")  # type: ignore[arg-type]
    again = LivingSession(SCENE, NAMES)
    assert again.load(tmp_path / "state.npz") == 4 and {view.group for view in again.views} == {0}


def test_a_state_of_another_scene_whose_geometry_nobody_has_is_refused(tmp_path: Path) -> None:
    session().save(tmp_path / "state.npz")
    other = LivingSession(SCENE.subset(np.arange(500)), NAMES)
    with pytest.raises(StateMismatchError):
        other.load(tmp_path / "state.npz")


@pytest.mark.parametrize("file", ["as it was", "with ids", "without ids", "without ids, in another order"])
def test_a_state_of_a_changed_scene_loads_in_a_session_that_begins_with_a_file_of_it(tmp_path: Path, file: str) -> None:
    changed = session(group=0)
    if file != "as it was":
        changed.update(SceneDelta(removed=np.arange(40), moves=(GroupMove(0, FAR),)))
    changed.update(other_room((0, 0, 6)))
    changed.save(tmp_path / "state.npz")
    now = SCENE if file == "as it was" else changed.scene
    if file.startswith("without"):
        order = np.random.default_rng(0).permutation(len(now)) if "order" in file else np.arange(len(now))
        now = GaussianScene.from_arrays(*(getattr(now, name)[order] for name in ARRAYS))
    began = LivingSession(now, NAMES)
    assert began.load(tmp_path / "state.npz") == 4
    np.testing.assert_array_equal(votes(began), as_refused(began))
    where = {tuple(mean): row for mean, row in zip(changed.scene.means.tolist(), votes(changed), strict=True)}
    expected = np.array([where[tuple(mean)] for mean in now.means.tolist()])
    assert expected.any()
    # Seen from where the group has gone, and not in its frame, numbers are rounded in another way: a ray may end later.
    np.testing.assert_allclose(votes(began), expected, rtol=0, atol=2 * T_LIFTED / VOTE_UNIT)


@pytest.mark.parametrize("kind", [LiveSession, PerViewSession])
def test_a_session_without_groups_has_the_views_of_a_state_where_these_have_gone_with_their_groups(
    tmp_path: Path, kind: type[LiveSession]
) -> None:
    changed = session(group=0)
    changed.update(SceneDelta(removed=np.arange(40), moves=(GroupMove(0, FAR),)))
    changed.save(tmp_path / "state.npz")
    plain = kind(changed.scene)
    assert plain.load(tmp_path / "state.npz") == 4
    fused, posed = LiveSession(changed.scene, NAMES), changed._posed_views()
    for view in posed:
        assert fused.fuse(view) is None
    np.testing.assert_array_equal(plain.codes(), fused.codes())
    assert plain.learn("votes").learnt.num_views == 4, "all are seen from where they are"
    for view in posed:
        assert plain.fuse(view) is None, "which takes back what was loaded, and adds the same"
    np.testing.assert_array_equal(plain._live._votes.dense(), fused._live._votes.dense())


def test_a_state_of_another_scene_with_ids_is_refused_where_ids_are_but_numbers(tmp_path: Path) -> None:
    changed = session()
    changed.update(other_room((0, 0, 6)))
    changed.save(tmp_path / "state.npz")
    elsewhere = GaussianScene.from_arrays(SCENE.means + 0.5, *(getattr(SCENE, name) for name in ARRAYS[1:]))
    for began in (LivingSession(elsewhere, NAMES), LivingSession(elsewhere, NAMES)):
        before = votes(began).copy()
        with pytest.raises(StateMismatchError, match=r"state\.npz: its Gaussians have ids.* only 0 of 626 lie where"):
            began.load(tmp_path / "state.npz")
        with pytest.raises(StateMismatchError):
            began.merge([tmp_path / "state.npz"])
        np.testing.assert_array_equal(votes(began), before)
        began.update(SceneDelta(removed=np.array([3])))


def test_a_state_saved_before_its_group_was_made_anew_in_place_and_moved_loads_to_where_it_went(tmp_path: Path) -> None:
    changing = session(group=0)
    changing.update(SceneDelta(removed=np.array([3])))
    changing.save(tmp_path / "state.npz")
    nudged = GaussianScene.from_arrays(SCENE.means + 1e-4, *(getattr(SCENE, name) for name in ARRAYS[1:]))
    ids = np.delete(np.arange(len(SCENE)), 3)
    anew = SceneDelta(removed=ids, added=nudged.subset(ids), added_ids=ids, added_groups=np.zeros(len(ids), np.int64))
    changing.update(replace(anew, moves=(GroupMove(0, FAR),)))
    changing.load(tmp_path / "state.npz")
    assert [view.group for view in changing.views] == [0] * 4
    np.testing.assert_array_equal(votes(changing), as_refused(changing))


@pytest.mark.parametrize("by", ["id", "position"])
def test_a_grown_file_takes_votes_along_and_says_how_many(tmp_path: Path, by: str) -> None:
    growing = session()
    if by == "id":
        growing.update(SceneDelta(removed=np.array([1])))
    grown = LivingSession(growing.living, NAMES)
    grown.update(replace(other_room((0, 0, 1.5)), removed=np.arange(20, 30)))
    file = grown.scene if by == "id" else GaussianScene.from_arrays(
        grown.scene.means, grown.scene.quats, grown.scene.scales, grown.scene.opacities, grown.scene.sh
    )  # fmt: skip
    before = len(growing.scene)
    changed = growing.replace_scene(file, tolerance=1e-4)
    assert (changed.num_carried, changed.num_removed, changed.num_added) == (before - 10, 10, len(SCENE))
    assert changed.matched_by == by
    np.testing.assert_array_equal(votes(growing), as_refused(growing))
    with pytest.raises(SettingsError, match="tolerance is -1; expected a distance"):
        growing.replace_scene(file, tolerance=-1)


def test_a_file_in_another_order_takes_the_votes_to_their_gaussians() -> None:
    shuffled = session()
    order = np.random.default_rng(0).permutation(len(SCENE))
    before = votes(shuffled).copy()
    changed = shuffled.replace_scene(SCENE.subset(order))
    assert changed.num_carried == len(SCENE)
    np.testing.assert_array_equal(votes(shuffled), before[order])


def test_what_a_file_without_ids_adds_gets_free_ids_also_where_those_there_reach_the_end_of_int64() -> None:
    ids = np.arange(len(SCENE))
    ids[-1] = np.iinfo(np.int64).max
    growing, room = LivingSession(LivingScene.numbered(SCENE, ids).scene, NAMES), other_room((0, 0, 50)).added
    assert room is not None
    parts = [[getattr(one, name) for one in (SCENE, room)] for name in ARRAYS]
    changed = growing.replace_scene(GaussianScene.from_arrays(*map(np.concatenate, parts)))
    assert (changed.num_carried, changed.num_added, changed.matched_by) == (len(SCENE), len(SCENE), "position")
    np.testing.assert_array_equal(growing.living.ids, [*ids, *range(len(SCENE) - 1, 2 * len(SCENE) - 1)])


@pytest.mark.parametrize("with_ids", [False, True])
def test_a_state_saved_before_a_file_in_another_order_loads_after_it_to_its_gaussians(
    tmp_path: Path, with_ids: bool
) -> None:
    shuffled = LivingSession(SCENE, NAMES, max_views=1)
    for view in VIEWS:
        shuffled.fuse(view)
    shuffled.learn("votes")
    forgotten, learnt = votes(shuffled) - as_refused(shuffled), shuffled.learnt.codes.dense(K)
    shuffled.save(tmp_path / "state.npz")
    rng, origin, file = np.random.default_rng(0), np.arange(len(SCENE)), SCENE
    for ids in (None, rng.permutation(len(SCENE) - 50) if with_ids else None):
        order = rng.permutation(len(file))[: len(SCENE) - 50]
        origin, file = origin[order], file.subset(order)
        file = file if ids is None else LivingScene.numbered(file, ids).scene
        shuffled.replace_scene(file)
    shuffled.load(tmp_path / "state.npz")
    np.testing.assert_array_equal(votes(shuffled) - as_refused(shuffled), forgotten[origin])
    np.testing.assert_array_equal(shuffled.learnt.codes.dense(K), learnt[origin])
    assert forgotten.any() and learnt.any()


def test_a_class_that_is_announced_and_not_yet_seen_is_not_given_to_another_robots_class(tmp_path: Path) -> None:
    other = LivingSession(SCENE)
    other.number_classes({2: "sofa"})
    for view in VIEWS:
        other.fuse(view)
    other.save(tmp_path / "other.npz")
    here = LivingSession(SCENE)
    here.number_classes({2: "table"})
    with pytest.raises(StateFileError, match="calls class 2 'sofa'; expected 'table'"):
        here.merge([tmp_path / "other.npz"])
    here = LivingSession(SCENE)
    ids = here.number_classes({40: "lamp"})
    here.merge([tmp_path / "other.npz"])
    assert here.number_classes({40: "lamp", 1: "sofa"}) == {**ids, 1: 2}
