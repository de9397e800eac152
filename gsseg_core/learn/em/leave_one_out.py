"""Leave-one-out class counts: the pixels of each class under each label of a view, by the votes of all other views."""

from __future__ import annotations

import numba as nb
import numpy as np

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.label_evidence import LabelEvidence, vote_units
from gsseg_core.kernels.compiler import called_by_kernels, kernel
from gsseg_core.learn.em.em_kernels import BLOCKS, pairs_of
from gsseg_core.learn.learner import UNITS
from gsseg_core.learn.vote_resolution import resolve_row
from gsseg_core.raster.observation import Observation, ViewPairs


def leave_one_out_counts(
    votes: CSRRows,  # int64, of all views, this one among them
    observation: Observation,
    possible: np.ndarray,  # (K,) bool: ids that are classes
    evidence: LabelEvidence,  # which the view has voted with
    power: float = 1.0,
    most: float = np.inf,
) -> np.ndarray:
    """Count the pixels (K, L) of each class under each label of a view by the votes of all other views.

    Probabilities are raised to a power, and normalised, before they are counted: above 1, majorities stand out. A
    Gaussian counts at most `most` times the pixels that the other views saw of it.
    """
    pairs, own, class_ids = pairs_of(observation), observation.votes(), np.flatnonzero(possible)
    parts = np.zeros((BLOCKS, len(possible), evidence.votes.indptr.shape[0] - 1))
    _count(votes, pairs, own, evidence.votes, class_ids, power, most, parts)
    return np.asarray(parts.sum(axis=0))


def subtract_votes(total: CSRRows, observation: Observation, label_votes: CSRRows) -> None:
    """Subtract one view's votes, by `LabelEvidence.votes`, from those of all, N rows of int64, in place."""
    _subtract_votes(total, pairs_of(observation), observation.votes(), label_votes)


@kernel(parallel=True)
def _subtract_votes(total: CSRRows, pairs: ViewPairs, own: np.ndarray, label_votes: CSRRows) -> None:
    indptr, classes, data = total
    ids, start, labels = pairs
    for m in nb.prange(ids.shape[0]):
        _subtract_row(
            classes, data, indptr[ids[m]], indptr[ids[m] + 1], labels, own, start[m], start[m + 1], label_votes
        )


@called_by_kernels
def _subtract_row(
    classes: np.ndarray, total: np.ndarray, first: int, last: int,  # of these, the row of one Gaussian
    labels: np.ndarray, own: np.ndarray, begin: int, end: int,  # of these, its pairs
    label_votes: CSRRows,
) -> None:  # fmt: skip
    """Subtract one view's votes from the row of one Gaussian, rounded as when they were added."""
    indptr, vote_classes, votes = label_votes
    for s in range(begin, end):
        for j in range(indptr[labels[s]], indptr[labels[s] + 1]):
            for z in range(first, last):
                if classes[z] == vote_classes[j]:
                    total[z] -= vote_units(own[s], votes[j], UNITS)


@called_by_kernels
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


@kernel(parallel=True)
def _count(
    votes: CSRRows, pairs: ViewPairs, own: np.ndarray, label_votes: CSRRows, class_ids: np.ndarray,
    power: float, most: float, parts: np.ndarray,
) -> None:  # fmt: skip
    """Count as `leave_one_out_counts` does, row by row, so that the votes of the other views are never stored.

    The counts are the sum of `parts`, (BLOCKS, K, L) float64, which come as zeros. The ids of classes are ascending;
    other arrays are those of `_subtract_votes`.
    """
    indptr, classes, data = votes
    ids, start, labels = pairs
    num_classes = parts.shape[1]
    for block in nb.prange(BLOCKS):
        part = parts[block]
        which, remaining = np.empty(num_classes + 1, np.uint32), np.empty(num_classes + 1, np.int64)
        kept_which, kept_votes = np.empty_like(which), np.empty_like(remaining)
        codes = np.empty(num_classes + 1, np.float32)
        for m in range(ids.shape[0] * block // BLOCKS, ids.shape[0] * (block + 1) // BLOCKS):
            first, count = indptr[ids[m]], indptr[ids[m] + 1] - indptr[ids[m]]
            for z in range(count):
                which[z], remaining[z] = classes[first + z], data[first + z]
            _subtract_row(which, remaining, 0, count, labels, own, start[m], start[m + 1], label_votes)
            least = np.int64(0)
            for z in range(count):
                least = min(least, remaining[z])
            if least < 0:
                count = resolve_row(which[:count], remaining[:count], class_ids, kept_which, kept_votes)
                which[:count], remaining[:count] = kept_which[:count], kept_votes[:count]
            total, largest = np.int64(0), np.int64(0)
            for z in range(count):
                total += remaining[z]
                largest = max(largest, remaining[z])
            if total == 0:
                continue
            raised, pixels = np.float32(0), np.float64(0)
            for z in range(count):  # As shares of the largest, of which some power is never lost to rounding.
                codes[z] = _raised(np.float32(remaining[z]) / np.float32(largest), power)
                raised += codes[z]
            for s in range(start[m], start[m + 1]):
                pixels += own[s]
            share = np.float32(min(1.0, most * total / max(pixels * UNITS, 1.0))) / raised
            for s in range(start[m], start[m + 1]):
                for z in range(count):
                    part[which[z], labels[s]] += own[s] * share * codes[z]
