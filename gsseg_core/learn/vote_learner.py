"""The learner by votes: class probabilities are the normalised sum over views of W^T onehot(y)."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from gsseg_core.data.view import View
from gsseg_core.learn.all_or_nothing import Undo, all_or_nothing, checkpoint
from gsseg_core.learn.learner import Learner, Progress, silent
from gsseg_core.raster.view_operator import ViewOperator
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
        self._exchange(before, replace(before, camera=camera))

    def relabel(self, view: View) -> None:
        """Have a view show other labels, seen from where it is: its operator is made once for both.

        On any error, nothing has changed.
        """
        before, after = self._observed(view.name), view.held()
        self._exchange(before, after, self._operator_of(after))

    def checkpoint(self) -> Undo:
        """Return what goes back to the present views and votes, after anything but `forget`."""
        prepared = self._prepared.emptied()
        return checkpoint(self, _votes=self._votes.copy(), views=dict(self.views), _prepared=prepared)

    def keep_last(self, count: int) -> None:
        """Drop the oldest views and their masks, all but so many, of at least one; their votes stay."""
        old = list(self.views.values())[:-count]
        self.dropped += tuple(view.digest for view in old)
        for view in old:
            self.forget(view.name)

    def _exchange(self, before: View, after: View, operator: ViewOperator | None = None) -> None:
        """Put a view in the place of one of its name, seen by the same operator if one is given."""
        self._lift(after, 1, operator)
        with all_or_nothing(partial(self._lift, after, -1, operator)):
            self._lift(before, -1, operator)
        self.views[after.name] = after
        self._prepared.drop(after.name)

    def predict_without(self, view: View) -> np.ndarray:
        """Blend into a view the votes of all others as probabilities, (H, W, K) float32; exact, by subtraction."""
        return self._blend_codes(self.vote_rows_without(view.name), view)
