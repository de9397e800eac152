"""Distributed learning equals local learning bit for bit, whatever happens to the workers."""

from __future__ import annotations

import os
import signal
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dask_workers import (  # noqa: F401
    SCENE,
    SETTINGS,
    VIEWS,
    address_fixture,
    assert_same,
    changed,
    client_fixture,
    client_of_victims_fixture,
    newcomer,
)
from small_scenes import NUM_CLASSES, taught

from gsseg_core.data.view import View
from gsseg_core.learn.distributed.dask_learners import DistributedEM, DistributedVotes
from gsseg_core.learn.em.em_learner import EMLearner, EMSettings
from gsseg_core.learn.vote_learner import VoteLearner
from gsseg_core.raster.vote_total import VoteTotal

Told = tuple[str, int, int]


@pytest.mark.parametrize("kind", ["em", "votes"])
def test_soft_and_partial_masks_on_workers_give_the_same_bit_for_bit(client: Any, kind: str) -> None:
    views = []
    for i, view in enumerate(VIEWS):
        labels = view.read_labels()
        chances = np.stack([np.where(labels == k, 0.8, 0.2 / 3) for k in range(NUM_CLASSES)])
        some = View.from_arrays(view.camera, np.where(labels == 1 + i % 3, labels, 0), supervised=[1 + i % 3])
        views.append([view, some, View.from_probabilities(view.camera, chances)][i % 3])
    there = DistributedEM(client, SCENE, NUM_CLASSES) if kind == "em" else DistributedVotes(client, SCENE, NUM_CLASSES)
    here = EMLearner(SCENE, NUM_CLASSES) if kind == "em" else VoteLearner(SCENE, NUM_CLASSES)
    there.observe_all(views)
    assert_same(there, taught(here, views))


def test_classes_that_only_other_workers_views_name_are_the_same_bit_for_bit(client: Any) -> None:
    def looked_for(view: View, ids: list[int], names: dict[int, str] | None) -> View:
        labels = view.read_labels()
        return View.from_arrays(view.camera, np.where(np.isin(labels, ids), labels, 0), names, supervised=ids)

    names = {0: "background", 1: "ball", 2: "cup", 3: "box"}  # Of five: without names, 4 is a class, too.
    views = [looked_for(view, [1, 2], names) for view in VIEWS[:4]]
    views += [looked_for(view, [2, 3], names) for view in VIEWS[4:6]] + [looked_for(VIEWS[6], [3], None)]
    there, here = DistributedEM(client, SCENE, 5, SETTINGS), EMLearner(SCENE, 5, SETTINGS)
    for learner in (there, here):
        learner.observe_all(views)
    assert_same(there, here)
    for learner in (there, here):
        learner.retract(VIEWS[6].name)  # Now 4 is no class any more.
    assert_same(there, here)


def with_useless_ones() -> list[View]:
    unknown = View.from_arrays(VIEWS[3].camera, np.full((48, 64), -1, np.int32))
    return [*VIEWS[:3], unknown, *VIEWS[4:], View(replace(VIEWS[3].camera, name="without a mask"))]


@pytest.mark.parametrize("errors", [True, False])
def test_em_on_workers_equals_em_here_bit_for_bit(client: Any, errors: bool) -> None:
    settings = EMSettings(errors=errors)
    there = DistributedEM(client, SCENE, NUM_CLASSES, settings)
    there.observe_all(with_useless_ones())
    here = EMLearner(SCENE, NUM_CLASSES, settings)
    here.observe_all(with_useless_ones())
    assert_same(there, here)
    assert there.rejected == here.rejected and there.reject_summary() == {"all pixels unknown": 1, "no mask": 1}
    assert (there.error_models_[VIEWS[4].name].evidence.nameless is not None) == errors  # the clutter


def test_votes_on_workers_equal_votes_here_as_views_come_and_go(client: Any) -> None:
    there, here = DistributedVotes(client, SCENE, NUM_CLASSES - 2), VoteLearner(SCENE, NUM_CLASSES - 2)
    for learner in (there, here):
        learner.resize(NUM_CLASSES)
        learner.observe_all(VIEWS[:4])
        assert learner.observe(VIEWS[5])
        learner.retract(VIEWS[1].name)
        assert learner.observe(View.from_arrays(VIEWS[2].camera, VIEWS[3].read_labels()))
    assert_same(there, here)


