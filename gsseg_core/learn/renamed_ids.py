"""Ids that name one object, as where a tracker lost it and named it anew, or where two names mean one thing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from gsseg_core.data.class_names import class_name
from gsseg_core.learn.mask_reliability import ViewCheck, sum_cells

RENAMED = 0.25  # share of an id's pixels from which on it is one of several; where ids hold, next to none are


def renamed_ids(checks: Sequence[ViewCheck]) -> dict[int, int]:
    """Find ids of which the other views give many pixels to ids that no mask shows beside them, the background apart.

    Two objects are sooner or later seen together, names of one object never. An id of a single view is left out: the
    other views do not know it.

    Returns, by each such id, ascending, the one of these that most pixels are given to.
    """
    cells = [check.cells() for check in checks]
    given, label, counts = sum_cells(cells)
    width = int(max(given.max(initial=0), label.max(initial=0))) + 1
    together, views = (label == 0) | (given == 0), np.zeros(width, np.int64)
    for _, labels, _ in cells:
        shown = np.zeros(width, bool)
        shown[labels] = True
        views += shown
        together |= shown[label] & shown[given]
    pixels, apart = (np.bincount(label, weights, width) for weights in (counts, np.where(together, 0, counts)))
    renamed = np.flatnonzero((apart > RENAMED * pixels) & (views > 1)).tolist()
    return {k: int(given[np.where(together | (label != k), -1, counts).argmax()]) for k in renamed}


def renamed_report(checks: Sequence[ViewCheck], class_names: Mapping[int, str]) -> list[dict[str, str]]:
    """List `renamed_ids` for `report.json`: the `name` of each, and what the `others_say`."""
    return [
        {"name": class_name(class_names, k), "others_say": class_name(class_names, other)}
        for k, other in renamed_ids(checks).items()
    ]
