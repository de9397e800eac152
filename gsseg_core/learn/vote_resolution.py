"""Vote resolution: converts signed votes to votes of at least 0, and imputes Gaussians with votes only against classes.

Partial masks vote against classes that were looked for and not found (`gsseg_core.data.label_evidence`).
"""

from __future__ import annotations

import numba as nb
import numpy as np

from gsseg_core.csr_rows import CSRRows
from gsseg_core.kernels.compiler import called_by_kernels, kernel

ROUNDS = 50  # EM steps that estimate the frequency of classes


def resolved_votes(votes: CSRRows, possible: np.ndarray) -> CSRRows:  # int64; (K,) bool, ids that are classes
    """Resolve signed votes into votes of at least 0; votes without negative entries are returned unchanged.

    A class with more votes against it than for it is dropped. If all classes but one were looked for at a Gaussian,
    "none of these" means the remaining one, which gets as many votes as the class that was looked for least.
    """
    if votes.data.min(initial=0) >= 0:
        return votes
    rows = len(votes.indptr) - 1
    capacity = len(votes.data) + rows  # A row may gain one entry.
    out = CSRRows(votes.indptr + np.arange(rows + 1), np.empty(capacity, np.uint32), np.zeros(capacity, np.int64))
    _resolve(votes, np.flatnonzero(possible), out)
    return out.nonzero()


def vote_shares(votes: CSRRows, possible: np.ndarray) -> CSRRows:  # int64; (K,) bool, ids that are classes
    """Divide the votes for classes by their sum: probabilities, float32; rows without votes stay empty.

    If all votes of a row are against classes, and only one possible class has no votes, that class is certain. If
    several have none, `impute_probabilities` divides the row among them.
    """
    counts, only = _count_shares(votes, np.flatnonzero(possible))
    shares = CSRRows.room_for(counts, np.float32)
    _share(votes, only, shares)
    unsure = np.flatnonzero((counts == 0) & (np.diff(votes.indptr) > 0))
    return impute_probabilities(shares, votes, possible, unsure) if len(unsure) else shares


def impute_probabilities(
    codes: CSRRows,  # N rows of float32
    votes: CSRRows,  # N rows of int64, none of them zero
    possible: np.ndarray,  # (K,) bool: ids that are classes
    rows: np.ndarray,  # (U,) Gaussians with votes only against classes, ascending
) -> CSRRows:
    """Impute probabilities of Gaussians with votes only against classes, by dividing them among the other classes.

    Each of these gets the probability that the row already has from its neighbours, plus the frequency of the class in
    the scene; the row is then scaled to sum 1. The background is what no class applies to. So frequencies are known
    only if every class was looked for in some view. Otherwise only the neighbours count, and a row without them stays
    zero (unknown).
    """
    left = codes.take(rows).dense(len(possible))
    candidates = _candidates(votes.take(rows), possible)
    left *= candidates
    looked_for = np.bincount(votes.indices, minlength=len(possible)) > 0
    if not (possible & ~looked_for)[1:].any():
        sure = np.ones(codes.num_rows, bool)
        sure[rows] = False
        known = codes.only(sure)
        frequent = np.bincount(known.indices, weights=known.data, minlength=len(possible))
        left += _frequency(frequent, candidates) * candidates
    return codes.replaced_at(rows, CSRRows.from_dense(_scaled(left)))


def _candidates(votes: CSRRows, possible: np.ndarray) -> np.ndarray:  # U rows of int64, (K,) bool
    """Mark the possible classes against which a Gaussian has no votes, (U, K) bool."""
    candidates, against = np.tile(possible, (votes.num_rows, 1)), votes.data < 0
    candidates[votes.rows[against], votes.indices[against]] = False
    return candidates


def _frequency(
    known: np.ndarray,  # (K,) number of Gaussians with known class, by class
    candidates: np.ndarray,  # (U, K) bool: classes that each of the other Gaussians may have
) -> np.ndarray:
    """Estimate the frequency of each class, (K,): the likeliest proportions, by expectation maximisation.

    A single vote names an object, but background needs a vote against every class. So the background is too rare among
    the known Gaussians, and the candidates of the others must count, too (Dempster, Laird & Rubin 1977, on grouped
    data).
    """
    patterns, counts = np.unique(np.packbits(candidates, axis=1), axis=0, return_counts=True)
    may_be = np.unpackbits(patterns, axis=1, count=candidates.shape[1])
    frequency = np.full(len(known), 1 / len(known))
    for _ in range(ROUNDS):
        frequency = known + counts @ _scaled(may_be * frequency)
        if not (total := frequency.sum()):
            break  # No class is known, and the others have no candidates: votes exclude every class.
        frequency /= total
    return frequency


