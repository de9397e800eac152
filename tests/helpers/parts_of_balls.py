"""Views of the balls on a table under ids of their own, in which the first ball comes whole or in halves."""

from __future__ import annotations

import numpy as np
from per_view_ids import shuffled, with_labels
from small_scenes import NUM_CLASSES, balls_on_a_table, clean_views, true_labels

from gsseg_core.data.object_tree import ObjectTree
from gsseg_core.data.view import View

SCENE, TRUTH = balls_on_a_table()
TOP = 10 + NUM_CLASSES


def halved(ball: int) -> np.ndarray:
    """True labels with the upper half of a ball under a number of its own."""
    of_ball = ball == TRUTH
    high = SCENE.means[:, 2] > np.median(SCENE.means[of_ball, 2])
    return np.where(of_ball & high, TOP, TRUTH)


def seen_as(view: View, truth: np.ndarray) -> View:
    """The view of what has these labels, under ids of its own."""
    return shuffled(with_labels(view, true_labels(SCENE, truth, view.camera)))


def views_in_halves(count: int = 12) -> list[View]:
    """Every second view shows the first ball in halves."""
    return [seen_as(view, halved(1) if i % 2 else TRUTH) for i, view in enumerate(clean_views(count))]


def tree_of_balls() -> ObjectTree:
    """The first ball has two halves, 4 and 5; the other two make a whole, 6."""
    parents, agreement = [-1, -1, 6, 6, 1, 1, -1], [1, 0.7, 1, 1, 1, 1, 0.3]
    leaves = np.where(TRUTH == 1, np.where(halved(1) == TOP, 5, 4), TRUTH).astype(np.int32)
    return ObjectTree(np.array(parents, np.int32), np.array(agreement, np.float32), leaves, NUM_CLASSES, 0.5)
