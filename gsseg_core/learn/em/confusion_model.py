"""Error model of one view: a confusion matrix as in Dawid & Skene (1979), with a prior and outliers."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gsseg_core.data.label_evidence import LabelEvidence
from gsseg_core.data.label_images import UNKNOWN

PART_PRIOR = 3000.0
"""Weight, in px, of the prior on how the pixels of a class with one word divide into rejected regions and the rest.

For a class with few such pixels, the division of all classes together is used.
"""


@dataclass(frozen=True, eq=False)
class ErrorModel:
    """Probability of each label of one view's mask given the true class.

    Only rows of classes that the view shows are stored: a few hundred of thousands.
    """

    evidence: LabelEvidence  # of the L labels in the view's mask, in a vocabulary of W words
    num_classes: int  # K
    shown: np.ndarray  # (R,) int64: classes whose rows are stored
    rows: np.ndarray  # (R, W) float32: their rows
    other: float  # value of all entries of the other rows
    pseudo_counts: np.ndarray  # (T,) float64: a_v, px added to the count of the correct word of each class that has one
    outliers: float  # share of pixels labelled by chance
    areas: np.ndarray  # (L,) px with each label

    @classmethod
    def without_errors(
        cls, evidence: LabelEvidence, num_classes: int, outliers: float, areas: np.ndarray  # (L,) px
    ) -> ErrorModel:  # fmt: skip
        """Return the model of a segmenter whose labels are all correct."""
        classes, words = evidence.correct_words(num_classes)
        rows = np.zeros((len(classes), len(evidence.vocabulary)), np.float32)
        rows[np.arange(len(classes)), words] = 1.0
        return cls(evidence, num_classes, classes, rows, 0.0, np.zeros(len(classes)), outliers, areas)

    @classmethod
    def from_counts(
        cls, evidence: LabelEvidence, counts: np.ndarray, prior: float, outliers: float, areas: np.ndarray  # (L,) px
    ) -> ErrorModel:  # fmt: skip
        """Estimate a model from counts of predicted classes under each label, (K, L) px."""
        counts = _by_word(evidence, counts, divided=True)
        pseudo_counts = prior * counts[evidence.correct_words(len(counts))[0]].sum(axis=1)
        num_classes, num_words = counts.shape
        none = np.empty(0, np.int64), np.empty((0, num_words), np.float32)
        return cls(evidence, num_classes, *none, 1.0 / num_words, pseudo_counts, outliers, areas).m_step(counts)

    @property
    def confusion(self) -> np.ndarray:
        """Confusion matrix R_v, (K, W) float32; rows, true classes, sum to 1; columns are `evidence.vocabulary`."""
        confusion = np.full((self.num_classes, self.rows.shape[1]), self.other, np.float32)
        confusion[self.shown] = self.rows
        return confusion

    @property
    def num_pixels(self) -> int:
        """Number of pixels with an informative label."""
        return int(self.areas[self.evidence.informative].sum())

    @property
    def named_pixels(self) -> int:
        """Number of pixels whose label names a class and does not only exclude classes."""
        return int(self.areas[self.evidence.informative & (self.evidence.named() != UNKNOWN)].sum())

    @property
    def likelihood(self) -> np.ndarray:
        """Probability C_v of each label given the class, (K, L) float32."""
        words: np.ndarray = (1 - self.outliers) * self.confusion + np.float32(self.outliers / self.rows.shape[1])
        only = self.evidence.only_words
        if only is not None:
            return words.T[only].T
        plausible = self.evidence.word_plausibility
        assert plausible is not None, "labels of all masks but plain ones have some"
        return np.asarray(words @ plausible.T)

    @property
    def by_label(self) -> np.ndarray:
        """Transposed `likelihood`: C_v by label, (L, K) float32."""
        return np.ascontiguousarray(self.likelihood.T)

    def used(self, by_label: np.ndarray) -> np.ndarray:  # (L, K)
        """Return C_v by label, with zeros for labels that are not informative.

        All classes are equally likely under such a label. Its pixels would change how soon EM converges, but not to
        what.
        """
        return np.where(self.evidence.informative[:, None], by_label, np.float32(0))

    def expected_counts(self, counts: np.ndarray) -> np.ndarray:
        """Return the expected number of pixels (K, W) with each true class and each observed word.

        `counts` are the px of each class under each label, (K, L), divided by the label's likelihood.
        """
        return _by_word(self.evidence, counts) * (1 - self.outliers) * self.confusion

    def m_step(self, counts: np.ndarray) -> ErrorModel:
        """Return the model with the MAP confusion matrix for expected counts, (K, W) px; rows without counts stay.

        A rejected region is a word of its own, and also a part of the word that its pixels had before. C[k, word] is
        estimated from both together and then divided: C[k, part] = C[k, word] P(part | k, word), where P has a prior of
        `PART_PRIOR` px. So if a view gives an object the label of another one, all regions of the object count as one.
        """
        former = self.evidence.former_words
        counts = counts.astype(np.float64)
        named, parts = np.split(counts, [counts.shape[1] - len(former)], axis=1)
        np.add.at(named.T, former, parts.T)
        share = parts.sum(axis=0) / np.maximum(named.sum(axis=0)[former], 1e-9)
        share = (parts + PART_PRIOR * share) / (named[:, former] + PART_PRIOR)
        named[self.evidence.correct_words(len(counts))] += self.pseudo_counts
        total = named.sum(axis=1, keepdims=True)
        shown = total[:, 0] > 0
        words = named[shown] / total[shown]
        parts = words[:, former] * share[shown]
        np.subtract.at(words.T, former, parts.T)
        left = ~shown[self.shown]
        rows = np.concatenate([np.column_stack([words, parts]).astype(np.float32), self.rows[left]])
        return replace(self, shown=np.append(np.flatnonzero(shown), self.shown[left]), rows=rows)


def _by_word(evidence: LabelEvidence, counts: np.ndarray, *, divided: bool = False) -> np.ndarray:  # (K, L)
    """Sum the counts of each label over the words that it can mean, (K, W), weighted by plausibility.

    If `divided`, the plausibilities of a label are scaled to sum to 1.
    """
    only = evidence.only_words
    if evidence.mass is None:
        return counts
    if only is not None:  # A matrix product would spend its time, proportional to the number of words, on zeros.
        order, words = np.argsort(only, kind="stable"), np.zeros((len(evidence.vocabulary), len(counts)))
        first = np.flatnonzero(np.diff(only[order], prepend=-1))
        words[only[order][first]] = np.add.reduceat(counts.T[order], first, axis=0)
        return np.ascontiguousarray(words.T)
    plausible = evidence.word_plausibility
    assert plausible is not None, "labels of all masks but plain ones have some"
    shares = plausible[evidence.informative]
    shares = shares / shares.sum(axis=1, keepdims=True) if divided else shares
    return counts[:, evidence.informative] @ shares