def test_where_there_is_no_memory_for_votes_no_view_is_listed(client: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    learner = DistributedVotes(client, SCENE, NUM_CLASSES)

    def full(*_: object) -> None:
        raise MemoryError

    with monkeypatch.context() as patch, pytest.raises(MemoryError):
        patch.setattr(VoteTotal, "_make_room", full)
        learner.observe_all(VIEWS)
    assert not learner.views
    learner.observe_all(VIEWS)
    assert_same(learner, taught(VoteLearner(SCENE, NUM_CLASSES), VIEWS))


def test_views_that_cannot_all_be_replaced_stay_with_their_votes(client: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    there, here = DistributedEM(client, SCENE, NUM_CLASSES, SETTINGS), EMLearner(SCENE, NUM_CLASSES, SETTINGS)
    for learner in (there, here):
        learner.observe_all(VIEWS[:4])
        learner.fit()
    others = [View.from_arrays(view.camera, VIEWS[0].read_labels()) for view in VIEWS[1:5]]
    lift = DistributedEM._lift

    def full(self: DistributedEM, view: View, *given: Any) -> bool:
        if view.name == VIEWS[3].name:
            raise MemoryError
        return lift(self, view, *given)

    with monkeypatch.context() as patch, pytest.raises(MemoryError):
        patch.setattr(DistributedEM, "_lift", full)
        there.observe_all(others)
    assert [*there.views.values()] == VIEWS[:4] and there.error_models_.keys() == here.error_models_.keys()
    assert_same(there, here)
    for learner in (there, here):
        learner.observe_all(others)
    assert_same(there, here)


def test_without_memory_for_prepared_views_the_result_is_the_same(client: Any) -> None:
    there = DistributedEM(client, SCENE, NUM_CLASSES, SETTINGS, memory_budget=0)
    there.observe_all(VIEWS)
    assert_same(there, taught(EMLearner(SCENE, NUM_CLASSES, SETTINGS), VIEWS))


def test_fewer_views_than_workers_are_enough(client: Any) -> None:
    there = DistributedEM(client, SCENE, NUM_CLASSES, SETTINGS)
    there.observe_all(VIEWS[:1])
    assert_same(there, taught(EMLearner(SCENE, NUM_CLASSES, SETTINGS), VIEWS[:1]))


@pytest.mark.parametrize("many", [1, 2], ids=["one", "all"])
def test_the_views_of_killed_workers_are_done_again_elsewhere(
    client_of_victims: Any, tmp_path: Path, many: int
) -> None:
    client = client_of_victims
    here = taught(EMLearner(SCENE, NUM_CLASSES, SETTINGS), VIEWS).fit()
    there = DistributedEM(client, SCENE, NUM_CLASSES, SETTINGS)
    there.observe_all(VIEWS)
    victims = dict(list(client.run(os.getpid).items())[:many])
    killed: list[int] = []
    marks = str(tmp_path)

    def mix(*_: object) -> None:  # In place of a kernel: says that it is at work, and then works on and on.
        import os
        from pathlib import Path

        Path(marks, str(os.getpid())).touch()
        time.sleep(3600)

    lull = changed(client, victims, "gsseg_core.learn.em.em_kernels", "pair_likelihood", mix)
    steps: list[int] = []
    others = ExitStack()

    def kill_at_work(stage: str, done: int, total: int) -> None:
        if done == 2 and 2 not in steps:
            lull.__enter__()  # For good: these workers do not outlive the step.
        steps.append(done)
        # One at work is enough: what was meant for the others may have been handed to it by the scheduler.
        if any(tmp_path.iterdir()) and not killed:
            killed.extend(victims.values())
            for process in killed:
                os.kill(process, signal.SIGKILL)
            others.enter_context(newcomer(client))

    with others:
        there.fit(kill_at_work)
        assert len(killed) == many and steps[-1] == SETTINGS.max_steps
        np.testing.assert_array_equal(there.codes_, here.codes_)
        assert there.history_ == here.history_
        assert_same(there, here)  # Where all were killed, by others.


def test_a_worker_killed_while_views_are_observed_changes_nothing(client_of_victims: Any) -> None:
    client = client_of_victims
    process = next(iter(client.run(os.getpid).values()))
    told: list[Told] = []

    def kill(*call: Any) -> None:
        if not told:
            os.kill(process, signal.SIGKILL)
        told.append(call)

    there = DistributedVotes(client, SCENE, NUM_CLASSES)
    there.observe_all(VIEWS, kill)
    assert told[-1] == ("observe", len(VIEWS), len(VIEWS))
    assert_same(there, taught(VoteLearner(SCENE, NUM_CLASSES), VIEWS))


class EnoughError(Exception):
    """Raised by who listens to the progress."""


def test_whoever_listens_can_end_the_work_and_begin_anew(client: Any) -> None:
    there = DistributedEM(client, SCENE, NUM_CLASSES, SETTINGS)

    def stop(stage: str, done: int, total: int) -> None:
        if stage == "em" and done == 2:
            raise EnoughError

    there.observe_all(VIEWS, stop)
    with pytest.raises(EnoughError):
        there.fit(stop)
    assert not hasattr(there, "codes_")
    assert_same(there, taught(EMLearner(SCENE, NUM_CLASSES, SETTINGS), VIEWS))
