"""Learner, the base class of all learners: it adds and retracts views one at a time and keeps their votes exactly."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from functools import partial
from typing import Any, TypeVar

import numpy as np

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.label_evidence import VOTE_UNIT
from gsseg_core.data.soft_masks import SeenLabels
from gsseg_core.data.view import View
from gsseg_core.errors import NoUsableViewsError, SettingsError, StateMismatchError
from gsseg_core.files.limits import MAX_LABEL
from gsseg_core.learn.all_or_nothing import Undo, all_or_nothing
from gsseg_core.learn.learner_state import State
from gsseg_core.learn.prepared_views import PreparedViews, default_budget
from gsseg_core.learn.usable_views import SEES_NOTHING, UnusableViewError, read_mask, read_usable_mask
from gsseg_core.learn.vote_resolution import impute_probabilities, vote_shares, weigh_votes
from gsseg_core.learn.whole_rays import votes_cast_anew
from gsseg_core.progress import Progress as Progress
from gsseg_core.progress import silent as silent
from gsseg_core.progress import with_progress
from gsseg_core.raster.backends import make_operator, vote_total
from gsseg_core.raster.observation import Observation
from gsseg_core.raster.view_operator import ViewOperator
from gsseg_core.raster.view_renderer import NO_PIXELS, PixelGrid, Strongest
from gsseg_core.raster.vote_total import VoteTotal
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.several_at_once import each_with_made, several_at_once
from gsseg_core.spatial.row_order import along_curve
from gsseg_core.text import counted

Self = TypeVar("Self", bound="Learner")
R = TypeVar("R")


def _checked_num_classes(num_classes: int) -> int:
    """Return the number of classes as a Python int, since NumPy's short integers overflow; else `SettingsError`."""
    if not isinstance(num_classes, int | np.integer) or not 1 <= num_classes <= MAX_LABEL + 1:
        raise SettingsError(f"num_classes is {num_classes}; expected a whole number from 1 to {MAX_LABEL + 1}")
    return int(num_classes)


