"""Learning from the views of a live session, with word of every view."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from gsseg_core.data.class_names import check_same_names, class_name
from gsseg_core.data.dataset import Dataset
from gsseg_core.data.view import View
from gsseg_core.errors import ClassesFileError, UnknownLabelError
from gsseg_core.learn.calibrate import calibrate
from gsseg_core.learn.learner import Learner
from gsseg_core.learn.learner_state import Learnt
from gsseg_core.live.class_numbers import most_classes
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
    learnt = Learnt(name, learner.codes_, len(learner.views), temperature, learner.evidence())
    return Outcome(learnt, len(learner.history_), learner.converged_, learner.loss, dict(learner.rejected))


def num_classes_with(dataset: Dataset, num_classes: int, max_classes: int, num_gaussians: int) -> int:
    """Count the classes once those of a dataset are added; raises `UnknownLabelError` if they are too many."""
    num_classes = max(num_classes, dataset.num_classes)
    most, why = most_classes(max_classes, num_gaussians)
    if num_classes > most:
        raise UnknownLabelError(
            f"{dataset.root}: has {num_classes} classes; expected at most {most}{why}, or class_names that declare them"
        )
    return num_classes


def check_names_of(dataset: Dataset, names: Mapping[int, str]) -> None:
    """Raise `ClassesFileError` if a dataset calls a class otherwise than a session does, whose votes it would mix with.

    0 is the background, whatever it is called.
    """
    declared = next((view.class_names for view in dataset.views()), None) or {}  # Those made up take reading all masks.
    called = {k: name for k, name in declared.items() if k}
    check_same_names(called, names, dataset.root, "the session that is to learn from it", ClassesFileError)


def names_with(dataset: Dataset, names: Mapping[int, str], *, fused: bool) -> dict[int, str]:
    """Add the names of a dataset's classes to those of a session, in whose place no name that is made up comes.

    Raises as `check_names_of` does, where views are `fused`: these may have come while the dataset was learnt from.
    """
    check_names_of(dataset, names if fused else {})
    found = dataset.class_names
    return {**names, **{k: name for k, name in found.items() if k not in names or name != class_name({}, k)}}
