"""Reliability diagrams, expected calibration error and risk by coverage: how good probabilities are."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

BINS = 15
"""Bins of equal width over the confidence, for `ReliabilityDiagram`."""

_TINY = 1e-12


class ReliabilityDiagram:
    """Reliability diagram: how often predictions are right by their confidence, accumulated over views.

    Confidences from 0 to 1 fall into `BINS` bins of equal width; 1 falls into the last one.

    Examples
    --------
    >>> import numpy as np
    >>> diagram = ReliabilityDiagram()
    >>> diagram.add(np.full(10, 0.9), np.arange(10) < 8)
    >>> round(diagram.ece, 6)
    0.1
    """

    def __init__(self) -> None:
        self._sums = np.zeros((3, BINS))  # weight, weighted confidence, weighted hits

    def add(
        self,
        confidence: np.ndarray,  # any shape, in [0, 1]
        right: np.ndarray,  # same shape; bool, or the probability of being right
        weights: np.ndarray | None = None,  # same shape
    ) -> None:
        """Add predictions, each with the weight 1 unless said otherwise."""
        sure, hits = np.ravel(confidence).astype(np.float64), np.ravel(right).astype(np.float64)
        weight = np.ones_like(sure) if weights is None else np.ravel(weights).astype(np.float64)
        bins = np.clip((sure * BINS).astype(np.int64), 0, BINS - 1)
        for total, values in zip(self._sums, (weight, weight * sure, weight * hits), strict=True):
            total += np.bincount(bins, values, BINS)

    @property
    def shares(self) -> np.ndarray:
        """Share of all predictions in each bin, (BINS,) float64."""
        shares: np.ndarray = self._sums[0] / max(self._sums[0].sum(), _TINY)
        return shares

    @property
    def confidence(self) -> np.ndarray:
        """Mean confidence in each bin, (BINS,) float64; NaN where it is empty."""
        return self._mean(self._sums[1])

    @property
    def accuracy(self) -> np.ndarray:
        """Share of right predictions in each bin, (BINS,) float64; NaN where it is empty."""
        return self._mean(self._sums[2])

    @property
    def ece(self) -> float:
        """Expected calibration error: sum over the bins of their share times |accuracy - confidence|.

        Naeini et al., AAAI 2015; NaN before the first prediction.
        """
        total = self._sums[0].sum()
        return float(np.abs(self._sums[1] - self._sums[2]).sum() / total) if total > 0 else float("nan")

    def _mean(self, sums: np.ndarray) -> np.ndarray:
        filled = self._sums[0] > 0
        mean: np.ndarray = np.divide(sums, self._sums[0], out=np.full(BINS, np.nan), where=filled)
        return mean


class RiskCoverage(NamedTuple):
    """Risk by coverage: the error of answering only where one is sure.

    Attributes
    ----------
    coverage : (P,) float64
        Share of the predictions that are kept, the surest first: 1/P to 1.
    risk : (P,) float64
        Share of these that are wrong.
    """

    coverage: np.ndarray
    risk: np.ndarray

    @property
    def area(self) -> float:
        """Area under the curve (AURC; Geifman and El-Yaniv, 2017): the mean risk over all coverages."""
        return float(self.risk.mean())


def risk_coverage(
    confidence: np.ndarray,  # (P,)
    right: np.ndarray,  # (P,) bool
) -> RiskCoverage:
    """Leave out predictions, the least sure first. Those that are equally sure count as the mean of them."""
    order = np.argsort(-confidence, kind="stable")
    _, group, size = np.unique(-confidence[order], return_inverse=True, return_counts=True)
    wrong = (np.bincount(group, ~right[order].astype(bool)) / size)[group]
    kept = np.arange(1, len(order) + 1)
    return RiskCoverage(kept / len(order), np.cumsum(wrong) / kept)
