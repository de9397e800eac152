"""A live session whose masks have ids of their own: objects are found as views arrive, and repaired."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matching import Contingency
from parts_of_balls import views_in_halves
from per_view_ids import in_halves, shuffled, with_labels
from small_scenes import (
    NUM_CLASSES,
    balls_on_a_table,
    clean_views,
    write_dataset,
)

from gsseg_core.cli.main import main
from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.dataset import Dataset
from gsseg_core.data.label_images import UNKNOWN, write_mask
from gsseg_core.data.view import View
from gsseg_core.errors import SettingsError, StateFileError, UnknownLabelError
from gsseg_core.learn.em.em_learner import EMLearner
from gsseg_core.learn.learner_state import Learnt
from gsseg_core.learn.vote_learner import VoteLearner
from gsseg_core.live.per_view_session import PerViewSession
from gsseg_core.live.session import LiveSession
from gsseg_core.objects.lifted_segments import Profiles
from gsseg_core.objects.object_table import ObjectTable
from gsseg_core.raster.backends import make_operator
from gsseg_core.raster.view_operator import ViewOperator
from gsseg_core.raster.vote_total import VoteTotal
from gsseg_core.refine.settings import UNREFINED
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene

SCENE, TRUTH = balls_on_a_table()
VIEWS = clean_views(8)


def without(view: View, label: int) -> View:
    """The view of a mask that says nothing of an object."""
    labels = view.read_labels()
    return with_labels(view, np.where(labels == label, UNKNOWN, labels))


def test_a_live_session_finds_the_objects_as_views_arrive_and_repairs_them_when_it_learns() -> None:
    session = PerViewSession(SCENE, max_views=6)
    for view in [in_halves(VIEWS[0], 1), *VIEWS[1:]]:
        assert session.fuse(shuffled(view)) is None
    assert session.class_names[4] == "object_004"
    codes = session.learn().learnt.codes.dense(session._live.num_classes)
    assert session.num_views == 6 and session.num_fused == 8
    true = EMLearner(SCENE, NUM_CLASSES)
    for view in VIEWS[2:]:
        true.observe(view)
    score = Contingency()
    score.add(true.fit().codes_.argmax(axis=1)[:, None], codes.argmax(axis=1)[:, None])
    assert score.ari == 1.0
    assert (session.codes().any(axis=0)).sum() == NUM_CLASSES
    blank = with_labels(VIEWS[0], np.full((48, 64), UNKNOWN))
    assert session.fuse(blank).reason == "all_pixels_unknown"  # type: ignore[union-attr]


def test_a_live_session_goes_on_with_its_objects_after_saving_and_loading(tmp_path: Path) -> None:
    session = PerViewSession(SCENE)
    for view in VIEWS[:5]:
        session.fuse(shuffled(view))
    session.save(tmp_path / "state.npz")
    other = PerViewSession(SCENE)
    other.load(tmp_path / "state.npz")
    np.testing.assert_array_equal(other.codes(), session.codes())
    for each in (session, other):
        each.fuse(shuffled(VIEWS[5]))
    np.testing.assert_array_equal(other.codes(), session.codes())
    with pytest.raises(SettingsError, match="from the views received only"):
        other.learn(dataset=Dataset(write_dataset(tmp_path / "data")))


def test_views_whose_ids_are_objects_are_known_the_same_when_they_come_together_or_one_by_one() -> None:
    apart, together = ObjectTable(SCENE), ObjectTable(SCENE)
    for view in VIEWS[:4]:
        apart.adopt(view)
    together.adopt_all(VIEWS[:4])
    assert list(apart.views) == list(together.views) and apart.num_objects == together.num_objects > 1
    one, other = apart._profiles.weights, together._profiles.weights
    assert one.shape == other.shape and (one != other).nnz == 0
    for name in apart.views:
        assert apart.objects_in(name) == together.objects_in(name)


def test_a_state_with_dropped_views_is_loaded_with_one_lift_of_each_kept_view(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = PerViewSession(SCENE, max_views=3)
    for view in VIEWS[:5]:
        session.fuse(shuffled(view))
    session.save(tmp_path / "state.npz")
    made: list[str] = []

    def counted(scene: GaussianScene, camera: Camera, device: str) -> ViewOperator:
        made.append(camera.name)
        return make_operator(scene, camera, device)

    monkeypatch.setattr("gsseg_core.learn.learner.make_operator", counted)
    monkeypatch.setattr("gsseg_core.objects.object_table.make_operator", counted)
    other = PerViewSession(SCENE)
    other.load(tmp_path / "state.npz")
    assert made == [view.name for view in VIEWS[2:5]]
    assert other.fuse(shuffled(VIEWS[0])) is None
    assert other._live.num_classes == session._live.num_classes, "what dropped views have shown is not new"


def test_objects_that_a_session_has_numbered_are_no_classes_of_another(tmp_path: Path) -> None:
    finder = PerViewSession(SCENE)
    for view in VIEWS[:3]:
        finder.fuse(shuffled(view))
    finder.save(tmp_path / "objects.npz")
    assert main(["merge", str(tmp_path / "objects.npz"), "-o", str(tmp_path / "again.npz")]) == 0
    session = LiveSession(SCENE)
    session.fuse(VIEWS[0])
    before = session.codes()
    for name in ("objects.npz", "again.npz"):
        with pytest.raises(StateFileError, match=rf"{name}: holds objects that its own session found and numbered"):
            session.load(tmp_path / name)
    np.testing.assert_array_equal(session.codes(), before)
    session.save(tmp_path / "classes.npz")
    assert PerViewSession(SCENE).load(tmp_path / "classes.npz") == 1  # Classes may become objects.


def test_votes_of_views_that_are_gone_follow_their_object() -> None:
    session = PerViewSession(SCENE, max_views=5)
    for view in [*VIEWS[:2], in_halves(VIEWS[2], 1), *VIEWS[3:]]:
        session.fuse(shuffled(view))
    before = session.codes().any(axis=1)
    session.repair()
    assert session.num_views == 5 and list(session._live.views) == [view.name for view in VIEWS[-5:]]
    np.testing.assert_array_equal(session.codes().any(axis=1), before)


def test_a_repair_keeps_the_calibration_of_what_was_learnt() -> None:
    session = PerViewSession(SCENE)
    for view in [in_halves(VIEWS[0], 1), *VIEWS[1:]]:
        session.fuse(shuffled(view))
    session._learnt = Learnt("em", CSRRows.from_dense(session.codes()), 5, temperature=1.7)
    repair = session.repair()
    assert (repair.successors != np.arange(len(repair.successors))).any(), "something was repaired"
    assert session.learnt is not None and (session.learnt.temperature, session.learnt.num_views) == (1.7, 5)


def test_objects_that_are_repaired_while_they_are_learnt_keep_what_was_learnt_of_them() -> None:
    halves, others = [in_halves(VIEWS[0], 1)], VIEWS[1:]
    session, after = PerViewSession(SCENE), PerViewSession(SCENE)
    for each in (session, after):
        for view in halves:
            assert each.fuse(view) is None

    def come(each: PerViewSession) -> np.ndarray:
        for view in others:
            assert each.fuse(view) is None
        return each.repair().successors

    def while_learning(stage: str, *_: object) -> None:
        if session.num_fused == len(halves):
            successors = come(session)
            assert (successors != np.arange(len(successors))).any(), "two halves have become one object"

    session.learn("votes", report=while_learning)
    after.learn("votes")
    come(after)
    assert session.learnt is not None and after.learnt is not None
    np.testing.assert_array_equal(session.learnt.codes.data, after.learnt.codes.data)


def test_in_a_live_session_a_view_of_a_name_that_is_kept_takes_its_place() -> None:
    session = PerViewSession(SCENE)
    for view in VIEWS[:5]:
        session.fuse(shuffled(view))
    before, names = session.codes(), session.class_names
    for labels, reason in ((np.full((48, 64), UNKNOWN), "all_pixels_unknown"), (None, "no_mask")):
        view = with_labels(VIEWS[0], labels) if labels is not None else View(VIEWS[0].camera)
        rejection = session.fuse(view)
        assert rejection is not None and rejection.reason == reason
        np.testing.assert_array_equal(session.codes(), before)
    assert session.fuse(shuffled(VIEWS[0])) is None
    assert session.num_fused == session.num_views == 5 and session.class_names == names
    session.repair()
    assert session.num_fused == session.num_views == 5
    np.testing.assert_array_equal(session.codes(), before)


def test_a_view_of_too_many_objects_is_refused_and_uses_up_no_number() -> None:
    session = PerViewSession(SCENE, max_classes=4)
    for view in VIEWS[:3]:
        assert session.fuse(shuffled(view)) is None
    before = session.codes()
    few = PerViewSession(SCENE, max_classes=3)
    for _ in range(2):
        rejection = few.fuse(shuffled(VIEWS[0]))
        assert rejection is not None and rejection.reason == "unknown_label"
        assert "would show the first of object 3; expected at most 2, as max_classes is 3" in rejection.message
    assert few.fuse(with_labels(VIEWS[0], np.minimum(VIEWS[0].read_labels(), 1))) is None
    assert few.class_names == {0: "background", 1: "object_001"}
    session.repair()
    np.testing.assert_array_equal(session.codes(), before)


@pytest.mark.parametrize(
    ("owner", "starved"),
    [(ObjectTable, "_lift"), (Profiles, "explain"), (Profiles, "add"), (ObjectTable, "relabelled"),
     (VoteTotal, "_make_room"), (VoteLearner, "retract")],
)  # fmt: skip
def test_a_view_that_there_is_no_memory_for_changes_nothing(
    owner: type, starved: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def without_memory(*_: object, **__: object) -> None:
        raise MemoryError

    session, other = PerViewSession(SCENE), PerViewSession(SCENE)
    for view in VIEWS[:2]:
        assert session.fuse(shuffled(view)) is None and other.fuse(shuffled(view)) is None
    new = with_labels(VIEWS[2], np.where(np.arange(64) < 9, 77, VIEWS[2].read_labels()))
    for view in (new, in_halves(VIEWS[1], 1)):  # another one, and one in the place of one that is kept
        if starved == "retract" and view is new:
            continue  # Nothing is taken back for it.
        with monkeypatch.context() as patch, pytest.raises(MemoryError):
            patch.setattr(owner, starved, without_memory)
            session.fuse(view)
        assert list(session._table.views) == list(session._table._objects) == session.view_names == other.view_names
        assert session.class_names == other.class_names and session.num_fused == 2
        np.testing.assert_array_equal(session.codes(), other.codes())
    for each in (session, other):
        assert each.fuse(shuffled(VIEWS[2])) is None
        each.repair()
    np.testing.assert_array_equal(session.codes(), other.codes())


@pytest.mark.parametrize(
    ("owner", "starved", "kept"),
    [(ObjectTable, "solve", 9), (ObjectTable, "relabelled", 9), (VoteLearner, "relabel", 9),
     (VoteLearner, "retract", 5), (VoteLearner, "adopt", 5), (VoteLearner, "observe", 5)],
)  # fmt: skip
def test_a_repair_that_there_is_no_memory_for_changes_nothing(
    owner: type, starved: str, kept: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    session, other = PerViewSession(SCENE, max_views=kept), PerViewSession(SCENE, max_views=kept)
    for view in [without(VIEWS[7], 1), in_halves(VIEWS[0], 1), *VIEWS[1:5]]:
        assert session.fuse(shuffled(view)) is None and other.fuse(shuffled(view)) is None
    before, found = session.codes(), {name: ids.tolist() for name, ids in session._table._objects.items()}
    work = getattr(owner, starved)

    def without_memory(*given: Any) -> None:
        work(*given)
        raise MemoryError

    with monkeypatch.context() as patch, pytest.raises(MemoryError):
        patch.setattr(owner, starved, without_memory)
        session.repair()
    np.testing.assert_array_equal(session.codes(), before)
    assert {name: ids.tolist() for name, ids in session._table._objects.items()} == found
    assert session.view_names == other.view_names
    for each in (session, other):
        assert each.repair().changed
    np.testing.assert_array_equal(session.codes(), other.codes())


def test_a_repair_that_finds_too_many_objects_changes_nothing() -> None:
    session = PerViewSession(SCENE, max_classes=2)
    merged = [with_labels(view, np.minimum(view.read_labels(), 1)) for view in VIEWS[:2]]
    for view in [*merged, *VIEWS[2:]]:
        assert session.fuse(view) is None, "what was one object at first, a view cannot part by itself"
    before = session.codes()
    with pytest.raises(UnknownLabelError, match="expected at most 1, as max_classes is 2"):
        session.repair()
    np.testing.assert_array_equal(session.codes(), before)
    assert session.num_views == session.num_fused == len(VIEWS)
    session._classes._max_classes = 256
    assert session.repair().changed, "which has not been done yet"


@pytest.mark.parametrize(("max_views", "starved"), [(9, "adopt_all"), (2, "adopt"), (2, "recall")])
def test_a_state_that_there_is_no_memory_for_changes_nothing(
    max_views: int, starved: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def without_memory(*_: object) -> None:
        raise MemoryError

    saved, session = PerViewSession(SCENE, max_views=max_views), PerViewSession(SCENE)
    for view in VIEWS[:4]:
        assert saved.fuse(shuffled(view)) is None
    saved.save(tmp_path / "state.npz")
    for view in VIEWS[4:6]:
        assert session.fuse(shuffled(view)) is None
    before, era = session.codes(), session.era
    with monkeypatch.context() as patch, pytest.raises(MemoryError):
        patch.setattr(ObjectTable, starved, without_memory)
        session.load(tmp_path / "state.npz")
    np.testing.assert_array_equal(session.codes(), before)
    assert session.era is era and session.num_fused == 2 and list(session._table.views) == session.view_names
    assert session.fuse(shuffled(VIEWS[6])) is None
    assert session.load(tmp_path / "state.npz") == 4
    np.testing.assert_array_equal(session.codes(), saved.codes())


def test_an_object_that_only_views_show_that_are_gone_keeps_its_number_after_loading(tmp_path: Path) -> None:
    session = PerViewSession(SCENE, max_views=2)
    for view in [*VIEWS[:3], *(without(view, 1) for view in VIEWS[3:6])]:
        assert session.fuse(shuffled(view)) is None
    session.save(tmp_path / "state.npz")
    other = PerViewSession(SCENE, max_views=2)
    other.load(tmp_path / "state.npz")
    for each in (session, other):
        for view in VIEWS[6:]:
            assert each.fuse(shuffled(view)) is None
        each.repair()
    assert other.class_names == session.class_names
    np.testing.assert_array_equal(other.codes(), session.codes())


def test_a_view_that_was_set_aside_is_saved_and_loaded_and_comes_back(tmp_path: Path) -> None:
    session = PerViewSession(SCENE)
    for view in VIEWS[:4]:
        session.fuse(shuffled(view))
    before, name = session.codes(), VIEWS[1].name
    away = np.eye(4)
    away[2, 3] = -1e4
    far = replace(VIEWS[1].camera, world_to_camera=away)
    session.move_view(name, lambda camera: far, session.era)
    session.save(tmp_path / "state.npz")
    other = PerViewSession(SCENE)
    assert other.load(tmp_path / "state.npz") == 4 and other.view_names == session.view_names
    np.testing.assert_array_equal(other.codes(), session.codes())
    for each in (session, other):
        each.repair()
        assert each.move_view(name, lambda camera: VIEWS[1].camera, each.era)
        assert each.view_names == [view.name for view in VIEWS[:4]] and each.num_fused == 4
        np.testing.assert_array_equal(each.codes(), before)


def test_masks_are_kept_as_they_were_fused_whatever_becomes_of_their_files(tmp_path: Path) -> None:
    session, other = PerViewSession(SCENE), PerViewSession(SCENE)
    for view in [in_halves(VIEWS[0], 1), *VIEWS[1:4]]:
        path = tmp_path / f"{view.name}.png"
        write_mask(path, view.read_labels(), 8)
        assert session.fuse(View(view.camera, path)) is None and other.fuse(view) is None
        path.unlink()
    for each in (session, other):
        assert each.repair().changed
        assert each.move_view(VIEWS[1].name, lambda camera: VIEWS[1].camera, each.era)
    np.testing.assert_array_equal(session.codes(), other.codes())


def test_a_result_can_be_cut_at_a_level_and_the_tree_grows_with_the_views() -> None:
    session = PerViewSession(SCENE)
    views = views_in_halves()
    for view in views[:2]:
        assert session.fuse(view) is None
    early = session.segmentation(UNREFINED)
    np.testing.assert_array_equal(session.at_level(early, 1.0).labels, early.labels)  # A single view shows halves.
    for view in views[2:]:
        assert session.fuse(view) is None
    session.repair()
    objects = session.segmentation(UNREFINED)
    fine = session.at_level(objects, 0.9)
    assert session.scene_of(fine) is SCENE
    parts = [k for k, name in fine.class_names.items() if "." in name]
    assert len(parts) == 2
    whole = int(objects.labels[fine.labels == parts[0]][0])
    np.testing.assert_array_equal(np.isin(fine.labels, parts), objects.labels == whole)
    with pytest.raises(SettingsError, match="granularity"):
        session.at_level(objects, 2.0)


def test_names_of_classes_are_refused_as_the_objects_have_their_own() -> None:
    with pytest.raises(SettingsError, match="class_names are given; expected none"):
        PerViewSession(SCENE, {1: "mug"})  # type: ignore[arg-type]
