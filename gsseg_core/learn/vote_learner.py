"""The votes learner: class probabilities are the normalised sum over views of W^T onehot(y)."""

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
    """Learner of class probabilities proportional to the votes: exact, additive, in one pass, for use on a robot.

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
        """Change the camera of a view: subtract its votes, and add those from the new camera.

        A view that sees no Gaussian from there stays, without votes. After an error, nothing has changed.
        """
        before = self._observed(name)
        self._exchange(before, replace(before, camera=camera))

    def relabel(self, view: View) -> None:
        """Change the mask of a view, with the same camera; its operator is made once for both masks.

        After an error, nothing has changed.
        """
        before, after = self._observed(view.name), view.held()
        self._exchange(before, after, self._operator_of(after))

    def checkpoint(self) -> Undo:
        """Return a function that restores the present views and votes, unless `forget` was called."""
        prepared = self._prepared.emptied()
        return checkpoint(self, _votes=self._votes.copy(), views=dict(self.views), _prepared=prepared)

    def keep_last(self, count: int) -> None:
        """Drop the oldest views and their masks, but keep the last `count`, at least 1; all votes stay."""
        old = list(self.views.values())[:-count]
        self.dropped += tuple(view.digest for view in old)
        for view in old:
            self.forget(view.name)

    def _exchange(self, before: View, after: View, operator: ViewOperator | None = None) -> None:
        """Replace a view by one of the same name; both use `operator` if it is given."""
        self._lift(after, 1, operator)
        with all_or_nothing(partial(self._lift, after, -1, operator)):
            self._lift(before, -1, operator)
        self.views[after.name] = after
        self._prepared.drop(after.name)

    def predict_without(self, view: View) -> np.ndarray:
        """Render probabilities from the votes of all other views, (H, W, K) float32; exact, by subtraction."""
        return self._blend_codes(self.vote_rows_without(view.name), view)
