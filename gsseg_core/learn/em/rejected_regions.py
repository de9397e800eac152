"""Regions of a mask, and which of them the other views speak against.

Most errors of a segmenter sit in one place: a blob of clutter, one object under the id of another, a frame in which
everything is wrong. An error model of the whole view, which says how often each class is called what, does not explain
them. A *region* is a set of connected pixels of one label. It is held against the votes of all other views: where they
saw enough of it, and next to nothing of that is of its label to them, it is in doubt, and what it says is not heard at
all. That costs little if it was right, since others say the same, and much is won if it was wrong.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.label_evidence import LabelEvidence
from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.data.soft_masks import SeenLabels
from gsseg_core.learn.em.em_kernels import take_votes
from gsseg_core.learn.em.leave_one_out import counted_by_others
from gsseg_core.learn.learner import UNITS
from gsseg_core.raster.observation import Observation

SMALLEST = 64
"""Regions of fewer px are not told apart: all of one label are judged as one."""

COVERED = 0.25
"""Share of a region, by weight, that the other views must have seen as well as this one for it to be in doubt."""

MOST = 500
"""Regions of a mask that are told apart at most, the largest; what is left of each label is judged as one."""


def by_region(seen: SeenLabels) -> SeenLabels:
    """Give every region of a mask a label of its own, which means the class that it had; a soft mask stays as it is."""
    if seen.evidence is not None or not (seen.labels >= 0).any():
        return seen
    connected, first, area = connected_pixels(seen.labels)
    label = seen.labels.ravel()[first]
    alone = np.zeros(len(area), bool)
    alone[np.argsort(-area, kind="stable")[:MOST]] = True
    alone &= area >= SMALLEST
    classes, position = np.unique(label, return_inverse=True)
    # Those that stand alone keep a number each; the others have that of their class.
    regions = np.unique(np.where(alone, len(classes) + np.arange(len(area)), position), return_inverse=True)[1]
    mass = np.zeros((int(regions.max()) + 1, len(classes)), np.float32)
    mass[regions, position] = 1
    labels = np.append(regions, UNKNOWN).astype(np.int32)[connected]
    return SeenLabels(labels, LabelEvidence(classes.astype(np.int32), mass))


def connected_pixels(
    labels: np.ndarray,  # (H, W) int32
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Give sets of pixels of one label that are connected over sides numbers, in the order of their first pixels.

    Returns
    -------
    connected : (H, W) int32
        `UNKNOWN` (-1) where the label is negative.
    first : (R,) int64
        The first pixel of each set, counted row by row.
    area : (R,) int64
        Pixels of each set.
    """
    connected = np.empty(labels.shape, np.int32)
    first, area = _connect(np.ascontiguousarray(labels), connected)
    return connected, first, area


def in_doubt(
    votes: CSRRows,  # int64, of all views
    observation: Observation,
    possible: np.ndarray,  # (K,) bool: ids that are classes
    least: float,
) -> np.ndarray:
    """Tell which labels of a view the others speak against, (L,) bool; none where a label may mean several classes.

    A Gaussian that this view saw better than all others together, says as much for a class as they saw of it, and no
    more: what shows through a gap somewhere else is no witness. Where they saw too little of a region, it is heard.

    Parameters
    ----------
    votes, observation, possible
        As in `counted_by_others`.
    least : float
        Share of what lies under a label, by weight, that has to be of its class by the votes of the others.
    """
    evidence = observation.evidence
    if not evidence.is_certain:
        return np.zeros(len(observation.classes), bool)
    counts = counted_by_others(votes, observation, possible, evidence, most=1)
    label = np.arange(len(evidence.informative))
    covered = counts.sum(axis=0)
    enough = covered >= COVERED * np.bincount(observation.labels, weights=observation.votes(), minlength=len(label))
    doubtful: np.ndarray = enough & (counts[evidence.named(), label] < least * covered)
    return doubtful


def take_back(
    doubtful: np.ndarray,  # (L,) bool
    votes: CSRRows,  # int64, of all views
    observation: Observation,
    total: np.ndarray,  # (Z,) int64, changed in place
) -> None:
    """Take what a view has voted with some of its labels away from a total of the same rows as the votes."""
    order, said = observation.order, observation.evidence.without(~doubtful).votes
    ids = observation.ids[order]
    seen = order, observation.start, observation.labels
    take_votes(votes.indptr[ids], votes.indptr[ids + 1], votes.indices, total, *seen, *said, observation.votes(), UNITS)


@nb.njit(nogil=True, cache=True)
def _root(parent: np.ndarray, i: int) -> int:
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@nb.njit(nogil=True, cache=True)
def _connect(
    labels: np.ndarray,  # (H, W)
    connected: np.ndarray,  # (H, W) int32 out
) -> tuple[np.ndarray, np.ndarray]:
    """Write the numbers, return first pixels and areas. Runs of equal pixels are joined to those of the row above."""
    height, width = labels.shape
    parent = np.empty(height * width, np.int32)  # of runs; there are at most as many as pixels
    begin = np.empty(height * width, np.int32)
    runs = 0
    for y in range(height):
        for x in range(width):
            if labels[y, x] < 0:
                connected[y, x] = -1
                continue
            joined = x > 0 and labels[y, x] == labels[y, x - 1]
            if not joined:
                parent[runs], begin[runs] = runs, y * width + x
                runs += 1
            connected[y, x] = run = runs - 1
            # Once for each stretch in which the two rows go along with each other.
            if y > 0 and labels[y, x] == labels[y - 1, x] and not (joined and labels[y - 1, x - 1] == labels[y, x]):
                one, two = _root(parent, run), _root(parent, connected[y - 1, x])
                parent[max(one, two)] = min(one, two)
    many = 0
    number, first = np.empty(runs, np.int32), np.empty(runs, np.int64)
    for run in range(runs):
        root = _root(parent, run)
        if root == run:
            number[run], first[many] = many, begin[run]
            many += 1
        else:
            number[run] = number[root]
    area = np.zeros(many, np.int64)
    for y in range(height):
        for x in range(width):
            if connected[y, x] >= 0:
                connected[y, x] = number[connected[y, x]]
                area[connected[y, x]] += 1
    return first[:many].copy(), area
