"""Masks whose ids hold in their own view only, and how well objects that were found in them agree with the truth."""

from __future__ import annotations

import numpy as np
from matching import Contingency
from scipy import sparse

from gsseg_core.data.view import View
from gsseg_core.objects.depth_edges import Borders
from gsseg_core.objects.lifted_segments import Lifted
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


def row_of_objects(rng: np.random.Generator, split: float, merged: float) -> Lifted:
    """A view of 16 objects, 20 Gaussians each, as a generator masks them, with Gaussians that reach over edges.

    It cuts an object in two somewhere, and gives two neighbours one id, each with a probability. Borders are 20 px
    long; between objects nearly all of it is a depth edge, inside of one less than half.
    """
    owner = np.repeat(np.arange(16), 20)
    cut = np.where(rng.random(16) < split, rng.integers(3, 18, 16), 20)
    ids = np.arange(16)
    for k in range(15):
        if rng.random() < merged:
            ids[k + 1] = ids[k]
    segment = np.unique(2 * ids[owner] + (np.arange(320) % 20 >= cut[owner]), return_inverse=True)[1]
    weights = np.zeros((segment.max() + 1, 320), np.float32)
    weights[segment, np.arange(320)] = 10 + rng.random(320)
    last = np.flatnonzero(np.diff(segment))
    weights[segment[last + 1], last] += 4
    length, edges = np.zeros((2, len(weights), len(weights)), np.float32)
    for a, b in (last, last + 1), (last + 1, last):
        length[segment[a], segment[b]] = 20
        edges[segment[a], segment[b]] = np.where(owner[a] == owner[b], 8, 18)
    borders = Borders(*map(sparse.csr_matrix, (length, edges)))
    return Lifted(np.arange(1, len(weights) + 1), np.arange(320), sparse.csr_matrix(weights), borders)
