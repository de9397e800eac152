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


def impute_probabilities(
    codes: CSRRows,  # N rows of float32
    votes: np.ndarray,  # (N, K) int64
    possible: np.ndarray,  # (K,) bool: ids that are classes
    rows: np.ndarray,  # (U,) Gaussians with votes only against classes, ascending
) -> CSRRows:
    """Impute probabilities of Gaussians with votes only against classes: those that are left share them.

    They do so in proportion to how frequent they are in the scene, on top of the probabilities that the row has from
    its neighbours. The background is that to which no class applies, so its frequency is known only if every class was
    looked for in some view. If one never was, only neighbours count, and without them the row stays zero: unknown.
    """
    candidates = (votes[rows] >= 0) & possible
    left = codes.take(rows).dense(len(possible)) * candidates
    if not (possible & ~votes.any(axis=0))[1:].any():
        sure = np.ones(codes.num_rows, bool)
        sure[rows] = False
        known = codes.only(sure)
        frequent = np.bincount(known.indices, weights=known.data, minlength=len(possible))
        left += _frequency(frequent, candidates) * candidates
    imputed = np.full(codes.num_rows, -1)
    imputed[rows] = np.arange(len(rows))
    return codes.replaced(imputed, CSRRows.from_dense(_scaled(left)))


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
        frequency /= frequency.sum()
    return frequency


def _scaled(rows: np.ndarray) -> np.ndarray:  # (U, K)
    """Scale rows to sum 1; rows of zeros stay zero."""
    total = rows.sum(axis=1, keepdims=True)
    return np.asarray(np.divide(rows, total, out=np.zeros_like(rows), where=total > 0))


@kernel(parallel=True)
def is_resolved(votes: np.ndarray, possible: np.ndarray) -> np.ndarray:  # (N, K) int64; (K,) bool, ids that are classes
    """Tell which Gaussians have a vote for a class, or only one class left, (N,) bool."""
    out = np.empty(votes.shape[0], np.bool_)
    for i in nb.prange(votes.shape[0]):
        named, against, free = False, False, 0
        for k in range(votes.shape[1]):
            named |= votes[i, k] > 0
            against |= votes[i, k] < 0
            free += votes[i, k] == 0 and possible[k]
        out[i] = named or (against and free == 1)
    return out


@called_by_kernels
def _only_class_left(classes: np.ndarray, votes: np.ndarray, ids: np.ndarray) -> tuple[int, int]:
    """Return the one of all classes `ids` without votes where the others of a row have some, any against; else -1."""
    voted, least, against, place = 0, 2**63 - 1, False, 0
    for z in range(votes.shape[0]):
        if votes[z] != 0:
            voted += 1
            least = min(least, abs(votes[z]))
            against |= votes[z] < 0
            # Both ascend, so the first id that is not there is the one that is missing.
            place += place < ids.shape[0] and ids[place] == classes[z]
    return (ids[place] if against and voted == ids.shape[0] - 1 else -1), least


@called_by_kernels
def resolve_row(
    classes: np.ndarray,  # (n,) of one row
    votes: np.ndarray,  # (n,) int64, of it
    ids: np.ndarray,  # of all classes, ascending
    kept_classes: np.ndarray,  # out; capacity for all that is kept, n + 1 at most
    kept_votes: np.ndarray,  # out, likewise
) -> int:
    """Resolve the votes of one row as `resolved_votes` does; return the number of entries written."""
    free, least = _only_class_left(classes, votes, ids)
    n = 0
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
