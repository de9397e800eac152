"""Label evidence: what each label of a mask says of the classes, as a belief function, and votes resolved from it.

A label of a plain mask is a class. In general a label is a *prototype* of pixels with the same evidence: a mass m_c on
each of some classes, and what is left of 1, the rest r, on a set of classes A (a belief function, Shafer 1976). Where
the segmenter looked for all classes, A is all of them: the rest is ignorance. Where it looked only for the classes S, A
is all others: the rest says "none of these", and not which other one. How plausible a class is, the sum of the masses
of all sets that it is in, is the label's likelihood, and all that learning asks:

    pl(c) = m_c + r [c in A].

The segmenter's *vocabulary* is what it can answer: the classes that have a mass, and "none of these" if some label says
so. Confusion matrices have a column for each word of it, so they do not grow with the number of prototypes. A label
that has lost its name is a word of its own: no vote for any class, but its pixels still belong together, and the
confusion matrix tells which class they are of. Votes go to the classes that a label names, m_c; the rest is a vote for
no class, but counts against those that were looked for and not found, m_c - r [c in S].
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numba as nb
import numpy as np

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.kernels.compiler import called_by_kernels, kernel

_ROUNDS = 50


@dataclass(frozen=True, eq=False)
class LabelEvidence:
    """Evidence of each label of one mask on the classes, which stand in ascending order.

    Rows of `mass` sum to at most 1; it is None where label l is class l, for certain. All classes that have a mass are
    among those that were looked for, `supervised`, None for all.
    """

    classes: np.ndarray  # (C,) int32: those that some label names
    mass: np.ndarray | None = None  # (L, C) float32, of each class under each label
    supervised: np.ndarray | None = None  # (S,) int32
    nameless: np.ndarray | None = None  # (L,) bool: labels that are words of their own; None if there is none

    @cached_property
    def rest(self) -> np.ndarray:
        """Mass of each label on no class in particular, (L,) float32."""
        if self.mass is None:
            return np.zeros(len(self.classes), np.float32)
        return np.asarray(np.maximum(1 - self.mass.sum(axis=1), 0))

    @cached_property
    def has_none_of_these(self) -> bool:
        """Whether some label means "none of the classes that were looked for"."""
        return self.supervised is not None and bool((self.rest > 0).any())

    @cached_property
    def is_certain(self) -> bool:
        """Whether every label names one class, for certain, and all classes were looked for."""
        if self.mass is None or self.supervised is not None:
            return self.supervised is None
        return bool((self.mass.max(axis=1, initial=0) == 1).all())

    @cached_property
    def informative(self) -> np.ndarray:
        """Whether a label holds any evidence, (L,) bool."""
        if self.mass is None or self.supervised is not None:
            return np.ones(len(self.rest), bool)
        return np.asarray(self.mass.any(axis=1))

    def without_names(self, labels: np.ndarray) -> LabelEvidence:  # (L,) bool
        """Make these labels words of their own, of a mask that `is_certain`; `named` still tells what they were."""
        mass = np.eye(len(self.classes), dtype=np.float32) if self.mass is None else self.mass
        return LabelEvidence(self.classes, mass, nameless=labels)

    @cached_property
    def former_words(self) -> np.ndarray:
        """Word that each nameless label was before, (V,) int64: its position in the vocabulary."""
        return np.searchsorted(self.classes, self.named()[self.nameless] if self.nameless is not None else [])

    @property
    def vocabulary(self) -> np.ndarray:
        """Words that the segmenter uses, (W,) int32: classes, then `UNKNOWN` (-1) for each other one.

        Those are "none of these", if it occurs, or the nameless labels in their order.
        """
        others = len(self.former_words) + self.has_none_of_these
        return np.append(self.classes, np.full(others, UNKNOWN, np.int32))

    @cached_property
    def word_plausibility(self) -> np.ndarray | None:
        """Plausibility of each word under each label, (L, W) float32; None where label l is word l."""
        if self.mass is None:
            return None
        if self.nameless is not None:
            own = np.eye(len(self.mass), dtype=np.float32)[:, self.nameless]
            return np.column_stack([np.where(self.nameless[:, None], np.float32(0), self.mass), own])
        if self.supervised is None:
            return np.asarray(self.mass + self.rest[:, None])
        return np.column_stack([self.mass, self.rest]) if self.has_none_of_these else self.mass

    @cached_property
    def votes(self) -> CSRRows:
        """Votes of a pixel of each label: the mass of a class, less the rest if it was looked for; float64."""
        if self.mass is None:
            return CSRRows(np.arange(len(self.classes) + 1), self.classes.astype(np.uint32), np.ones(len(self.classes)))
        votes = np.zeros((len(self.mass), len(self.concerned)))
        votes[:, np.searchsorted(self.concerned, self.classes)] = self.mass
        if self.supervised is not None:
            votes -= self.rest[:, None].astype(np.float64)
        if self.nameless is not None:
            votes[self.nameless] = 0
        rows = CSRRows.from_dense(votes)
        return CSRRows(rows.indptr, self.concerned[rows.indices].astype(np.uint32), rows.data)

    @property
    def concerned(self) -> np.ndarray:
        """Classes on which the mask has evidence, (S,) int32 ascending."""
        return self.classes if self.supervised is None else self.supervised

    @property
    def largest(self) -> int:
        """Largest class on which the mask has evidence, `UNKNOWN` if there is none."""
        return int(self.concerned.max(initial=UNKNOWN))

    def correct_words(self, num_classes: int) -> tuple[np.ndarray, np.ndarray]:
        """Pair classes (T,) with positions (T,) of their correct word in the vocabulary, for classes that have one.

        A class that was not looked for is rightly called "none of these". One that was looked for, and does not occur,
        has no word.
        """
        own = np.arange(len(self.classes))
        if not self.has_none_of_these:
            return self.classes, own
        others = np.setdiff1d(np.arange(num_classes, dtype=np.int32), self.concerned)
        return np.append(self.classes, others), np.append(own, np.full(len(others), len(self.classes)))

    def plausibility(self, num_classes: int) -> np.ndarray:
        """Plausibility of each class under each label, from a segmenter that makes no errors: (L, K) float32."""
        classes, words = self.correct_words(num_classes)
        given = self.word_plausibility
        by_word = np.eye(len(self.vocabulary), dtype=np.float32) if given is None else given
        out = np.zeros((len(by_word), num_classes), np.float32)
        if self.mass is not None and self.supervised is None:
            out += self.rest[:, None]
        out[:, classes] = by_word[:, words]
        return out

    def named(self) -> np.ndarray:
        """Find the class of most mass for each label, (L,) int32; `UNKNOWN` where the rest weighs more."""
        if self.mass is None:
            return self.classes
        if not len(self.classes):
            return np.full(len(self.mass), UNKNOWN, np.int32)
        is_named = self.mass.max(axis=1) >= self.rest
        return np.where(is_named, self.classes[self.mass.argmax(axis=1)], np.int32(UNKNOWN))


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
    codes: np.ndarray,  # (N, K) float32, changed in place
    votes: np.ndarray,  # (N, K) int64
    possible: np.ndarray,  # (K,) bool: ids that are classes
    rows: np.ndarray | None = None,  # Gaussians with votes only against classes; found if not given
) -> None:
    """Impute probabilities of Gaussians with votes only against classes: those that are left share them.

    They do so in proportion to how frequent they are in the scene, on top of the probabilities that the row has from
    its neighbours. The background is that to which no class applies, so its frequency is known only if every class was
    looked for in some view. If one never was, only neighbours count, and without them the row stays zero: unknown.
    """
    if rows is None:
        rows = np.flatnonzero(~codes.any(axis=1) & votes.any(axis=1))
    candidates = (votes[rows] >= 0) & possible
    left = codes[rows] * candidates
    if not (possible & ~votes.any(axis=0))[1:].any():
        sure = np.ones(len(codes), bool)
        sure[rows] = False
        left += _frequency(codes[sure].sum(axis=0, dtype=np.float64), candidates) * candidates
    codes[rows] = _scaled(left)


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
    for _ in range(_ROUNDS):
        frequency = known + counts @ _scaled(may_be * frequency)
        frequency /= frequency.sum()
    return frequency


def _scaled(rows: np.ndarray) -> np.ndarray:  # (U, K)
    """Scale rows to sum 1; rows of zeros stay zero."""
    total = rows.sum(axis=1, keepdims=True)
    return np.asarray(np.divide(rows, total, out=np.zeros_like(rows), where=total > 0))


@called_by_kernels
def vote_units(weight: np.float32, votes: np.float64, units: float) -> np.int64:
    """Round a (Gaussian, label) pair's votes for a class to whole units: everywhere the same, so sums stay exact."""
    return np.int64(np.rint(np.float64(weight) * votes * units))


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
