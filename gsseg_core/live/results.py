"""Results of a live session: why a view was rejected, and what learning from its views came to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from gsseg_core.data.view import View
from gsseg_core.errors import (
    GssegError,
    IntrinsicsError,
    LabelMapError,
    MaskFormatError,
    MaskSizeError,
    PoseError,
    UnknownLabelError,
)
from gsseg_core.learn.calibrate import calibrate
from gsseg_core.learn.learner import Learner
from gsseg_core.learn.learner_state import Learnt
from gsseg_core.learn.mask_reliability import MaskChecker
from gsseg_core.learn.renamed_ids import renamed_among_samples
from gsseg_core.progress import Stopwatch

Report = Callable[[str, int, int, float], None]
"""Told of stage, done, total, and the loss (nats per labelled pixel; NaN at first)."""

SCENE_CHANGED = "scene_changed"
"""Reason for a view of what has been forgotten since it was taken."""

_REASONS: dict[type[GssegError], str] = {
    MaskFormatError: "mask_format",
    MaskSizeError: "size_mismatch",
    UnknownLabelError: "unknown_label",
    LabelMapError: "unknown_label",
    PoseError: "bad_pose",
    IntrinsicsError: "bad_camera_info",
}


@dataclass(frozen=True)
class Rejection:
    """Reason for which a view was rejected."""

    reason: str  # a short name, to count by
    message: str  # what was found and what was expected

    @classmethod
    def of(cls, error: GssegError) -> Rejection:
        """Name the reason for an error."""
        return cls(_REASONS.get(type(error), "unusable"), str(error))


@dataclass(frozen=True, eq=False)
class Outcome:
    """Outcome of `LiveSession.learn`."""

    learnt: Learnt  # the class probabilities, in force from now on
    num_steps: int  # that were done; 0 for a learner that has none
    converged: bool  # whether it stopped because another step would have changed little
    loss: float  # what the learner minimises, per labelled pixel, in nats, at the end; NaN where there is no such thing
    rejected: dict[str, str]  # names of views that could not be used, and why
    views: Sequence[View]  # that were to be learnt from, posed in the scene


def observe_and_fit(
    name: str, learner: Learner, views: Sequence[View], report: Report, watch: Stopwatch, *, named: bool
) -> Outcome:  # fmt: skip
    """Have a learner observe views, fit and be calibrated; and if ids were `named` by a segmenter, compare these."""

    def progress(stage: str, done: int, total: int) -> None:
        report(stage, done, total, learner.loss)

    with watch.stage("observe"):
        learner.observe_all(views, progress)
    with watch.stage("learn"):
        learner.fit(progress)
    with watch.stage("calibrate"):
        checker = MaskChecker(learner)
        temperature = calibrate(learner, checker, progress).temperature
        renamed = renamed_among_samples(checker) if named and learner.checks_masks else {}
    learnt = Learnt(name, learner.code_rows_, len(learner.views), temperature, learner.evidence(), renamed)
    return Outcome(learnt, len(learner.history_), learner.converged_, learner.loss, dict(learner.rejected), views)
