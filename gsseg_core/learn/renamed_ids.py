"""Finds several ids of one object, as when a tracker lost it and gave it a new id, or two class names are synonyms."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np

from gsseg_core.data.class_names import NOTED, class_name, listed
from gsseg_core.learn.mask_reliability import MaskChecker, ViewCheck, sum_cells
from gsseg_core.text import clipped, counted

RENAMED = 0.25  # report an id if others name more than this share of its pixels; almost 0 where ids are stable


def renamed_ids(checks: Sequence[ViewCheck], others: Iterable[np.ndarray] = ()) -> dict[int, int]:
    """Find ids for which the other views predict, in many pixels, another id that no mask shows together with it.

    Two objects are eventually seen together; two ids of one object never are. The background is left out, and so are
    ids in only one view, which other views cannot predict. `others` are further masks (H, W), not checked, that also
    show which ids occur together.

    Returns a map from each such id, ascending, to the other id that most of its pixels get.
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
    """Find `renamed_ids` in the masks sampled for calibration; read the other masks only if these have any."""
    checks, sampled = list(checker.sampled_checks.values()), checker.sampled_checks
    others = (view.read_seen().named() for name, view in checker.learner.views.items() if name not in sampled)
    return renamed_ids(checks, others) if renamed_ids(checks) else {}


def renamed_report(renamed: Mapping[int, int], class_names: Mapping[int, str]) -> list[dict[str, str]]:
    """List `renamed_ids` for `report.json`: the `name` of each id, and the name that `others_say`."""
    return [
        {"name": class_name(class_names, k), "others_say": class_name(class_names, other)}
        for k, other in renamed.items()
    ]


def renamed_note(
    renamed: Sequence[Mapping[str, str]], per_view: str, label_map: str, written: Callable[[str], str] = clipped
) -> str:
    """Write a `renamed_report` as a sentence without full stop, with two settings that help; "" if it is empty."""
    if not renamed:
        return ""
    pairs = listed((f"{entry['name']} ({entry['others_say']})" for entry in renamed), NOTED, written)
    return (
        f"other views use another id for {counted(len(renamed), 'id')}, and no mask shows both: {pairs}. Did a "
        f"tracker lose objects and give them new ids, or are there two names for one thing? {per_view} finds objects "
        f"whatever their ids are, and {label_map} merges names"
    )
