"""Results of a live session: why a view was rejected, and the outcome of learning."""

from __future__ import annotations

from dataclasses import dataclass

from gsseg_core.errors import (
    GssegError,
    IntrinsicsError,
    LabelMapError,
    MaskFormatError,
    MaskSizeError,
    PoseError,
    UnknownLabelError,
)
from gsseg_core.learn.learner_state import Learnt

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
    """Outcome of `LiveSession.learn`.

    Attributes
    ----------
    learnt : Learnt
        The class probabilities, in force from now on.
    num_steps : int
        Steps that were done; 0 for a learner that has none.
    converged : bool
        Whether it stopped because another step would have changed little.
    loss : float
        What the learner minimises, per labelled pixel, in nats, at the end; NaN where it has no such thing.
    rejected : dict of str to str
        Names of views that could not be used, and why.
    """

    learnt: Learnt
    num_steps: int
    converged: bool
    loss: float
    rejected: dict[str, str]
