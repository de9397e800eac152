"""What a view's segmenter calls each class: the error model of `gsseg_core.learn.em.em_learner`, of one view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsseg_core.data.label_evidence import LabelEvidence


@dataclass
class ErrorModel:
    """What one view's segmenter calls each class.

    Attributes
    ----------
    evidence : LabelEvidence
        Of the L labels that occur in the view's mask; they are made of W words.
    confusion : (K, W) float32
        R_v: rows are true classes, columns the words seen; rows sum to 1.
    right : (T,) float64
        a_v of the classes that have a right word, in px.
    outliers : float
        Share of pixels labelled by chance.
    num_pixels : int
        Pixels with a label that says something.
    """

    evidence: LabelEvidence
    confusion: np.ndarray
    right: np.ndarray
    outliers: float
    num_pixels: int

    @classmethod
    def trusting(cls, evidence: LabelEvidence, num_classes: int, outliers: float, num_pixels: int) -> ErrorModel:
        """Believe that every label is right."""
        confusion = np.zeros((num_classes, len(evidence.vocabulary)), np.float32)
        right = evidence.correct_words(num_classes)
        confusion[right] = 1.0
        return cls(evidence, confusion, np.zeros(len(right[0])), outliers, num_pixels)

    @classmethod
    def from_counts(
        cls,
        evidence: LabelEvidence,
        counts: np.ndarray,  # (K, L) px of each class under each label
        prior: float,
        outliers: float,
        num_pixels: int,
    ) -> ErrorModel:
        """Start from what the codes so far say of the mask."""
        if evidence.word_plausibility is not None:
            shares = evidence.word_plausibility[evidence.informative]
            counts = counts[:, evidence.informative] @ (shares / shares.sum(axis=1, keepdims=True))
        right = prior * counts[evidence.correct_words(len(counts))[0]].sum(axis=1)
        uniform = np.full(counts.shape, 1.0 / len(evidence.vocabulary), np.float32)
        model = cls(evidence, uniform, right, outliers, num_pixels)
        model.maximise(counts)
        return model

    @property
    def classes(self) -> np.ndarray:
        """The words seen, (W,) int32: classes, and then `UNKNOWN` (-1) for "none of these", if it occurs."""
        return self.evidence.vocabulary

    @property
    def likelihood(self) -> np.ndarray:
        """C_v: probability of each label given the class, (K, L) float32."""
        words: np.ndarray = (1 - self.outliers) * self.confusion + np.float32(self.outliers / len(self.classes))
        plausible = self.evidence.word_plausibility
        return words if plausible is None else np.asarray(words @ plausible.T)

    @property
    def told(self) -> tuple[np.ndarray, np.ndarray]:
        """The same by label, (L, K) float32; and then with zeros where a label says nothing: its pixels teach nothing.

        All classes are as plausible there, so they would not change where the steps end, only how soon they do.
        """
        likelihood = np.ascontiguousarray(self.likelihood.T)
        return likelihood, np.where(self.evidence.informative[:, None], likelihood, np.float32(0))

    def expected(
        self,
        counts: np.ndarray,  # (K, L) sum of the shares of each class under each label
    ) -> np.ndarray:
        """Count the pixels (K, W) in which each class was there and each word was meant."""
        if self.evidence.word_plausibility is not None:
            counts = counts[:, self.evidence.informative] @ self.evidence.word_plausibility[self.evidence.informative]
        expected: np.ndarray = counts * (1 - self.outliers) * self.confusion
        return expected

    def maximise(
        self,
        counts: np.ndarray,  # (K, W) expected px
    ) -> None:
        """Set R_v to its best for expected counts; classes that the view does not show keep their row."""
        counts = counts.astype(np.float64)
        counts[self.evidence.correct_words(len(counts))] += self.right
        total = counts.sum(axis=1, keepdims=True)
        shown = total[:, 0] > 0
        self.confusion[shown] = counts[shown] / total[shown]
