"""The learner by votes: class probabilities are the normalised sum over views of W^T onehot(y)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsseg_core.data.view import View
from gsseg_core.learn.learner import Learner, Progress, silent
from gsseg_core.learn.usable_views import read_mask
from gsseg_core.scene.camera import Camera


class VoteLearner(Learner):
    """Class probabilities proportional to the votes. Exact, additive, one pass: what a live robot runs.

    FlashSplat (Shen et al. 2024) takes the largest entry of the same sums.
    """

    leaves_out = True

    def fit(self, progress: Progress = silent) -> VoteLearner:
        """Normalise the votes."""
        self._require_views()
        self.code_rows_, self.converged_ = self.vote_rows(), True
        self.observed_ = self.code_rows_.known()
        return self

    def move(self, name: str, camera: Camera) -> None:
        """Have a view seen from another camera: its votes are taken back, and those from there are added.

        A view that sees nothing of the scene from there stays, without votes. On any error, nothing has changed.
        """
        before = self._observed(name)
        after, seen = replace(before, camera=camera), read_mask(before, self.num_classes)
        self._lift(after, seen, 1)
        try:
            self._lift(before, seen, -1)
        except BaseException:  # Too little memory.
            self._lift(after, seen, -1)
            raise
        self.views[name] = after
        self._prepared.drop(name)

    def relabel(self, view: View) -> None:
        """Have a view show other labels, seen from where it is: its operator is made once for both.

        On any error, nothing has changed.
        """
        before, view = self._observed(view.name), view.held()
        after, earlier = (read_mask(each, self.num_classes) for each in (view, before))
        operator = self._operator_of(view)
        self._lift(view, after, 1, operator)
        try:
            self._lift(before, earlier, -1, operator)
        except BaseException:  # Too little memory.
            self._lift(view, after, -1, operator)
            raise
        self.views[view.name] = view
        self._prepared.drop(view.name)

    def predict_without(self, view: View) -> np.ndarray:
        """Blend into a view the votes of all others as probabilities, (H, W, K) float32; exact, by subtraction."""
        return self._blend_codes(self.vote_rows_without(view.name), view)
