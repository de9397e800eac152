"""States of old, whose rays went on behind surfaces: what can be is cast anew, and nothing mixes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_scenes import NUM_CLASSES, balls_on_a_table, clean_views, taught

from gsseg_core.cli.main import main
from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.view import View
from gsseg_core.errors import StateFileError
from gsseg_core.learn.learner_state import State
from gsseg_core.learn.vote_learner import VoteLearner
from gsseg_core.live.living_session import LivingSession
from gsseg_core.raster.backends import make_operator

SCENE, _ = balls_on_a_table()
VIEWS = clean_views(6)
UNITS = 2.0**24


def votes_of_old(views: list[View]) -> np.ndarray:
    """Every entry of W votes, also behind surfaces, (N, K) int64."""
    votes = np.zeros((len(SCENE), NUM_CLASSES), np.int64)
    for view in views:
        pixels, gaussians, weights = make_operator(SCENE, view.camera).weights()
        of_view = np.zeros(votes.shape, np.float32)
        np.add.at(of_view, (gaussians, view.read_labels().ravel()[pixels]), weights)
        votes += np.rint(of_view * UNITS).astype(np.int64)
    return votes


def save_old(path: Path, views: list[View], num_kept: int | None = None) -> Path:
    """Save what an older version would have, the last `num_kept` views kept."""
    kept = views if num_kept is None else views[-num_kept:]
    state = State(
        CSRRows.from_dense(votes_of_old(views)), NUM_CLASSES, kept, len(views), {1: "red ball"}, whole_rays=True
    )
    state.save(path, SCENE.digest)
    return path


def votes_of(views: list[View]) -> np.ndarray:
    return taught(VoteLearner(SCENE, NUM_CLASSES), views)._votes.dense()


def test_where_all_masks_are_kept_an_old_state_becomes_what_would_be_learnt_today(tmp_path: Path) -> None:
    session = LivingSession(SCENE)
    assert session.load(save_old(tmp_path / "old.npz", VIEWS)) == len(VIEWS)
    np.testing.assert_array_equal(session._live._votes.dense(), votes_of(VIEWS))
    assert (votes_of_old(VIEWS) != votes_of(VIEWS)).any()
    session.save(tmp_path / "saved.npz")
    assert not State.load_alone(tmp_path / "saved.npz")[1].whole_rays


def test_what_masks_cast_that_are_no_longer_kept_stays_and_no_view_is_taken_back_by_more_than_it_cast(
    tmp_path: Path,
) -> None:
    session = LivingSession(SCENE, max_views=2)
    session.load(save_old(tmp_path / "old.npz", VIEWS, 2))
    expected = votes_of_old(VIEWS[:-2])
    np.testing.assert_allclose(session._live._votes.dense() - votes_of(VIEWS[-2:]), expected, rtol=0, atol=0.01 * UNITS)
    for view in VIEWS[-2:]:
        session._live.retract(view.name)
    left = session._live._votes.dense()
    assert left.min() >= 0 and not left[~expected.any(axis=1)].any()


def test_states_of_both_kinds_are_merged_only_once_both_are_of_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = save_old(tmp_path / "first.npz", VIEWS[:3]), save_old(tmp_path / "second.npz", VIEWS[3:])
    session, both = LivingSession(SCENE), tmp_path / "both.npz"
    session.load(first)
    assert session.merge([second]) == 3
    np.testing.assert_array_equal(session._live._votes.dense(), votes_of(VIEWS))
    session.save(tmp_path / "new.npz")

    assert main(["merge", str(first), str(tmp_path / "new.npz"), "-o", str(both)]) != 0
    said = capsys.readouterr().err
    assert "first.npz: an older gsseg has saved it" in said and "load it in a session" in said and not both.exists()
    assert main(["merge", str(first), str(second), "-o", str(both)]) == 0
    session.load(both)
    np.testing.assert_array_equal(session._live._votes.dense(), votes_of(VIEWS))


def test_a_state_of_old_that_cannot_be_cast_anew_changes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = LivingSession(SCENE)
    session.fuse(VIEWS[0])
    before, path = session._live._votes.dense(), save_old(tmp_path / "old.npz", VIEWS[1:])

    def broken(*_: object) -> None:
        raise StateFileError("out of memory")

    monkeypatch.setattr("gsseg_core.learn.learner.votes_cast_anew", broken)
    with pytest.raises(StateFileError):
        session.load(path)
    np.testing.assert_array_equal(session._live._votes.dense(), before)
    assert list(session._live.views) == [VIEWS[0].name]


def test_votes_against_classes_are_cast_anew_too() -> None:
    """A mask that looked for the first ball alone votes against it where that is not."""
    view = VIEWS[0]
    ball = (view.read_labels() == 1).astype(np.float32)
    partial = View.from_detections(view.camera, {1: ball})
    learner = taught(VoteLearner(SCENE, NUM_CLASSES), [partial])
    operator = make_operator(SCENE, view.camera)
    whole = operator.adjoint((2 * ball - 1)[..., None])[:, 0]
    votes = np.zeros((len(SCENE), NUM_CLASSES), np.int64)
    votes[:, 1] = np.rint(whole * UNITS)
    state = replace(
        learner.state(), votes=CSRRows.from_dense(votes + votes_of_old(VIEWS[1:2])), num_fused=2, whole_rays=True
    )
    expected = learner._votes.dense() + votes_of_old(VIEWS[1:2])
    learner.adopt(state)
    np.testing.assert_allclose(learner._votes.dense(), expected, rtol=2e-3, atol=0.01 * UNITS)
