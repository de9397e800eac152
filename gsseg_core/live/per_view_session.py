"""A live session for masks whose ids hold only inside their own view: it finds the objects itself."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import replace
from functools import reduce
from typing import Any

import numpy as np

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.dataset import Dataset
from gsseg_core.data.label_evidence import VOTE_UNIT
from gsseg_core.data.view import View
from gsseg_core.errors import SettingsError
from gsseg_core.learn.all_or_nothing import all_or_nothing
from gsseg_core.learn.learner_state import Learnt
from gsseg_core.learn.vote_learner import VoteLearner
from gsseg_core.live.results import Outcome
from gsseg_core.live.session import LiveSession
from gsseg_core.objects.object_table import ObjectTable, Repair, object_name
from gsseg_core.raster.backends import make_operator
from gsseg_core.raster.view_operator import ViewOperator
from gsseg_core.raster.vote_total import VoteTotal
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import Segmentation
from gsseg_core.spatial.row_order import along_curve


class PerViewSession(LiveSession):
    """A `LiveSession` whose classes are objects that it finds itself.

    The ids of a new view are matched to the objects so far as it arrives. `learn` first looks at all views that are
    kept together, and repairs what turns out to be wrong, as `repair` does; objects keep their numbers, and a number
    that has become part of another one is not given again. While it looks, for a few seconds, other calls wait.

    It is made like a `LiveSession`, but takes no `class_names`; a view that would make more objects than `max_classes`,
    the background and those that ended in another one counted, is refused.
    """

    _LABEL, _REMEDY, _PER_VIEW = "would show the first of object", "", True
    _with_tree: tuple[Segmentation, Segmentation] | None = None  # a result, and the same with its tree

    def __init__(self, scene: GaussianScene, class_names: None = None, **settings: Any) -> None:
        if class_names is not None:
            raise SettingsError("class_names are given; expected none: objects that are found have their own")
        super().__init__(scene, None, **settings)

    @property
    def class_names(self) -> dict[int, str]:
        """Names by number, "object_001" and so on."""
        return {k: object_name(k) for k in range(self._live.num_classes)}

    def _fuse(self, view: View, operator: ViewOperator | None = None) -> None:
        # The table looks at the mask again, and names of classes say nothing of its ids.
        view = replace(view, class_names=None).held()
        if view.has_mask:  # Made once: its segments are lifted, and then the objects that they are.
            operator = operator or make_operator(self.scene, view.camera, self.device)
        with all_or_nothing(self._table.checkpoint()):
            super()._fuse(self._table.match(view, operator), operator)

    def move_view(self, name: str, moved: Callable[[Camera], Camera], era: object) -> bool:
        """Have a view seen from another camera, as a `LivingSession` does; its ids are matched to the objects anew."""
        with self._lock:
            if era is self._era and name in self._live.views:
                kept, order = self._live.views[name], list(self._live.views)
                view = self._table.views.get(name, kept)
                after = replace(view, camera=moved(view.camera))
                operator = make_operator(self.scene, after.camera, self.device)
                if self._table.sees_any(after, operator):
                    self._fuse(after, operator)
                else:
                    with all_or_nothing(self._table.checkpoint()):
                        self._table.set_aside(after)
                        self._live.move(name, after.camera)
                    self._version += 1
                self._live.views = {name: self._live.views[name] for name in order}
            return era is self._era

    def repair(self) -> Repair:
        """Associate the views that are kept anew, and move their votes to the objects that turn out to be right.

        Votes of views that are no longer kept go along with most of their object. Raises `UnknownLabelError` where
        there would be more objects than `max_classes`; nothing has changed then, as after any error.
        """
        with self._lock, ExitStack() as whole:
            whole.enter_context(all_or_nothing(self._table.checkpoint()))
            repair, order = self._table.solve(), [name for name in self._live.views if self._table.sees(name)]
            moved = bool((repair.successors != np.arange(len(repair.successors))).any())
            forgotten = self.num_fused > len(order)
            names = order if moved and forgotten else [name for name in order if name in set(repair.changed)]
            views = {name: self._table.relabelled(self._table.views[name]) for name in names}
            learnt = _renumbered(self._learnt, repair.successors) if self._learnt and moved else self._learnt
            if views:  # All at once: if there is no room for all, there are no more classes than before.
                whole.enter_context(all_or_nothing(self._live.checkpoint()))
                self._grow_for(max(views.values(), key=lambda view: view.largest_label))
            if moved and forgotten:
                self._relabel_all(views, repair.successors)
            else:
                for view in views.values():
                    self._live.relabel(view)
            if moved:
                self._repairs.append(repair.successors)
            self._learnt = learnt
            self._version += 1
        return repair

    def _relabel_all(self, views: Mapping[str, View], successors: np.ndarray) -> None:
        """Put views in the places of those of their names, and move all other votes to the successors of objects."""
        every = list(self._live.views)
        # What is left once the views have gone is of those that are no longer kept.
        for name in views:
            self._live.retract(name)
        left, most = self._live.state(), int(successors.max()) + 1
        votes = _added_up(left.votes, successors).nonzero()
        self._live.adopt(replace(left, votes=votes, num_classes=max(left.num_classes, most)))
        for view in views.values():
            self._live.observe(view)
        # The oldest view still is the first one to go.
        self._live.views = {name: self._live.views[name] for name in every if name in self._live.views}

    def at_level(self, result: Segmentation, granularity: float | None) -> Segmentation:
        """Cut a result of `segmentation` at a level of the tree of parts and wholes, by the views that are kept now.

        None gives the objects, with their tree. Where the scene has changed since, it stays as it is. Raises
        `SettingsError` where the granularity is not in [0, 1].
        """
        with self._lock:
            scene = self.scene_of(result)
            if scene is not self.scene:
                return result
            if self._with_tree is None or self._with_tree[0] is not result:
                self._with_tree = result, self._table.with_tree(result)
            level = self._with_tree[1].at(granularity)
            self._scenes[level] = scene
        return level

    def learn(self, learner: str = "em", dataset: Dataset | None = None, **settings: Any) -> Outcome:
        """Repair, then learn class probabilities from the views kept. The repair stays, even if learning is ended.

        Raises `SettingsError` where a dataset is given, whose objects would have numbers of their own, and
        `NoUsableViewsError` where there is no view to learn from.
        """
        if dataset is not None:
            raise SettingsError(f"{dataset.root}: ids are per view; expected to learn from the views received only")
        self.repair()
        return super().learn(learner, None, **settings)

    def _forget(self, class_names: Mapping[int, str], votes: VoteLearner, num_fused: int = 0) -> None:
        table = self._table_of(votes, num_fused)  # First: with too little memory for it, nothing is forgotten.
        super()._forget(class_names, votes, num_fused)
        self._table, self._with_tree = table, None
        self._repairs: list[np.ndarray] = []  # successors of each repair that gave objects other numbers

    def _table_of(self, votes: VoteLearner, num_fused: int) -> ObjectTable:
        """Make the table of views whose labels are numbers of objects, and of the votes of those that were dropped."""
        table, views = ObjectTable(self.scene, device=self.device), list(votes.views.values())
        if num_fused > len(views):  # The votes left are of dropped views: what these showed is not new.
            left = VoteTotal.from_rows(votes.state().votes, votes.num_classes, along_curve(self.scene))
            for view in views:
                if observation := table.adopt(view):
                    observation.vote(left, sign=-1)
            rest = left.rows()
            table.recall(rest.with_data(rest.data * VOTE_UNIT))
        else:
            table.adopt_all(views)
        table.reserve(votes.num_classes - 1)
        return table

    def _carrier(self) -> Callable[[Learnt], Learnt]:
        repaired = len(self._repairs)
        return lambda learnt: reduce(_renumbered, self._repairs[repaired:], learnt)

    def _drop_old_views(self) -> None:
        super()._drop_old_views()
        for name in [name for name in self._table.views if name not in self._live.views]:
            self._table.forget(name)


def _renumbered(learnt: Learnt, successors: np.ndarray) -> Learnt:
    return replace(learnt, codes=_added_up(learnt.codes, successors))


def _added_up(rows: CSRRows, successors: np.ndarray) -> CSRRows:  # (K',)
    """Add up columns that get the same number; those from K' on keep theirs."""
    table = np.arange(max(int(rows.indices.max(initial=0)) + 1, len(successors)))
    table[: len(successors)] = successors
    return rows.in_columns(table[rows.indices])
