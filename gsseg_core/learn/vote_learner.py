"""Votes: the sum over views of W^T onehot(y)."""

from __future__ import annotations

import numpy as np

from gsseg_core.learn.learner import Learner, Progress, silent


class VoteLearner(Learner):
    """Codes proportional to the votes. Exact, additive, one pass: what a live robot runs.

    FlashSplat (Shen et al. 2024) takes the largest entry of the same sums.
    """

    def fit(self, progress: Progress = silent) -> VoteLearner:
        """Normalise the votes."""
        self._begin()
        self.codes_, self.converged_ = self.vote_codes(), True
        self.observed_ = np.asarray(self.codes_.any(axis=1))
        return self
