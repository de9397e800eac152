"""Ids that name one object, as where a tracker lost it and named it anew, or where two names mean one thing."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np

from gsseg_core.data.class_names import NOTED, class_name, listed
from gsseg_core.learn.mask_reliability import MaskChecker, ViewCheck, sum_cells
from gsseg_core.text import clipped, counted

RENAMED = 0.25  # share of an id's pixels from which on it is one of several; where ids hold, next to none are


def renamed_ids(checks: Sequence[ViewCheck], others: Iterable[np.ndarray] = ()) -> dict[int, int]:
    """Find ids of which the other views give many pixels to ids that no mask shows beside them, the background apart.

    Two objects are sooner or later seen together, names of one object never. An id of a single view is left out: the
    other views do not know it. `others` are masks (H, W) that were not checked, and show ids together all the same.

    Returns, by each such id, ascending, the one of these that most pixels are given to.
    """
    cells = [check.cells() for check in checks]
    given, label, counts = sum_cells(cells)
    width = int(max(given.max(initial=0), label.max(initial=0))) + 1
    together, views = (label == 0) | (given == 0), np.zeros(width, np.int64)
    for labels in (*(labels for _, labels, _ in cells), *map(np.unique, others)):
        shown = np.zeros(width, bool)
        shown[labels[(labels >= 0) & (labels < width)]] = True
        views += shown
        together |= shown[label] & shown[given]
    pixels, apart = (np.bincount(label, weights, width) for weights in (counts, np.where(together, 0, counts)))
    renamed = np.flatnonzero((apart > RENAMED * pixels) & (views > 1)).tolist()
    return {k: int(given[np.where(together | (label != k), -1, counts).argmax()]) for k in renamed}


def renamed_among_samples(checker: MaskChecker) -> dict[int, int]:
    """Find `renamed_ids` by the masks that were sampled for calibration; others are read only if some seem to be."""
    checks, sampled = list(checker.sampled_checks.values()), checker.sampled_checks
    others = (view.read_seen().named() for name, view in checker.learner.views.items() if name not in sampled)
    return renamed_ids(checks, others) if renamed_ids(checks) else {}


def renamed_report(renamed: Mapping[int, int], class_names: Mapping[int, str]) -> list[dict[str, str]]:
    """List `renamed_ids` for `report.json`: the `name` of each, and what the `others_say`."""
    return [
        {"name": class_name(class_names, k), "others_say": class_name(class_names, other)}
        for k, other in renamed.items()
    ]


def renamed_note(
    renamed: Sequence[Mapping[str, str]], per_view: str, label_map: str, written: Callable[[str], str] = clipped
) -> str:
    """Say in a sentence without its stop what a `renamed_report` lists, and which two settings help; "" for nothing."""
    if not renamed:
        return ""
    pairs = listed((f"{entry['name']} ({entry['others_say']})" for entry in renamed), NOTED, written)
    return (
        f"other views use another id for {counted(len(renamed), 'id')}, and no mask shows both: {pairs}. Did a "
        f"tracker lose objects and give them new ids, or are there two names for one thing? {per_view} finds objects "
        f"whatever their ids are, and {label_map} merges names"
    )
