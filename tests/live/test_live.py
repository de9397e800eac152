"""The live session: views fused one by one, codes learnt beside it, saved and restored, from several threads."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from patience import PATIENCE
from small_scenes import NAMES, NUM_CLASSES, balls_on_a_table, clean_views, fed, taught, write_dataset, wrong_views

from gsseg_core.data.dataset import Dataset
from gsseg_core.data.label_evidence import LabelEvidence
from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.data.soft_masks import SeenLabels
from gsseg_core.data.view import View
from gsseg_core.errors import (
    NoCodesError,
    NoUsableViewsError,
    SettingsError,
    StateFileError,
    StateMismatchError,
    UnknownLabelError,
)
from gsseg_core.learn.em.em_learner import EMLearner
from gsseg_core.learn.vote_learner import VoteLearner
from gsseg_core.live import session_classes
from gsseg_core.live.living_session import LivingSession
from gsseg_core.live.session import LiveSession
from gsseg_core.refine.settings import UNREFINED, RefineSettings
from gsseg_core.spatial.neighbourhood import neighbours_of

SCENE, TRUTH = balls_on_a_table()
VIEWS = clean_views(6)
UNCARVED = RefineSettings(carve=False)


def blank(view: View, label: int = UNKNOWN) -> View:
    return View.from_arrays(view.camera, np.full((view.camera.height, view.camera.width), label))


def test_what_the_first_request_needs_of_the_scene_is_found_before() -> None:
    scene, settings = balls_on_a_table()[0], RefineSettings(k=7)
    LiveSession(scene, NAMES).prepare(settings)
    for thread in threading.enumerate():
        if thread.name == "neighbours":
            thread.join(PATIENCE)
    neighbours = neighbours_of(scene, settings.k)
    assert "digest" in vars(scene) and neighbours is not None
    assert not np.isnan(neighbours.radii).any()


def test_codes_of_fused_views_are_those_of_the_votes() -> None:
    expected = taught(VoteLearner(SCENE, NUM_CLASSES), VIEWS).fit().codes_
    np.testing.assert_array_equal(fed(LiveSession(SCENE, NAMES)).codes(), expected)


def test_classes_turn_up_with_their_labels_unless_they_were_declared() -> None:
    session = LiveSession(SCENE)
    assert session.class_names == {0: "background"}
    fed(session)
    assert session.class_names == {0: "background", 1: "class_01", 2: "class_02", 3: "class_03"}
    np.testing.assert_array_equal(session.codes(), fed(LiveSession(SCENE, NAMES)).codes())
    declared = LiveSession(SCENE, {0: "background", 1: "ball"})
    rejection = declared.fuse(VIEWS[0])
    assert rejection is not None and rejection.reason == "unknown_label" and "at most 1" in rejection.message


def test_a_label_that_would_take_too_much_memory_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session_classes, "VOTES_LIMIT", 4 * 20 * 10)  # of a table of 20 blocks of Gaussians
    session = LiveSession(SCENE)
    assert session.fuse(blank(VIEWS[0], 9)) is None
    rejection = session.fuse(blank(VIEWS[1], 10))
    assert rejection is not None and "expected at most 9 for a scene of 626 Gaussians" in rejection.message
    assert len(session.class_names) == 10


def test_neither_a_dataset_nor_a_state_brings_more_classes_than_there_is_memory_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fed(LiveSession(SCENE)).save(tmp_path / "state.npz")
    data = Dataset(write_dataset(tmp_path / "data"))
    monkeypatch.setattr(session_classes, "VOTES_LIMIT", 4 * 20 * 3)
    session = LivingSession(SCENE)
    for take_in in (session.load, lambda path: session.merge([path])):
        with pytest.raises(StateFileError, match="holds 4 classes; expected at most 3 for a scene of 626 Gaussians"):
            take_in(tmp_path / "state.npz")
    with pytest.raises(UnknownLabelError, match="has 4 classes; expected at most 3 for a scene of 626 Gaussians"):
        session.learn("votes", data)
    assert not session.has_codes and session.class_names == {0: "background"}
    assert fed(LiveSession(SCENE, NAMES)).num_fused == len(VIEWS), "names that were declared all count"


def test_reset_forgets_the_names_of_classes_that_turned_up_and_their_numbers() -> None:
    session, declared = fed(LiveSession(SCENE)), LiveSession(SCENE, NAMES)
    assert session.number_classes({1: "mug", 2: "bowl"}) == {1: 1, 2: 2}
    session.reset()
    assert session.number_classes({1: "bowl"}) == {1: 1}
    declared.reset()
    assert declared.class_names == NAMES


def test_views_that_cannot_be_used_are_counted_by_reason_and_change_nothing() -> None:
    session = fed(LiveSession(SCENE, NAMES))
    before, names = session.codes(), session.class_names
    for _ in range(70):
        assert session.fuse(blank(VIEWS[0])).reason == "all_pixels_unknown"  # type: ignore[union-attr]
        assert session.fuse(blank(VIEWS[1], 9)).reason == "unknown_label"  # type: ignore[union-attr]
        assert session.fuse(View(VIEWS[0].camera)).reason == "no_mask"  # type: ignore[union-attr]
    assert session.rejected == {"all_pixels_unknown": 70, "unknown_label": 70, "no_mask": 70}
    np.testing.assert_array_equal(session.codes(), before)
    assert session.class_names == names and session.num_fused == len(VIEWS)


def test_a_view_that_is_refused_brings_no_class() -> None:
    session = fed(LiveSession(SCENE))
    names, shape = session.class_names, session.codes().shape
    away = VIEWS[0].camera.world_to_camera.copy()
    away[0, 3] += 1e4
    unseen = blank(View(replace(VIEWS[0].camera, name="away", world_to_camera=away)), 200)
    assert session.fuse(unseen).reason == "sees_no_Gaussian"  # type: ignore[union-attr]
    assert session.class_names == names and session.codes().shape == shape


def test_where_every_class_has_votes_against_it_nothing_is_known() -> None:
    session, every = LiveSession(SCENE), np.arange(2, dtype=np.int32)
    none_of_these = SeenLabels(np.zeros((48, 64), np.int32), LabelEvidence(every, np.zeros((1, 2), np.float32), every))
    assert session.fuse(View.from_seen(clean_views(1)[0].camera, none_of_these)) is None
    assert not session.codes().any()
    assert not session.unrefined().confidence.any()


def test_only_the_last_views_are_kept_and_no_vote_is_dropped() -> None:
    session = fed(LiveSession(SCENE, NAMES, max_views=2))
    assert session.num_views == 2 and session.num_fused == len(VIEWS)
    np.testing.assert_array_equal(session.codes(), fed(LiveSession(SCENE, NAMES)).codes())
    expected = taught(EMLearner(SCENE, NUM_CLASSES), VIEWS[-2:]).fit().codes_
    np.testing.assert_array_equal(session.learn().learnt.codes.dense(NUM_CLASSES), expected)
    assert fed(LiveSession(SCENE, NAMES, max_views=np.uint8(2))).num_views == 2  # type: ignore[arg-type]
    for count in (0, 2.5):
        with pytest.raises(SettingsError, match=f"max_views is {count}; expected at least 1, a whole number"):
            LiveSession(SCENE, NAMES, max_views=count)  # type: ignore[arg-type]


def test_a_view_of_a_name_that_is_kept_takes_its_place_and_all_counts_agree(tmp_path: Path) -> None:
    session = fed(LiveSession(SCENE, NAMES))
    other = View.from_arrays(VIEWS[0].camera, wrong_views(1)[0].read_labels())
    assert session.fuse(other) is None
    assert session.num_fused == session.num_views == len(VIEWS)
    np.testing.assert_array_equal(session.codes(), fed(LiveSession(SCENE, NAMES), [*VIEWS[1:], other]).codes())
    assert session.save(tmp_path / "state.npz") == len(VIEWS)
    again = LiveSession(SCENE, NAMES)
    assert again.load(tmp_path / "state.npz") == again.num_fused == again.num_views == len(VIEWS)
    assert session.fuse(blank(VIEWS[0])) is not None
    assert session.num_fused == session.num_views == len(VIEWS)


def test_a_name_that_is_not_kept_any_more_is_that_of_another_view() -> None:
    session = fed(LiveSession(SCENE, NAMES, max_views=1), [VIEWS[0], VIEWS[1], VIEWS[0]])
    assert (session.num_fused, session.num_views) == (3, 1)
    once = fed(LiveSession(SCENE, NAMES), VIEWS[:2])._live._votes.dense()
    twice = once + fed(LiveSession(SCENE, NAMES), VIEWS[:1])._live._votes.dense()
    np.testing.assert_array_equal(session._live._votes.dense(), twice)


@pytest.mark.parametrize("forget", ["reset", "load"])
def test_a_view_of_before_is_not_fused_into_what_came_in_its_place(tmp_path: Path, forget: str) -> None:
    session = fed(LiveSession(SCENE, NAMES), VIEWS[:2])
    session.save(tmp_path / "state.npz")
    era = session.era
    assert session.fuse(VIEWS[2], era) is None
    session.reset() if forget == "reset" else session.load(tmp_path / "state.npz")
    known = session.num_fused
    rejection = session.fuse(VIEWS[3], era)
    assert rejection is not None and rejection.reason == "scene_changed" and VIEWS[3].name in rejection.message
    assert not session.rejected and session.num_fused == session.num_views == known
    assert session.fuse(VIEWS[3], session.era) is None


def test_codes_of_views_that_were_forgotten_meanwhile_do_not_come_to_hold() -> None:
    session = fed(LiveSession(SCENE, NAMES))
    with pytest.raises(NoUsableViewsError, match="forgotten while they were learnt from"):
        session.learn("votes", report=lambda *_: None if not session.has_codes else session.reset() and None)
    assert session.learnt is None and not session.has_codes


def test_no_more_classes_turn_up_than_are_allowed(tmp_path: Path) -> None:
    session = fed(LiveSession(SCENE, max_classes=4))
    before = session.codes()
    rejection = session.fuse(blank(VIEWS[0], 4))
    assert rejection is not None and rejection.reason == "unknown_label"
    assert "mask holds the label 4; expected at most 3, as max_classes is 4, or class_names" in rejection.message
    np.testing.assert_array_equal(session.codes(), before)
    session.save(tmp_path / "state.npz")
    few, data = LiveSession(SCENE, max_classes=3), Dataset(write_dataset(tmp_path / "data"))
    with pytest.raises(StateFileError, match="holds 4 classes; expected at most 3, as max_classes is 3"):
        few.load(tmp_path / "state.npz")
    with pytest.raises(UnknownLabelError, match="has 4 classes; expected at most 3, as max_classes is 3, or "):
        few.learn(dataset=data)
    assert not few.has_codes
    assert LiveSession(SCENE).fuse(blank(VIEWS[0], 256)) is not None
    assert fed(LiveSession(SCENE, NAMES, max_classes=1)).num_fused == len(VIEWS), "names that were declared all count"
    with pytest.raises(SettingsError, match="max_classes is 0; expected at least 1"):
        LiveSession(SCENE, max_classes=0)


def test_without_views_there_is_nothing_to_learn_show_or_save(tmp_path: Path) -> None:
    session = LiveSession(SCENE, NAMES)
    with pytest.raises(NoUsableViewsError):
        session.learn()
    for ask in (session.codes, session.segmentation, lambda: session.save(tmp_path / "state.npz")):
        with pytest.raises(NoCodesError):
            ask()
    assert not session.has_codes and not list(tmp_path.iterdir())


def test_a_segmentation_is_kept_until_codes_or_settings_change() -> None:
    session = fed(LiveSession(SCENE, NAMES), VIEWS[:3])
    first = session.segmentation()
    assert session.segmentation() is first
    other = session.segmentation(UNREFINED)
    assert other is not first and not other.clustered.any()
    before = session.segmentation()
    fed(session, VIEWS[3:4])
    assert session.segmentation() is not before


def test_a_saved_session_comes_back_whole(tmp_path: Path) -> None:
    session = fed(LiveSession(SCENE, max_views=4))
    session.learn()
    fed(session, clean_views(2, "late"))
    assert session.save(tmp_path / "state.npz") == 4
    again = LiveSession(SCENE)
    assert again.load(tmp_path / "state.npz") == 4
    np.testing.assert_array_equal(again.codes(), session.codes())
    assert again.class_names == session.class_names and again.num_fused == 8 and again.num_views == 4
    np.testing.assert_array_equal(again.learn().learnt.codes.data, session.learn().learnt.codes.data)
    assert LiveSession(SCENE, NAMES).load(tmp_path / "state.npz") == 4


def test_loading_makes_no_sum_of_votes_but_the_one_that_is_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fed(LiveSession(SCENE), VIEWS[:2]).save(tmp_path / "state.npz")
    session, made, no_votes = LiveSession(SCENE), [], LiveSession._no_votes
    monkeypatch.setattr(LiveSession, "_no_votes", lambda *asked: made.append(no_votes(*asked)) or made[-1])
    session.load(tmp_path / "state.npz")
    assert made == [session._live]


def test_classes_whose_declared_ids_have_gaps_are_saved_loaded_and_go_on(tmp_path: Path) -> None:
    gaps = {**NAMES, 9: "chair"}
    session = fed(LiveSession(SCENE, gaps))
    session.save(tmp_path / "state.npz")
    fed(LiveSession(SCENE, NAMES)).save(tmp_path / "fewer.npz")
    for name in ("state.npz", "fewer.npz"):
        again = LiveSession(SCENE, gaps)
        assert again.load(tmp_path / name) == len(VIEWS)
        assert again.class_names == session.class_names
        np.testing.assert_array_equal(again.codes(), session.codes())
        assert again.fuse(blank(VIEWS[0], 9)) is None


def test_a_state_that_does_not_fit_is_refused_and_changes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "state.npz"
    fed(LiveSession(SCENE, NAMES)).save(path)
    other = LiveSession(balls_on_a_table(seed=1)[0], NAMES)
    fed(other, VIEWS[:1])
    few = LiveSession(SCENE, {0: "background", 1: "ball"})
    few.fuse(blank(VIEWS[0], 1))
    renamed = fed(LiveSession(SCENE, {**NAMES, 1: NAMES[2], 2: NAMES[1]}))
    for session, error in ((other, StateMismatchError), (few, StateFileError), (renamed, StateFileError)):
        before = session.codes()
        with pytest.raises(error):
            session.load(path)
        np.testing.assert_array_equal(session.codes(), before)


def test_reset_forgets_all_but_the_scene() -> None:
    session = fed(LiveSession(SCENE))
    session.learn()
    session.fuse(blank(VIEWS[0]))
    assert session.reset() == len(VIEWS)
    assert not session.has_codes and not session.rejected and session.learnt is None and session.num_views == 0
    assert session.class_names == {0: "background"}


def test_threads_that_fuse_learn_and_segment_at_once_lose_nothing() -> None:
    session, errors = fed(LiveSession(SCENE, NAMES), VIEWS[:1]), []

    def guarded(work) -> None:  # type: ignore[no-untyped-def]
        try:
            work()
        except Exception as error:
            errors.append(error)

    def segment() -> None:
        for _ in range(5):
            assert session.segmentation().labels.shape == TRUTH.shape

    jobs = [lambda: fed(session, VIEWS[1:]), session.learn, segment, segment]
    threads = [threading.Thread(target=guarded, args=(job,)) for job in jobs]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(PATIENCE)
    assert not errors and not any(thread.is_alive() for thread in threads)
    assert session.num_fused == len(VIEWS)
    session._learnt = None
    np.testing.assert_array_equal(session.codes(), fed(LiveSession(SCENE, NAMES)).codes())


def test_names_of_classes_are_told_while_a_view_is_being_fused(monkeypatch: pytest.MonkeyPatch) -> None:
    session = LiveSession(balls_on_a_table()[0], NAMES)
    begun, told, in_time = threading.Event(), threading.Event(), []

    def observe(learner: object, view: object, operator: object) -> bool:
        begun.set()
        in_time.append(told.wait(PATIENCE))
        return True

    monkeypatch.setattr(VoteLearner, "observe", observe)
    fusing = threading.Thread(target=session.fuse, args=(clean_views(1)[0],))
    fusing.start()
    assert begun.wait(PATIENCE)
    assert session.class_names == NAMES
    told.set()
    fusing.join()
    assert in_time == [True]
