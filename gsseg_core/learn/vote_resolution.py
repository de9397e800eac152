"""Vote resolution: signed votes become votes of at least 0, and what is voted against only is imputed.

Masks of some classes vote against those that they looked for and did not find (`gsseg_core.data.label_evidence`).
"""

from __future__ import annotations

import numba as nb
import numpy as np

from gsseg_core.csr_rows import CSRRows
from gsseg_core.kernels.compiler import called_by_kernels, kernel

ROUNDS = 50  # of estimating how frequent classes are


def resolved_votes(votes: CSRRows, possible: np.ndarray) -> CSRRows:  # int64; (K,) bool, ids that are classes
    """Resolve signed votes into votes of at least 0; they stay as they are if none is negative.

    A class with more votes against it than for it is dropped. If all classes but one were looked for at a Gaussian,
    that one is what "none of these" means, and gets as many votes as the class that was looked for least.
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

    Where all votes are against classes, the one class without any is certain; where several of the possible have none,
    they share as `impute_probabilities` says.
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
    """Impute probabilities of Gaussians with votes only against classes: those that are left share them.

    They do so in proportion to how frequent they are in the scene, on top of the probabilities that the row has from
    its neighbours. The background is that to which no class applies, so its frequency is known only if every class was
    looked for in some view. If one never was, only neighbours count, and without them the row stays zero: unknown.
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
    """Mark the possible classes that Gaussians have no votes against, (U, K) bool."""
    candidates, against = np.tile(possible, (votes.num_rows, 1)), votes.data < 0
    candidates[votes.rows[against], votes.indices[against]] = False
    return candidates


def _frequency(
    known: np.ndarray,  # (K,) Gaussians of each class, as far as they are known
    candidates: np.ndarray,  # (U, K) bool: what each of the others may be
) -> np.ndarray:
    """Estimate how frequent each class is, (K,): the likeliest proportions, by expectation maximisation.

    One vote names an object, but the background takes a vote against every class. So it is too rare among the Gaussians
    that are known, and what the others may be has to count. (Dempster, Laird & Rubin 1977, on grouped data.)
    """
    patterns, counts = np.unique(np.packbits(candidates, axis=1), axis=0, return_counts=True)
    may_be = np.unpackbits(patterns, axis=1, count=candidates.shape[1])
    frequency = np.full(len(known), 1 / len(known))
    for _ in range(ROUNDS):
        frequency = known + counts @ _scaled(may_be * frequency)
        if not (total := frequency.sum()):
            break  # None is known, and the others may be nothing: every class has votes against it.
        frequency /= total
    return frequency


def _scaled(rows: np.ndarray) -> np.ndarray:  # (U, K)
    """Scale rows to sum 1; rows of zeros stay zero."""
    total = rows.sum(axis=1, keepdims=True)
    return np.asarray(np.divide(rows, total, out=np.zeros_like(rows), where=total > 0))


@kernel(parallel=True)
def weigh_votes(votes: CSRRows) -> tuple[np.ndarray, np.ndarray]:
    """Sum of the sizes of votes, int64, for and against classes, and the least of them and 0, (N,) int64 each."""
    indptr, _, data = votes
    total, least = np.zeros(indptr.shape[0] - 1, np.int64), np.zeros(indptr.shape[0] - 1, np.int64)
    for i in nb.prange(indptr.shape[0] - 1):
        for z in range(indptr[i], indptr[i + 1]):
            total[i] += abs(data[z])
            least[i] = min(least[i], data[z])
    return total, least


def is_resolved(votes: CSRRows, possible: np.ndarray) -> np.ndarray:  # int64; (K,) bool, ids that are classes
    """Tell which Gaussians have a vote for a class, or only one class left, (N,) bool."""
    counts, _ = _count_shares(votes, np.flatnonzero(possible))
    return np.asarray(counts > 0)


@kernel(parallel=True)
def _count_shares(votes: CSRRows, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Count the classes of each Gaussian that have a share in its probabilities, (N,) int64.

    Second comes the only class left of all, `ids`, where the votes are against all others, (N,) int32; else -1.
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
    """Return the one of all classes `ids` that a row has no votes for or against; -1 if there are more, or none."""
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
    classes: np.ndarray,  # (n,) of one row
    votes: np.ndarray,  # (n,) int64, of it
    ids: np.ndarray,  # of all classes, ascending
    kept_classes: np.ndarray,  # out; capacity for all that is kept, n + 1 at most
    kept_votes: np.ndarray,  # out, likewise
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
