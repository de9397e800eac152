"""Learning from the views of a live session, with word of every view."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from gsseg_core.data.view import View
from gsseg_core.learn.calibrate import calibrate
from gsseg_core.learn.learner import Learner
from gsseg_core.learn.learner_state import Learnt
from gsseg_core.live.results import Outcome
from gsseg_core.progress import Stopwatch

Report = Callable[[str, int, int, float], None]
"""Told of stage, done, total, and the loss (nats per labelled pixel; NaN at first)."""


def fitted(name: str, learner: Learner, views: Sequence[View], report: Report, watch: Stopwatch) -> Outcome:
    """Have a learner observe views, fit and be calibrated."""

    def progress(stage: str, done: int, total: int) -> None:
        report(stage, done, total, learner.loss)

    with watch.stage("observe"):
        learner.observe_all(views, progress)
    with watch.stage("learn"):
        learner.fit(progress)
    with watch.stage("calibrate"):
        temperature = calibrate(learner, progress=progress).temperature
    learnt = Learnt(name, learner.code_rows_, len(learner.views), temperature, learner.evidence())
    return Outcome(learnt, len(learner.history_), learner.converged_, learner.loss, dict(learner.rejected))
