"""What lies under each label of a view by the votes of all other views, counted without this one's own say."""

from __future__ import annotations

import numba as nb
import numpy as np

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.label_evidence import LabelEvidence, resolve_row
from gsseg_core.learn.em.em_kernels import BLOCKS, take_row
from gsseg_core.learn.learner import UNITS
from gsseg_core.raster.observation import Observation


def counted_by_others(
    votes: CSRRows,  # int64, of all views
    observation: Observation,
    possible: np.ndarray,  # (K,) bool: ids that are classes
    evidence: LabelEvidence,
    power: float = 1.0,
    most: float = np.inf,
) -> np.ndarray:
    """Count the pixels (K, L) of each class under each label of a view, by the votes of all the others.

    Parameters
    ----------
    votes : CSRRows
        Of all views, this one among them.
    observation : Observation
        The view.
    possible : (K,) bool
        Ids that are classes.
    evidence : LabelEvidence
        What the view has voted with.
    power : float
        Codes are raised to it, and scaled to sum 1 again, before they are counted: above 1, majorities stand out.
    most : float
        A Gaussian counts at most so many times the pixels that the others saw of it.
    """
    return _count(
        *votes, observation.order, observation.ids, observation.start, observation.labels, observation.votes(),
        *evidence.votes, np.flatnonzero(possible), power, most, len(possible), len(observation.classes),
    )  # fmt: skip


@nb.njit(nogil=True, cache=True)
def _raised(x: np.float32, power: float) -> np.float32:
    """Return x ** power in float32, of a whole power by products."""
    result, factor, left = np.float32(1), x, int(power)
    if power != left:
        return np.float32(x**power)
    while left:
        if left & 1:
            result *= factor
        factor, left = factor * factor, left >> 1
    return result


@nb.njit(parallel=True, nogil=True, cache=True)
def _count(
    rows: np.ndarray,  # (N + 1,) votes of all views, as `CSRRows`
    classes: np.ndarray,  # (Z,)
    votes: np.ndarray,  # (Z,) int64
    order: np.ndarray,  # (M,) in which to go through the Gaussians
    ids: np.ndarray,  # (M,)
    start: np.ndarray,  # (M + 1,)
    labels: np.ndarray,  # (P,)
    own: np.ndarray,  # (P,) float32, px
    said_start: np.ndarray,  # (L + 1,) what a pixel of each label votes, as `CSRRows`
    said_classes: np.ndarray,
    said: np.ndarray,  # float64
    possible: np.ndarray,  # ids that are classes, ascending
    power: float,
    most: float,
    num_classes: int,
    num_labels: int,
) -> np.ndarray:
    """Count as `counted_by_others`, all of it row by row, so that no array of the others' votes is ever made."""
    parts = np.zeros((BLOCKS, num_classes, num_labels))
    for block in nb.prange(BLOCKS):
        part = parts[block]
        which, others = np.empty(num_classes + 1, np.uint32), np.empty(num_classes + 1, np.int64)
        kept_which, kept_others = np.empty_like(which), np.empty_like(others)
        codes = np.empty(num_classes + 1, np.float32)
        for i in range(order.shape[0] * block // BLOCKS, order.shape[0] * (block + 1) // BLOCKS):
            m = order[i]
            first, many = rows[ids[m]], rows[ids[m] + 1] - rows[ids[m]]
            for z in range(many):
                which[z], others[z] = classes[first + z], votes[first + z]
            mine = slice(start[m], start[m + 1])
            take_row(which[:many], others[:many], labels[mine], said_start, said_classes, said, own[mine], UNITS)
            least = np.int64(0)
            for z in range(many):
                least = min(least, others[z])
            if least < 0:
                many = resolve_row(which[:many], others[:many], possible, kept_which, kept_others)
                which[:many], others[:many] = kept_which[:many], kept_others[:many]
            total, largest = np.int64(0), np.int64(0)
            for z in range(many):
                total += others[z]
                largest = max(largest, others[z])
            if total == 0:
                continue
            raised, seen = np.float32(0), np.float64(0)
            for z in range(many):  # As shares of the largest, of which some power is never lost to rounding.
                codes[z] = _raised(np.float32(others[z]) / np.float32(largest), power)
                raised += codes[z]
            for s in range(start[m], start[m + 1]):
                seen += own[s]
            share = np.float32(min(1.0, most * total / max(seen * UNITS, 1.0))) / raised
            for s in range(start[m], start[m + 1]):
                for z in range(many):
                    part[which[z], labels[s]] += own[s] * share * codes[z]
    counts: np.ndarray = parts.sum(axis=0)
    return counts
