"""Votes of views of a scene that changes: those that a change touches are lifted anew, all others stay as they are."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from functools import partial
from weakref import WeakKeyDictionary

import numpy as np

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.view import View
from gsseg_core.errors import UnknownGroupError
from gsseg_core.learn.all_or_nothing import all_or_nothing, checkpoint
from gsseg_core.learn.learner_state import State
from gsseg_core.learn.vote_learner import VoteLearner
from gsseg_core.live.scene_change import SceneChange
from gsseg_core.raster.backends import make_operator
from gsseg_core.raster.cpu.occlusion import ray_ends
from gsseg_core.raster.view_operator import ViewOperator
from gsseg_core.raster.vote_total import VoteTotal
from gsseg_core.scene.group_frames import IDENTITY
from gsseg_core.scene.living_scene import LivingScene
from gsseg_core.spatial.row_order import along_curve


class LivingVotes(VoteLearner):
    """Learner by votes over a `LivingScene`; a view is lifted in the frame of its group."""

    def __init__(self, living: LivingScene, num_classes: int, *, device: str = "cpu") -> None:
        # Views are rendered again where they are needed; to keep them prepared would take far more memory than masks.
        super().__init__(living.scene, num_classes, device=device, memory_budget=0)
        self.living = living
        self._ends: WeakKeyDictionary[View, np.ndarray] = WeakKeyDictionary()

    def observe(self, view: View, operator: ViewOperator | None = None) -> bool:
        """Add a view and its votes, as `Learner.observe` does; raises `UnknownGroupError`, too."""
        if view.group is not None and view.group not in self.living.frames:
            raise UnknownGroupError(
                f"view '{view.name}': belongs to group {view.group}, which the scene does not have; expected one of "
                f"its {len(self.living.frames)} groups"
            )
        return super().observe(view, operator)

    def in_scene(self, view: View) -> View:
        """Pose a view in the frame of the scene as it is now."""
        if view.group is None:
            return view
        frame = self.living.frame(view.group)
        return replace(view, camera=view.camera if frame == IDENTITY else frame.camera(view.camera), group=None)

    def change(self, change: SceneChange, joining: Mapping[str, int | None], *, all_kept: bool = False) -> list[str]:
        """Go over to the scene after a change, with the votes that views have in that: their masks are `View.held`.

        `joining` has the group of each view that belongs to another one from now on; `all_kept` says whether the votes
        are those of the views that are kept, and of no others. Returns the views that were lifted anew.
        """
        views = {name: self._joined(view, joining.get(name, view.group)) for name, view in self.views.items()}
        lifted = [
            name
            for name, view in views.items()
            if not self._looks_alike(name, view) or change.touches(view, self._ends_of(view))
        ]
        # To take a view back costs as much as to add it: with more than half of them, all are lifted from nothing.
        from_nothing = all_kept and 2 * len(lifted) > len(views)
        taken_back = [] if from_nothing else lifted
        self._lift_all(self.views, taken_back, -1)
        # With too little memory the scene stays, and with it its votes.
        with all_or_nothing(checkpoint(self), partial(self._lift_all, self.views, taken_back, 1)):
            stay = CSRRows.empty(len(change.after), np.int64) if from_nothing else change.carry(self._votes.rows())
            self._votes = VoteTotal.from_rows(stay, self.num_classes, along_curve(change.after.scene))
            self.living, self.scene = change.after, change.after.scene
            self._lift_all(views, list(views) if from_nothing else lifted, 1)
        self.views = views
        for name in lifted:
            self._ends.pop(views[name], None)
        return lifted

    def _ends_of(self, view: View) -> Callable[[], np.ndarray] | None:
        """Tell where the rays of a view end, when asked; it is kept until the view is lifted anew. None on a GPU."""

        def ends() -> np.ndarray:
            if view not in self._ends:
                scene = self.living.seen_from(view.group)
                self._ends[view] = ray_ends(scene, view.camera, view.read_seen().labels)
            return self._ends[view]

        return ends if self.device == "cpu" else None

    def _lift_all(self, views: Mapping[str, View], names: list[str], sign: int) -> None:
        """Add the votes of some views, or take them away; of all, or on any error of none."""
        done = list[str]()
        with all_or_nothing(lambda: self._lift_all(views, done, -sign)):
            # In the order of groups, so that the scene is brought into the frame of each but once.
            for name in sorted(names, key=lambda name: str(views[name].group)):
                # A view that sees nothing any more is kept: it may see what is added later.
                self._lift(views[name], sign)
                done.append(name)

    def _joined(self, view: View, group: int | None) -> View:
        """Have a view belong to a group: it stays where it is in the scene, and from then on moves along."""
        if group == view.group:
            return view
        camera = self.in_scene(view).camera
        frame = IDENTITY if group is None else self.living.frames.get(group, IDENTITY)
        return replace(view, camera=camera if frame == IDENTITY else frame.inverse().camera(camera), group=group)

    def _looks_alike(self, name: str, view: View) -> bool:
        """Whether a view that belongs to another group now has the votes that it had, bit for bit."""
        before = self.views[name]
        if view is before:
            return True
        poses = before.camera.world_to_camera, view.camera.world_to_camera
        if not np.array_equal(*poses) or (view.group is not None and view.group not in self.living.frames):
            return False
        return self.living.seen_from(before.group) is self.living.seen_from(view.group)

    def state(self) -> State:
        """Return a copy of votes and views, to be saved; of a scene that has ids, with the scene."""
        return replace(super().state(), living=None if self.scene.ids is None else self.living)

    def _operator_of(self, view: View) -> ViewOperator:
        return make_operator(self.living.seen_from(view.group), view.camera, self.device)


def carried_over(state: State, change: SceneChange, joining: Mapping[str, int | None], device: str) -> State:
    """Take what was saved of the scene before a change over to that after it; `joining` as for `LivingVotes.change`."""
    votes = LivingVotes(change.before, state.num_classes, device=device)
    votes.adopt(state)
    votes.change(change, joining)
    now, learnt = votes.state(), state.learnt and state.learnt.carried(change.carry)
    return replace(state, votes=now.votes, views=now.views, living=now.living, learnt=learnt, whole_rays=False)


def without_views(state: State, names: Collection[str], dropped: bool, *, living: LivingScene, device: str) -> State:
    """Take views and their votes out of a state, whose scene is this; and all that are no longer kept, if `dropped`."""
    views, gone = {view.name: view for view in state.views}, set(names)
    left = {name: view for name, view in views.items() if name not in gone}
    votes = LivingVotes(living, state.num_classes, device=device)
    few = state.num_fused == len(views) and len(left) < len(gone)
    if dropped or few:
        votes._lift_all(left, [*left], 1)  # There are no other votes, and these take less time to lift.
    else:
        votes.adopt(state)
        votes._lift_all(views, [*names], -1)
    made = replace(state, votes=votes._votes.rows(), views=[*left.values()], num_fused=state.num_fused - len(gone))
    return replace(made, dropped=(), num_fused=len(left)) if dropped else made


def without_groups(state: State, device: str) -> State:
    """Have the views of a state stay where they are in the scene, for a session in which no group moves."""
    if state.living is None or all(view.group is None for view in state.views):
        return state
    flat = SceneChange(state.living, state.living.flat(), np.arange(len(state.living)))
    return carried_over(state, flat, {view.name: None for view in state.views}, device)
