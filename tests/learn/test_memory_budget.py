"""The memory of learners: prepared views within a budget, in a file beyond it, or none at all."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_scenes import NUM_CLASSES, balls_on_a_table, clean_views, taught

from gsseg_core.data.label_images import write_mask
from gsseg_core.data.soft_masks import SeenLabels
from gsseg_core.data.view import View
from gsseg_core.errors import SettingsError
from gsseg_core.files import scratch_file
from gsseg_core.learn import prepared_views
from gsseg_core.learn.em.em_learner import EMLearner
from gsseg_core.learn.gradient_learner import GradientLearner
from gsseg_core.learn.learner import Learner
from gsseg_core.learn.learner_state import State
from gsseg_core.learn.mask_reliability import MaskChecker
from gsseg_core.learn.vote_learner import VoteLearner
from gsseg_core.raster.cpu import label_pairs
from gsseg_core.raster.observation import Observation

LEARNERS = [VoteLearner, EMLearner, GradientLearner]
SCENE, TRUTH = balls_on_a_table()
VIEWS = clean_views(5)

every_learner = pytest.mark.parametrize("kind", LEARNERS)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.7, 1.0])
def test_prepared_views_stay_within_the_memory_budget_and_results_are_the_same(share: float) -> None:
    whole = taught(EMLearner(SCENE, NUM_CLASSES), VIEWS).fit()
    needed = sum(observation.nbytes for observation in whole._prepared.in_memory.values())
    assert len(whole._prepared.in_memory) == len(VIEWS)
    bounded = taught(EMLearner(SCENE, NUM_CLASSES, memory_budget=int(share * needed)), VIEWS).fit()
    held = sum(observation.nbytes for observation in bounded._prepared.in_memory.values())
    assert share * needed - max(o.nbytes for o in whole._prepared.in_memory.values()) < held <= share * needed
    np.testing.assert_array_equal(bounded.codes_, whole.codes_)


def test_views_beyond_the_memory_budget_are_prepared_once_and_memory_does_not_grow_with_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    prepared, peaks, largest = 0, [], 0
    prepare = EMLearner._prepare

    def counted(learner: EMLearner, view: View, seen: SeenLabels, operator: object = None) -> Observation:
        nonlocal prepared, largest
        prepared += 1
        observation = prepare(learner, view, seen)
        largest = max(largest, observation.nbytes)
        return observation

    monkeypatch.setattr(EMLearner, "_prepare", counted)
    many = [replace(view, camera=replace(view.camera, name=f"{view.name} {i}")) for i in range(8) for view in VIEWS]
    for views in (VIEWS, VIEWS, many):  # the first time takes what is kept of the scene
        prepared = 0
        tracemalloc.start()
        learner = taught(EMLearner(SCENE, NUM_CLASSES, memory_budget=1), views).fit()
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert prepared == len(views) and learner.prepared_bytes()[0] == 0 < learner.prepared_bytes()[1]
    # What stays of a view is its error model, and the numbers of its labels: little, even of views as small as these.
    assert peaks[2] - peaks[1] < 0.2 * (len(many) - len(VIEWS)) * largest


def test_nothing_is_asked_twice_of_a_view_that_is_in_the_file(monkeypatch: pytest.MonkeyPatch) -> None:
    share, asked = label_pairs.share, []

    def counted(*given: Any) -> Any:
        asked.append(1)
        return share(*given)

    monkeypatch.setattr(label_pairs, "share", counted)
    counts = []
    for budget in (1 << 30, 1):
        asked.clear()
        learner = taught(EMLearner(SCENE, NUM_CLASSES, memory_budget=budget), VIEWS).fit()
        after_fit = len(asked)
        MaskChecker(learner).check_all()
        counts.append((after_fit, len(asked)))
    assert counts[0] == counts[1] and counts[0][0] == counts[0][1]
    learner.retract(VIEWS[0].name)
    answers = learner._prepared._answers
    assert not answers.holds(VIEWS[0].name) and answers.holds(VIEWS[1].name)


def test_without_a_budget_views_vote_at_once_and_no_table_of_votes_is_made_for_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    kept = VoteLearner(SCENE, NUM_CLASSES)
    kept.observe_all(VIEWS)
    monkeypatch.setattr("gsseg_core.learn.learner.vote_total", lambda *_: pytest.fail("a table was made"))
    passing = VoteLearner(SCENE, NUM_CLASSES, memory_budget=0)
    passing.observe_all(VIEWS)
    np.testing.assert_array_equal(passing._votes.dense(), kept._votes.dense())


def test_by_default_an_eighth_of_the_free_memory_is_for_prepared_views(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(prepared_views, "free_memory", lambda: 8 << 30)
    assert VoteLearner(SCENE, NUM_CLASSES).memory_budget == 1 << 30
    monkeypatch.setattr(prepared_views, "free_memory", lambda: None)
    assert VoteLearner(SCENE, NUM_CLASSES).memory_budget == 2 << 30


@pytest.mark.parametrize("budget", [0, 1, 1 << 30])
def test_a_mask_that_was_corrected_in_its_file_replaces_what_the_file_held_before(
    budget: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scratch_file, "SPARED", 1 << 60)  # No disk has space for what is beyond the budget.
    view, labels = View(VIEWS[1].camera, tmp_path / "1.png"), VIEWS[1].read_labels()
    write_mask(view.source, np.full_like(labels, 3), 8)
    learner = taught(VoteLearner(SCENE, NUM_CLASSES, memory_budget=budget), [VIEWS[0], view])
    write_mask(view.source, labels, 8)
    assert learner.observe(view)
    np.testing.assert_array_equal(
        learner._votes.dense(), taught(VoteLearner(SCENE, NUM_CLASSES), VIEWS[:2])._votes.dense()
    )
    write_mask(view.source, np.full_like(labels, 2), 8)
    learner.retract(view.name)
    np.testing.assert_array_equal(
        learner._votes.dense(), taught(VoteLearner(SCENE, NUM_CLASSES), VIEWS[:1])._votes.dense()
    )


@every_learner
@pytest.mark.parametrize("budget", [0, 1, 1 << 30])
def test_what_is_saved_and_prepared_anew_are_the_masks_that_have_voted(
    kind: type[Learner], budget: int, tmp_path: Path
) -> None:
    views = [View(view.camera, tmp_path / f"{view.name}.png") for view in VIEWS]
    for view, known in zip(views, VIEWS, strict=True):
        write_mask(view.source, known.read_labels(), 8)
    learner, first = taught(kind(SCENE, NUM_CLASSES, memory_budget=budget), views), views[0]
    for view in views:
        write_mask(view.source, np.full((view.camera.height, view.camera.width), 3), 8)
    learner.state().save(tmp_path / "state.npz", SCENE.digest)
    learner.adopt(State.load(tmp_path / "state.npz", SCENE.digest, len(SCENE)))
    expected = taught(kind(SCENE, NUM_CLASSES), VIEWS)
    np.testing.assert_array_equal(learner.fit().codes_, expected.fit().codes_)
    learner.retract(first.name)
    expected.retract(first.name)
    np.testing.assert_array_equal(learner._votes.dense(), expected._votes.dense())


def test_a_negative_memory_budget_is_refused() -> None:
    with pytest.raises(SettingsError, match="memory_budget is -1 bytes; expected at least 0"):
        EMLearner(SCENE, NUM_CLASSES, memory_budget=-1)
