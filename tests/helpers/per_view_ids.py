"""Masks whose ids hold in their own view only, and how well objects that were found in them agree with the truth."""

from __future__ import annotations

import numpy as np
from matching import Contingency

from gsseg_core.data.view import View
from gsseg_core.objects.object_table import ObjectTable


def with_labels(view: View, labels: np.ndarray) -> View:
    return View.from_arrays(view.camera, labels)


def shuffled(view: View, seed: int = 0, keep: tuple[int, ...] = (0,)) -> View:
    """The view under ids of its own; some ids stay."""
    labels = view.read_labels()
    rng = np.random.default_rng([seed, *view.name.encode()])
    table: np.ndarray = np.arange(labels.max() + 1)
    moved = np.setdiff1d(table, keep)
    table[moved] = rng.choice(np.arange(1, 200), len(moved), replace=False)
    return with_labels(view, np.where(labels < 0, labels, table[np.maximum(labels, 0)]))


def in_halves(view: View, label: int) -> View:
    """The object under two ids, cut down the middle."""
    labels = view.read_labels().copy()
    rows, columns = np.nonzero(labels == label)
    right = columns > np.median(columns)
    labels[rows[right], columns[right]] = 50 + label
    return with_labels(view, labels)


def agreement(table: ObjectTable, views: list[View]) -> float:
    """ARI of what the ids were found to mean against true labels."""
    score = Contingency()
    for view in views:
        score.add(view.read_labels(), table.relabelled(view).read_labels())
    return score.ari
