"""Learning in a live session: what it comes to, from its own views or a folder, and what ends it."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_scenes import NAMES, NUM_CLASSES, balls_on_a_table, clean_views, fed, taught, write_dataset, wrong_views

from gsseg_core.data.dataset import Dataset
from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.data.view import View
from gsseg_core.errors import (
    ClassesFileError,
    MaskFormatError,
    StateFileError,
    UnknownLabelError,
)
from gsseg_core.learn.em.em_learner import EMLearner
from gsseg_core.live.current_codes import current_evidence
from gsseg_core.live.session import LiveSession
from gsseg_core.raster.backends import make_operator
from gsseg_core.refine.settings import UNREFINED, RefineSettings
from gsseg_core.segmentation import Segmentation

SCENE, TRUTH = balls_on_a_table()
VIEWS = clean_views(6)
UNCARVED = RefineSettings(carve=False)


def test_learning_gives_what_the_learner_gives_on_the_same_views() -> None:
    views = wrong_views(8)
    session, learner = fed(LiveSession(SCENE, NAMES), views), taught(EMLearner(SCENE, NUM_CLASSES), views).fit()
    told: list[tuple[str, int, int, float]] = []
    outcome = session.learn(report=lambda *what: told.append(what))
    np.testing.assert_array_equal(outcome.learnt.codes.dense(NUM_CLASSES), learner.codes_)
    np.testing.assert_array_equal(outcome.learnt.evidence, learner.evidence())
    refined = Segmentation.from_codes(SCENE, learner.codes_, NAMES, evidence=learner.evidence())
    np.testing.assert_array_equal(session.segmentation(UNCARVED).labels, refined.labels)
    assert outcome.num_steps == len(learner.history_) and outcome.converged
    assert outcome.loss == -learner.history_[-1] and outcome.learnt.num_views == 8
    assert all(0 <= done <= total for _, done, total, _ in told) and math.isnan(told[0][3])
    assert told[0][0] == "observe" and told[-1][0] == "calibrate" and told[-1][3] == outcome.loss


def test_after_learning_its_codes_hold_and_votes_speak_for_the_gaussians_that_it_did_not_see() -> None:
    labels = VIEWS[0].read_labels()
    labels[:, 20:] = UNKNOWN
    views = [View.from_arrays(VIEWS[0].camera, labels), *VIEWS[1:]]
    session = fed(LiveSession(SCENE, NAMES), views[:1])
    learnt = session.learn().learnt.codes.dense(NUM_CLASSES)
    fed(session, views[1:])
    votes, codes = fed(LiveSession(SCENE, NAMES), views).codes(), session.codes()
    known = learnt.any(axis=1)
    assert known.any() and not known.all() and (votes.any(axis=1) & ~known).any()
    np.testing.assert_array_equal(codes[known], learnt[known])
    np.testing.assert_array_equal(codes[~known], votes[~known])
    evidence = current_evidence(session._live, session.learnt)
    np.testing.assert_array_equal(evidence[known], session.learnt.evidence[known])
    np.testing.assert_array_equal(evidence[~known], session._live.evidence()[~known])


def test_what_learning_left_unknown_stays_so_until_other_views_have_seen_as_much_of_it() -> None:
    first, wrong = VIEWS[0].camera, VIEWS[0].read_labels()
    wrong[wrong == 1] = 2
    seen = make_operator(SCENE, first).adjoint(np.ones((*wrong.shape, 1), np.float32))[:, 0] * (TRUTH == 1)
    hidden = np.zeros((len(SCENE), 1), np.float32)
    hidden[np.argsort(-seen)[:4]] = 1
    views = [View.from_arrays(first, wrong)]
    for view in VIEWS[1:]:  # They contradict the first one, but say nothing where they see what is hidden.
        labels = view.read_labels()
        labels[make_operator(SCENE, view.camera).render(hidden)[..., 0] > 0] = UNKNOWN
        views.append(View.from_arrays(view.camera, labels))
    session = fed(LiveSession(SCENE, NAMES), views)
    learnt = session.learn().learnt
    rejected = (learnt.evidence > 10) & ~learnt.codes.known()
    assert rejected.any()
    np.testing.assert_array_equal(session.codes(), learnt.codes.dense(NUM_CLASSES))
    refined = Segmentation.from_codes(SCENE, session.codes(), NAMES, evidence=learnt.evidence)
    np.testing.assert_array_equal(session.segmentation(UNCARVED).labels, refined.labels)
    fed(session, [replace(view, camera=replace(view.camera, name=f"{view.name} again")) for view in VIEWS])
    assert (session.codes()[rejected].argmax(axis=1) == 1).all()


def test_without_refinement_probabilities_are_calibrated_too_and_the_last_refined_result_stays_kept() -> None:
    session = fed(LiveSession(SCENE, NAMES), wrong_views(8))
    assert session.learn().learnt.temperature != 1
    refined, found = session.segmentation(UNCARVED), session.unrefined()
    assert session.segmentation(UNCARVED) is refined
    for name in ("labels", "confidence", "probabilities"):
        np.testing.assert_array_equal(getattr(found, name), getattr(session.segmentation(UNREFINED), name))


def test_what_an_older_version_has_learnt_comes_without_its_evidence_and_all_neighbours_weigh_the_same(
    tmp_path: Path,
) -> None:
    session, restored = fed(LiveSession(SCENE, NAMES), wrong_views(8)), LiveSession(SCENE, NAMES)
    learnt = session.learn().learnt
    session.save(tmp_path / "state.npz")
    restored.load(tmp_path / "state.npz")
    np.testing.assert_array_equal(restored.learnt.evidence, learnt.evidence)
    with np.load(tmp_path / "state.npz") as file:
        arrays = {name: file[name] for name in file.files if name != "evidence"}
    np.savez(tmp_path / "state.npz", **arrays)
    restored.load(tmp_path / "state.npz")
    assert restored.learnt.evidence is None
    refined = Segmentation.from_codes(SCENE, learnt.codes.dense(NUM_CLASSES), NAMES)
    np.testing.assert_array_equal(restored.segmentation(UNCARVED).labels, refined.labels)
    for wrong in (
        np.full(len(SCENE), np.nan, np.float32),
        np.full(len(SCENE), -1, np.float32),
        np.zeros(3, np.float32),
    ):
        np.savez(tmp_path / "state.npz", **arrays, evidence=wrong)
        with pytest.raises(StateFileError, match=r"state\.npz: .*array evidence .*expected"):
            restored.load(tmp_path / "state.npz")


def test_learning_from_a_folder_takes_its_train_views_and_its_names(tmp_path: Path) -> None:
    data = Dataset(write_dataset(tmp_path / "data"))
    session = LiveSession(SCENE)
    outcome = session.learn(dataset=data)
    expected = taught(EMLearner(SCENE, NUM_CLASSES), data.views("train")).fit().codes_
    np.testing.assert_array_equal(outcome.learnt.codes.dense(NUM_CLASSES), expected)
    assert session.class_names == NAMES and session.num_fused == 0 and session.has_codes
    assert session.learn(dataset=data, num_views=2).learnt.num_views == 2
    assert session.learn(dataset=data, max_steps=1).num_steps == 1
    assert math.isnan(session.learn("votes", data).loss)


def test_a_folder_that_calls_classes_otherwise_is_not_learnt_from(tmp_path: Path) -> None:
    named = Dataset(write_dataset(tmp_path / "named"))
    swapped = NAMES | {1: NAMES[2], 2: NAMES[1]}
    told = LiveSession(SCENE)
    told.number_classes(swapped)
    for session in (LiveSession(SCENE, swapped), fed(told)):
        with pytest.raises(ClassesFileError, match=f"named: calls class 1 '{NAMES[1]}'; expected '{NAMES[2]}'"):
            session.learn(dataset=named)
        assert session.learnt is None and session.class_names == swapped
    told.reset()  # Then there are no votes to mix with.
    told.learn("votes", named)
    assert told.class_names == NAMES
    (tmp_path / "named" / "classes.json").unlink()
    fed(told).learn("votes", Dataset(tmp_path / "named"))
    assert told.class_names == NAMES  # Names that are made up take the place of none.


def test_a_folder_whose_names_masks_contradict_that_come_while_it_is_learnt_from_is_not_learnt(tmp_path: Path) -> None:
    named, session = Dataset(write_dataset(tmp_path / "named")), LiveSession(SCENE)

    def masks_come(stage: str, done: int, total: int, loss: float) -> None:
        if not session.num_fused:
            session.number_classes({1: "chair"})
            fed(session)

    with pytest.raises(ClassesFileError, match=f"named: calls class 1 '{NAMES[1]}'; expected 'chair'"):
        session.learn("votes", named, report=masks_come)
    assert session.learnt is None and session.class_names[1] == "chair"


@pytest.mark.parametrize("stage", ["observe", "em"])
def test_learning_that_is_stopped_changes_nothing(stage: str) -> None:
    class StoppedError(Exception):
        pass

    def stop(what: str, done: int, total: int, loss: float) -> None:
        if what == stage and (done or stage == "em"):
            raise StoppedError

    session = fed(LiveSession(SCENE, NAMES))
    session.learn(num_views=2)
    before, version = session.codes(), session.learnt
    with pytest.raises(StoppedError):
        session.learn(report=stop)
    assert session.learnt is version
    np.testing.assert_array_equal(session.codes(), before)


def test_learning_from_broken_files_names_the_file_and_changes_nothing(tmp_path: Path) -> None:
    session, root = fed(LiveSession(SCENE, NAMES)), write_dataset(tmp_path / "data")
    before = session.codes()
    next((root / "labels").glob("view1.png")).write_bytes(b"no picture")
    with pytest.raises(MaskFormatError, match=r"view1\.png"):
        session.learn(dataset=Dataset(root))
    with pytest.raises(UnknownLabelError):
        LiveSession(SCENE, {0: "background", 1: NAMES[1]}).learn(dataset=Dataset(write_dataset(tmp_path / "other")))
    np.testing.assert_array_equal(session.codes(), before)