def _scaled(rows: np.ndarray) -> np.ndarray:  # (U, K)
    """Scale rows to the sum 1; rows of zeros stay zero."""
    total = rows.sum(axis=1, keepdims=True)
    return np.asarray(np.divide(rows, total, out=np.zeros_like(rows), where=total > 0))


@kernel(parallel=True)
def weigh_votes(votes: CSRRows) -> tuple[np.ndarray, np.ndarray]:
    """Return the sum of absolute votes of each Gaussian, and the smallest of its votes and 0, (N,) int64 each."""
    indptr, _, data = votes
    total, least = np.zeros(indptr.shape[0] - 1, np.int64), np.zeros(indptr.shape[0] - 1, np.int64)
    for i in nb.prange(indptr.shape[0] - 1):
        for z in range(indptr[i], indptr[i + 1]):
            total[i] += abs(data[z])
            least[i] = min(least[i], data[z])
    return total, least


def is_resolved(votes: CSRRows, possible: np.ndarray) -> np.ndarray:  # int64; (K,) bool, ids that are classes
    """Mark the Gaussians that have a vote for a class, or only one possible class left, (N,) bool."""
    counts, _ = _count_shares(votes, np.flatnonzero(possible))
    return np.asarray(counts > 0)


@kernel(parallel=True)
def _count_shares(votes: CSRRows, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Count the classes of each Gaussian that have a share in its probabilities, (N,) int64.

    Also returns the only class of `ids` that is left if the votes are against all others, (N,) int32; else -1.
    """
    indptr, classes, data = votes
    counts, only = np.zeros(indptr.shape[0] - 1, np.int64), np.empty(indptr.shape[0] - 1, np.int32)
    for i in nb.prange(indptr.shape[0] - 1):
        only[i] = -1
        for z in range(indptr[i], indptr[i + 1]):
            counts[i] += data[z] > 0
        if counts[i] == 0 and indptr[i] < indptr[i + 1]:
            row = slice(indptr[i], indptr[i + 1])
            only[i] = _only_class_left(classes[row], data[row], ids)
            counts[i] = only[i] >= 0
    return counts, only


@called_by_kernels
def _only_class_left(classes: np.ndarray, votes: np.ndarray, ids: np.ndarray) -> int:
    """Return the only class of `ids` without votes for or against it in a row; -1 if there are several or none."""
    found, z = -1, 0
    for place in range(ids.shape[0]):
        while z < classes.shape[0] and (classes[z] < ids[place] or votes[z] == 0):
            z += 1
        if z < classes.shape[0] and classes[z] == ids[place]:
            z += 1
        elif found >= 0:
            return -1
        else:
            found = ids[place]
    return found


@kernel(parallel=True)
def _share(votes: CSRRows, only: np.ndarray, shares: CSRRows) -> None:
    indptr, classes, data = votes
    share_indptr, share_classes, share_data = shares
    for i in nb.prange(indptr.shape[0] - 1):
        total, place = np.int64(0), share_indptr[i]
        if only[i] >= 0:
            share_classes[place], share_data[place] = only[i], 1.0
        for z in range(indptr[i], indptr[i + 1]):
            total += max(data[z], 0)
        for z in range(indptr[i], indptr[i + 1]):
            if data[z] > 0:
                share_classes[place], share_data[place] = classes[z], data[z] / total
                place += 1


@called_by_kernels
def resolve_row(
    classes: np.ndarray,  # (n,) classes of one row
    votes: np.ndarray,  # (n,) int64: their votes
    ids: np.ndarray,  # ids of all classes, ascending
    kept_classes: np.ndarray,  # out: the kept classes, with capacity for up to n + 1
    kept_votes: np.ndarray,  # out: their votes, with the same capacity
) -> int:
    """Resolve the votes of one row as `resolved_votes` does; return the number of entries written."""
    least, against, n = 2**63 - 1, False, 0
    for z in range(votes.shape[0]):
        if votes[z] != 0:
            least = min(least, abs(votes[z]))
            against |= votes[z] < 0
    free = _only_class_left(classes, votes, ids) if against else -1
    for z in range(votes.shape[0]):
        if 0 <= free < classes[z]:
            kept_classes[n], kept_votes[n] = free, least
            n, free = n + 1, -1
        if votes[z] > 0:
            kept_classes[n], kept_votes[n] = classes[z], votes[z]
            n += 1
    if free >= 0:
        kept_classes[n], kept_votes[n] = free, least
        n += 1
    return n


@kernel(parallel=True)
def _resolve(rows: CSRRows, ids: np.ndarray, kept: CSRRows) -> None:
    indptr, classes, votes = rows
    kept_indptr, kept_classes, kept_votes = kept
    for i in nb.prange(indptr.shape[0] - 1):
        row = slice(indptr[i], indptr[i + 1])
        resolve_row(classes[row], votes[row], ids, kept_classes[kept_indptr[i] :], kept_votes[kept_indptr[i] :])
