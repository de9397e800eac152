"""Label evidence: what each label of a mask says of the classes, as a belief function.

A label of a plain mask is a class. In general a label is a *prototype* of pixels with the same evidence: a mass m_c on
each of some classes, and what is left of 1, the rest r, on a set of classes A (a belief function, Shafer 1976). Where
the segmenter looked for all classes, A is all of them: the rest is ignorance. Where it looked only for the classes S, A
is all others: the rest says "none of these", and not which other one. How plausible a class is, the sum of the masses
of all sets that it is in, is the label's likelihood, and all that learning asks:

    pl(c) = m_c + r [c in A].

The segmenter's *vocabulary* is what it can answer: the classes that have a mass, and "none of these" if some label says
so. Confusion matrices have a column for each word of it, so they do not grow with the number of prototypes. A nameless
label, one whose class is no longer believed, is a word of its own: it votes for no class, but its pixels still belong
together, and the confusion matrix tells which class they are of. Votes go to the classes that a label names, m_c; the
rest is a vote for no class, but counts against those that were looked for and not found, m_c - r [c in S].
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from gsseg_core.csr_rows import CSRRows, starts
from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.kernels.compiler import called_by_kernels

VOTE_UNIT = 2.0**-24  # votes are counted in whole multiples of this many px, so that adding and taking back are exact
UNITS = 1 / VOTE_UNIT  # units per px


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
        if self.supervised is not None:
            return False
        return self.mass is None or bool((self.mass.max(axis=1, initial=0) == 1).all())

    @cached_property
    def informative(self) -> np.ndarray:
        """Whether a label holds any evidence, (L,) bool."""
        if self.mass is None or self.supervised is not None:
            return np.ones(len(self.rest), bool)
        return np.asarray(self.mass.any(axis=1))

    def without_names(self, labels: np.ndarray) -> LabelEvidence:  # (L,) bool
        """Make these labels of a mask that `is_certain` nameless; `named` still tells their class."""
        mass = np.eye(len(self.classes), dtype=np.float32) if self.mass is None else self.mass
        return LabelEvidence(self.classes, mass, nameless=labels)

    @cached_property
    def former_words(self) -> np.ndarray:
        """Word of the class that each nameless label had, (V,) int64: its position in the vocabulary."""
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
    def only_words(self) -> np.ndarray | None:
        """Position of the one word that each label means, (L,) int64; None for masks that are soft or partial."""
        if self.mass is None:
            return np.arange(len(self.classes))
        if not self.is_certain or (np.count_nonzero(self.mass, axis=1) > 1).any():
            return None
        words = self.mass.argmax(axis=1)
        if self.nameless is not None:
            words[self.nameless] = len(self.classes) + np.arange(np.count_nonzero(self.nameless))
        return words

    @cached_property
    def votes(self) -> CSRRows:
        """Votes of a pixel of each label: the mass of a class, less the rest if it was looked for; float64."""
        if self.mass is None:
            return CSRRows(np.arange(len(self.classes) + 1), self.classes.astype(np.uint32), np.ones(len(self.classes)))
        if self.only_words is not None:  # Tables of thousands of labels take long to look through.
            named = self.only_words < len(self.classes)  # The others are nameless.
            classes = self.classes[self.only_words[named]].astype(np.uint32)
            return CSRRows(starts(named), classes, np.ones(len(classes)))
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


@called_by_kernels
def vote_units(weight: np.float32, votes: np.float64) -> np.int64:
    """Round a (Gaussian, label) pair's votes for a class to whole units; all code rounds here, so sums stay exact."""
    return np.int64(np.rint(np.float64(weight) * votes * UNITS))
