"""Reads the masks of views that can be learnt from, and rejects other views with a reason."""

from __future__ import annotations

from gsseg_core.data.soft_masks import SeenLabels
from gsseg_core.data.view import View
from gsseg_core.errors import UnknownLabelError

NO_MASK, SEES_NOTHING, ALL_UNKNOWN = "no mask", "sees no Gaussian", "all pixels unknown"


class UnusableViewError(Exception):
    """Raised for a view from which nothing can be learnt; the message is one of the reasons above."""


def read_mask(view: View, num_classes: int) -> SeenLabels:
    """Read a view's mask; raise `UnknownLabelError` if it has labels beyond the classes, which have no votes."""
    seen = view.read_seen()
    if seen.largest >= num_classes:
        raise UnknownLabelError(
            f"{view.source}: mask holds the label {seen.largest}; expected at most {num_classes - 1}, since there are "
            f"{num_classes} classes"
        )
    return seen


def read_usable_mask(view: View, num_classes: int) -> SeenLabels:
    """Read the mask of a new view, as `read_mask`; raise `UnusableViewError` if it has no mask or no labelled pixel."""
    if not view.has_mask:
        raise UnusableViewError(NO_MASK)
    seen = read_mask(view, num_classes)
    if not (seen.labels >= 0).any():
        raise UnusableViewError(ALL_UNKNOWN)
    return seen