class Learner(ABC):
    """Base class of learners, which find the class of each Gaussian; `fit` sets the attributes that end with "_".

    Parameters
    ----------
    scene : GaussianScene
        N Gaussians.
    num_classes : int
        K; labels are 0 (background) to K - 1.
    device : str
        Device that renders the views.
    memory_budget : int, optional
        Bytes of prepared views to keep in memory between steps; default: 1/8 of the free memory, or half of a GPU's.
        Further views go to a temporary file. Without space for it, on a GPU, or with a budget of 0, they are prepared
        again for each step. The result does not depend on the budget.

    Attributes
    ----------
    views : dict of str to View
        Views in use, by name, in the order in which they were added. Each keeps its mask of that time in memory.
    rejected : dict of str to str
        Reason for rejection of each view that could not be used, by name.
    code_rows_ : CSRRows
        After `fit`: class probabilities of each Gaussian (the paper's object codes), float32. A row is empty if no
        pixel with a used label saw the Gaussian, or if masks only exclude classes for it; see docs/masks.md.
    codes_ : (N, K) float32
        The same as a dense array, which is made on each access.
    observed_ : (N,) bool
        After `fit`: whether the Gaussian has a code.
    history_ : list of float
        Objective of `fit` at each step, for learners that have one.
    converged_ : bool
        After `fit`: whether another step would have changed little.
    leaves_out : bool
        Whether `predict_without` excludes the view's own mask; if not, its prediction was also learnt from that mask.
    checks_masks : bool
        Whether a report compares every mask with `predict_without`.
    """

    code_rows_: CSRRows
    observed_: np.ndarray
    converged_: bool = False
    dropped: tuple[bytes, ...] = ()  # `View.digest` of dropped views whose votes stay; never changed in place
    leaves_out = False
    checks_masks = False

    def __init__(
        self, scene: GaussianScene, num_classes: int, *, device: str = "cpu", memory_budget: int | None = None
    ) -> None:
        num_classes = _checked_num_classes(num_classes)
        memory_budget = default_budget(device) if memory_budget is None else memory_budget
        if memory_budget < 0:
            raise SettingsError(f"memory_budget is {memory_budget} bytes; expected at least 0")
        self.scene, self.num_classes, self.device, self.memory_budget = scene, num_classes, device, memory_budget
        self.views: dict[str, View] = {}
        self.rejected: dict[str, str] = {}
        self._unfit()
        self._votes = VoteTotal(len(scene), num_classes, along_curve(scene))
        self._prepared = PreparedViews(memory_budget, with_file=device == "cpu")  # GPU data is not written to files
        self._turned = False

    @classmethod
    def default_settings(cls, max_steps: int | None, seed: int) -> tuple[Any, ...]:
        """Return the arguments after `num_classes` for `gsseg_core.learn.registry.make_learner`: settings, if any.

        Iterative learners use `max_steps` (None: their own default). Learners that draw at random use `seed`.
        """
        return ()

    def observe(self, view: View, operator: ViewOperator | None = None) -> bool:
        """Add a view and its votes. It replaces an earlier view of the same name.

        The view's `operator` is made here unless the caller passes it.

        Returns
        -------
        bool
            Whether the view can be used; if not, `rejected` has the reason, and nothing else changes.

        Raises
        ------
        MaskFormatError, MaskSizeError, UnknownLabelError
            The mask is broken, its size differs from the camera's, or it has labels beyond the classes.
        """
        if self.memory_budget == 0 and view.name not in self.views:
            view = view.held()
            try:
                sees = self._lift(view, 1, operator, read_usable_mask(view, self.num_classes))
            except UnusableViewError as why:
                return self._add(view, why)
            return self._add(view, None if sees else UnusableViewError(SEES_NOTHING))
        return self._add(*self._opened(view, operator))

    def observe_all(self, views: Sequence[View], progress: Progress = silent) -> None:
        """Add views as `observe` does, up to the first that raises an error."""
        if self.memory_budget == 0:  # Nothing prepared is kept, so each view adds its votes while it is lifted.
            for view in with_progress(progress, "observe", views):
                self.observe(view)
            return
        with vote_total(self._votes, self.device) as total:
            for _, (view, opened) in each_with_made(self._opened, views, self.device, progress, "observe"):
                self._add(view, opened, total)

    def retract(self, name: str) -> None:
        """Remove a view and subtract its votes exactly.

        Raises
        ------
        SettingsError
            There is no view of this name.
        """
        view, observation = self._observed(name), self._prepared.get(name)
        if observation is not None:
            observation.vote(self._votes, sign=-1)
        else:
            self._lift(view, -1)
        self.forget(name)

    def forget(self, name: str) -> None:
        """Drop a view and its mask but keep its votes. `fit` learns from the views that remain. Raises as `retract`."""
        self._observed(name)
        del self.views[name]
        self._prepared.drop(name)

    def resize(self, num_classes: int) -> None:
        """Change the number of classes; `SettingsError` unless it is larger than every label of `views`.

        With fewer classes than before, votes for the removed ones and the results of `fit` are dropped.
        """
        num_classes = _checked_num_classes(num_classes)
        shrinks = num_classes < self.num_classes
        if shrinks and num_classes <= (largest := max([0, *(view.largest_label for view in self.views.values())])):
            raise SettingsError(f"num_classes is {num_classes}; expected more than {largest}, which a view shows")
        if shrinks:
            self._unfit()
        if num_classes != self.num_classes:
            self._votes.resize(num_classes)
            self.num_classes = num_classes

    def most_classes(self, vote_bytes: int) -> int:
        """Return how many classes fit if the current votes may take `vote_bytes`; at least the current number."""
        return self._votes.most_classes(vote_bytes)

    @property
    def codes_(self) -> np.ndarray:
        """Class probabilities as a dense array, (N, K) float32, after `fit`."""
        return self.code_rows_.dense(self.num_classes)

    @property
    def loss(self) -> float:
        """Loss that `fit` minimises, at its last step, in nats per labelled pixel; NaN for learners without one."""
        return float("nan")

    @abstractmethod
    def fit(self: Self, progress: Progress = silent) -> Self:
        """Learn `code_rows_` from the views observed so far; an iterative `fit` is decorated by `fits_whole`.

        Raises
        ------
        NoUsableViewsError
            There is no view.
        """

    def predict_without(self, view: View) -> np.ndarray:
        """Render class probabilities, learnt without the view's own mask if `leaves_out`: (H, W, K) float32.

        Call it after `fit`, for a view that `fit` used; a learner that `leaves_out` raises `SettingsError` for others.
        The learner does not change. The K values of a pixel sum to less than 1 where little is known.
        """
        if not hasattr(self, "code_rows_"):
            raise SettingsError(f"view {view.name!r} was not learnt from; expected it after fit()")
        return self._blend_codes(self.code_rows_, view)

    def strongest_without(self, view: View, wanted: np.ndarray | None = None, grid: PixelGrid = NO_PIXELS) -> Strongest:
        """Return the class of each pixel by `predict_without`, and the probabilities at the pixels of a grid.

        Little is known where most of a ray ends on Gaussians that only this view has seen. To save time, pass the
        labelled pixels that are `wanted`, (H, W) bool: the others may then have any class and probabilities.
        """
        return Strongest.of(self.predict_without(view), grid)

    def rejected_share(self, view: View) -> float:
        """Return the share of a view's labelled pixels whose label `fit` rejected, in [0, 1]."""
        return 0.0

    def state(self) -> State:
        """Return a copy of the votes and views for saving."""
        views = list(self.views.values())
        return State(self._votes.rows(), self.num_classes, views, len(views), dropped=self.dropped)

    def adopt(self, state: State) -> None:
        """Replace views, votes and number of classes by those of a state of the same scene.

        Drops the results of `fit`, and lifts masks again that an older version lifted along whole rays. Raises
        `StateMismatchError` if the state's number of Gaussians is not the scene's.
        """
        if (found := state.votes.num_rows) != len(self.scene):
            raise StateMismatchError(f"state is of {found} Gaussians; expected {len(self.scene)}, as the scene has")
        votes = VoteTotal.from_rows(state.votes, state.num_classes, along_curve(self.scene))
        self._unfit()
        self.views, self._votes = {view.name: view for view in state.views}, votes
        self.num_classes, self.dropped = state.num_classes, state.dropped
        self.rejected.clear()
        self._prepared.clear()
        if state.whole_rays:
            self._votes = votes_cast_anew(state, self._operator_of, self._used_labels, votes.order)

    def vote_codes(self) -> np.ndarray:
        """Return the votes as probabilities, (N, K) float32; a row is zero if no labelled pixel saw the Gaussian."""
        return self.vote_rows().dense(self.num_classes)

    def vote_rows(self) -> CSRRows:
        """Return the votes as probabilities in float32 CSR rows; a row is empty where that of `vote_codes` is zero."""
        return vote_shares(self._votes.rows(), self._possible())

    def vote_rows_without(self, name: str) -> CSRRows:
        """Return the votes of all views but one as probabilities, in the form of `vote_rows`."""
        others = self._votes.copy()
        self.observation(name).vote(others, sign=-1)
        return vote_shares(others.rows(), self._possible())

    def evidence(self) -> np.ndarray:
        """Weight of the labelled pixels that saw each Gaussian, over all views and for or against, px, (N,) float32."""
        return np.asarray(weigh_votes(self._votes.rows())[0] * VOTE_UNIT, np.float32)

    def reject_summary(self) -> dict[str, int]:
        """Count the rejected views by reason."""
        return dict(Counter(self.rejected.values()))

    def observation(self, name: str) -> Observation:
        """Return a view with its mask in prepared form, and keep it, in memory if the budget allows."""
        observation = self._prepared.get(name)
        if observation is None:
            view = self._observed(name)
            observation = self._prepare(view, read_mask(view, self.num_classes))
            self._prepared.keep(name, observation)
        return observation

    def prepared_bytes(self) -> tuple[int, int]:
        """Return the bytes of prepared views that are kept in memory and in the temporary file."""
        return self._prepared.nbytes

    def _unfit(self) -> None:
        """Drop the results of `fit`, after its views or classes were removed."""
        for name in [name for name in vars(self) if name.endswith("_")]:
            delattr(self, name)
        self.history_: list[float] = []

    def _observed(self, name: str) -> View:
        """Return a view by name; raise `SettingsError` if there is none."""
        if name not in self.views:
            raise SettingsError(f"view {name!r} was not observed; there are {len(self.views)} others")
        return self.views[name]

    def _lift(
        self, view: View, sign: int, operator: ViewOperator | None = None, seen: SeenLabels | None = None
    ) -> bool:
        """Add or subtract a view's votes without keeping the view; return whether it sees any Gaussian."""
        operator = operator or self._operator_of(view)
        used = self._used_labels(seen or read_mask(view, self.num_classes), operator)
        return operator.vote(used.labels, used.evidence, self._votes, sign=sign)

    def _opened(self, view: View, operator: ViewOperator | None = None) -> tuple[View, Observation | UnusableViewError]:
        """Prepare a new view; return it with its mask in memory, and its observation or the error that rejects it.

        The mask is held because its file may change, and only this mask can later subtract or restore the same votes.
        """
        view = view.held()
        try:
            observation = self._prepare(view, read_usable_mask(view, self.num_classes), operator)
        except UnusableViewError as why:
            return view, why
        return view, observation if observation.num_pairs else UnusableViewError(SEES_NOTHING)

    def _add(self, view: View, opened: Observation | UnusableViewError | None, total: Any = None) -> bool:
        """Register a view and add its votes, if prepared, to `total` (None: the learner's votes); or reject it."""
        if isinstance(opened, UnusableViewError):
            self.rejected[view.name] = str(opened)
            return False
        undo: list[Undo] = []
        if opened is not None:  # Votes first: if they don't fit into memory, the view that it replaces stays.
            vote = partial(opened.vote, self._votes if total is None else total)
            vote()
            undo.append(partial(vote, sign=-1))
        with all_or_nothing(*undo):
            if view.name in self.views:
                self.retract(view.name)
        self.rejected.pop(view.name, None)
        self.views[view.name] = view
        if opened is not None:
            self._prepared.keep(view.name, opened)
        return True

    def _of_each(
        self, work: Callable[[str, Observation], R], names: Iterable[str], tick: Callable[[], None]
    ) -> Iterator[tuple[str, R]]:
        """Yield the name of each view and the result of `work` on it in prepared form; call `tick` before each.

        Several views are processed at once. Every second call goes backwards, because a file cache that is smaller than
        the temporary file still holds the views that were read last.
        """
        names, self._turned = list(names), not self._turned
        names = names if self._turned else names[::-1]

        def ask(name: str) -> R:
            return self._prepared.ask(name, self.observation(name), work)

        with closing(several_at_once(ask, names, self.device)) as made:
            for name in names:
                tick()
                yield name, next(made)

    def _operator_of(self, view: View) -> ViewOperator:
        return make_operator(self.scene, view.camera, self.device)

    def _prepare(self, view: View, seen: SeenLabels, operator: ViewOperator | None = None) -> Observation:
        operator = operator or self._operator_of(view)
        return operator.observe(*self._used_labels(seen, operator))

    def _used_labels(self, seen: SeenLabels, operator: ViewOperator) -> SeenLabels:
        """Turn a mask into the labels to learn from; the base class returns them unchanged."""
        return seen

    def _require_views(self) -> None:
        """Raise `NoUsableViewsError` if there is no view to learn from."""
        if not self.views:
            reasons = [f"{why}: {counted(count, 'view')}" for why, count in self.reject_summary().items()]
            why = ", ".join(reasons) or "none was given"
            raise NoUsableViewsError(f"no view to learn from ({why}); expected posed views with label images")

    def _finish(self) -> None:
        """Clear codes without evidence; impute those of Gaussians that only have votes against classes."""
        votes = self._votes.rows()
        against = weigh_votes(votes)[1] < 0
        # With votes for a class but not `observed_`, a Gaussian was seen in rejected regions only: it stays unknown.
        self.code_rows_ = self.code_rows_.only(self.observed_ | against)
        unsure = np.flatnonzero(against & ~self.observed_)
        if len(unsure):
            self.code_rows_ = impute_probabilities(self.code_rows_, votes, self._possible(), unsure)
            self.observed_[unsure] = self.code_rows_.known()[unsure]

    def _blend_codes(self, codes: CSRRows, view: View) -> np.ndarray:
        background = codes.has_column(0)
        return self._operator_of(view).blend_probabilities(codes, self.num_classes, background)

    def _possible(self) -> np.ndarray:
        """Mark the ids that are classes, (K,) bool: those that views name, or all if a view has no class names."""
        names = {id(view.class_names): view.class_names for view in self.views.values()}.values()
        if not names or None in names:
            return np.ones(self.num_classes, bool)
        return np.isin(np.arange(self.num_classes), [k for ids in names if ids is not None for k in ids])
