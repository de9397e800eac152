"""A live session whose scene may change under it, with its votes kept: a map that a robot goes on building."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from gsseg_core.data.view import View
from gsseg_core.errors import StateMismatchError
from gsseg_core.learn.learner_state import Learnt, State
from gsseg_core.learn.merged_states import Saved, merge_states
from gsseg_core.live.living_votes import LivingVotes, carried_over, without_views
from gsseg_core.live.matching_scenes import Matching, match_scenes, places_in_saved
from gsseg_core.live.scene_change import SceneChange, carried
from gsseg_core.live.session import LiveSession
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.living_scene import LivingScene
from gsseg_core.scene.scene_delta import SceneDelta


@dataclass(frozen=True)
class Changed:
    """What a change of the scene did.

    Attributes
    ----------
    revision : int or None
        Number of the scene from now on; None if it came from a file.
    num_carried, num_removed, num_added : int
        Gaussians that were there before and still are; that no longer are; that were not there before.
    matched_by : str
        What told which Gaussians those are: "id" or "position".
    num_views_kept, num_views_lifted : int
        Views whose votes are as they were, and those that were lifted anew.
    scene : GaussianScene
        What it made.
    num_views_unknown : int
        Views that the change names and that are not kept.
    """

    revision: int | None
    num_carried: int
    num_removed: int
    num_added: int
    matched_by: str
    num_views_kept: int
    num_views_lifted: int
    scene: GaussianScene = field(repr=False)
    num_views_unknown: int = 0


class LivingSession(LiveSession):
    """A `LiveSession` of a scene that changes: `update` leaves all as if views had been fused into the new scene.

    Votes of views that are no longer kept go along with their Gaussians. A view that is fused with a `group` moves with
    that group of Gaussians, and its camera is in the group's frame. See docs/living_map.md for the exact law.

    It is made like a `LiveSession`.
    """

    _live: LivingVotes

    def __init__(self, scene: GaussianScene | LivingScene, *args: Any, **kwargs: Any) -> None:
        self._living = scene if isinstance(scene, LivingScene) else LivingScene.of(scene)
        self._first = self._living
        self._numbered = self._living.scene.ids is None  # Whether ids are the session's own numbers.
        # Of the scenes that are still in use: where in them the Gaussians of now were.
        self._past: WeakKeyDictionary[GaussianScene, np.ndarray] = WeakKeyDictionary()
        super().__init__(self._living.scene, *args, **kwargs)

    @property
    def living(self) -> LivingScene:
        """The scene as it is now, with ids, groups and their frames."""
        return self._living

    @property
    def views(self) -> list[View]:
        """Views that are kept, in the order in which they came, each in the frame of its group."""
        with self._lock:
            return list(self._live.views.values())

    def move_view(self, name: str, moved: Callable[[Camera], Camera], era: object) -> bool:
        """Have a view seen from another camera, so that votes are as if it had been fused from there.

        A view that is not kept stays as it is, and so does one of a group, whose camera moves with its Gaussians.
        Returns False, and changes nothing, if `era` is not that of now.
        """
        with self._lock:
            view = self._live.views.get(name)
            if era is self._era and view is not None and view.group is None:
                self._live.move(name, moved(view.camera))
                self._version += 1
            return era is self._era

    def update(self, delta: SceneDelta) -> Changed:
        """Change the scene, and lift those views anew that the change can touch; on any error, nothing has changed.

        Raises
        ------
        SceneDeltaError
            The change is out of turn, or names what is not there.
        EmptySceneError
            Nothing would be left.
        """
        with self._lock:
            after, origin = self._living.apply(delta)
            joining = {name: move.group for move in delta.moves for name in move.views}
            unknown = len(joining.keys() - self._live.views.keys())
            return replace(self._go_over(self._living, after, origin, joining), num_views_unknown=unknown)

    def replace_scene(self, scene: GaussianScene, tolerance: float = 0.0) -> Changed:
        """Go over to a scene from a file that has grown out of this one, as `match_scenes` finds it.

        Views stay where they are, and belong to no group any more.

        Raises
        ------
        SettingsError
            The tolerance is no distance.
        """
        with self._lock:
            before = self._living
            matching = match_scenes(before, scene, tolerance)
            joining = dict.fromkeys(self._live.views)
            changed = self._go_over(before.flat(), matching.after, matching.origin, joining)
            if before.scene.ids is None:
                self._first = _renumbered(self._first, before, matching)
            self._numbered = self._numbered and scene.ids is None
            return replace(changed, revision=None, matched_by=matching.by)

    def _go_over(
        self, before: LivingScene, after: LivingScene, origin: np.ndarray, joining: Mapping[str, int | None]
    ) -> Changed:
        change = SceneChange(before, after, origin)
        first = self._living.without_colours() if self._first is self._living else self._first
        learnt = None if self._learnt is None else self._learnt.carried(change.carry)
        past = {scene: np.where(origin >= 0, places[origin], -1) for scene, places in self._past.items()}
        all_kept = self.num_fused == len(self._live.views)
        lifted = len(self._live.change(change, joining, all_kept=all_kept))
        # From here on nothing can go wrong.
        self._first, self._learnt = first, learnt
        self._past.update(past)
        self._past[self.scene] = origin
        self._living = after
        self.scene = after.scene
        self._version += 1
        num_carried = int((origin >= 0).sum())
        return Changed(
            after.revision, num_carried, len(before) - num_carried, len(after) - num_carried, "id",
            len(self._live.views) - lifted, lifted, after.scene,
        )  # fmt: skip

    def load(self, path: Any, within: Path | None = None) -> int:
        """Replace all that is known by a saved state, as `LiveSession.load` does, also by one of an earlier scene.

        Gaussians are found by their ids; what the state was saved of is in it, if the scene had ids, or else it must be
        the scene that the session began with. Where the session had to number them itself, and the state has other
        numbers, they are found by their place; see `places_in_saved`.
        """
        with self._lock:
            return super().load(path, within)

    def merge(self, paths: Sequence[str | os.PathLike[str]], within: Path | None = None) -> int:
        """Add what other sessions of the scene have saved to what is known; return how many views came with it.

        Votes are added exactly, and those of a view that is known already, or is in two of the states, once. What was
        learnt stays in force until it is learnt again; of several views of one name, the later ones get others, and
        only the last `max_views` are kept. On any error, nothing has changed.

        Raises
        ------
        StateFileError
            A file is missing or damaged, has other names for the classes, or more classes than there may be.
        StateMismatchError
            It belongs to another scene.
        PathNotAllowedError
            It lies outside the folder `within`, links followed.
        """
        with self._lock:
            still, known = copy(self), self._known()  # From here on the scene may change, and views come.
        saved = [still._read_saved(path, within) for path in paths]
        without = cache(lambda state, *what: without_views(state, *what, living=still.living, device=still.device))
        merged = merge_states([known, *saved], without)  # It takes long, and meanwhile views can be fused.
        with self._lock:
            if self._living is not still.living:
                return self.merge(paths, within)  # Now that it cannot change again.
            if self._version != still._version:
                merged = merge_states([self._known(), *saved], without)
            self._live.adopt(merged)  # First: with too little memory for it, nothing has changed.
            self._classes.reset(merged.class_names)
            came, self.num_fused = merged.num_fused - self.num_fused, merged.num_fused
            self._version += 1
            self._drop_old_views()
        return came

    def _known(self) -> Saved:
        state = replace(self._live.state(), num_fused=self.num_fused, class_names=self._classes.names, living=None)
        return Saved("what is known here", self.scene.digest, state)

    def _read_saved(self, path: str | os.PathLike[str], within: Path | None) -> Saved:
        state = self._read_state(Path(path), within)
        self._check_classes(path, state)
        return Saved(str(path), self.scene.digest, replace(state, living=None))

    def _no_votes(self, num_classes: int) -> LivingVotes:
        return LivingVotes(self._living, num_classes, device=self.device)

    def _posed_views(self) -> list[View]:
        return [self._live.in_scene(view) for view in self._live.views.values()]

    def _carrier(self) -> Callable[[Learnt], Learnt]:
        scene = self.scene

        def carry(learnt: Learnt) -> Learnt:
            return learnt if scene is self.scene else learnt.carried(lambda rows: carried(rows, self._past[scene]))

        return carry

    def _read_state(self, path: Path, within: Path | None) -> State:
        state = State.load(path, self.scene.digest, len(self.scene), within, self._first)
        saved = state.living
        if saved is None and not state.whole_rays:
            return state
        saved = saved or self._living
        change = SceneChange(saved, self._living, self._places_in(saved, path))
        gone = {group for group in saved.frames if group not in self._living.frames or change.has_flattened(group)}
        joining = {view.name: None for view in state.views if view.group in gone}
        return carried_over(state, change, joining, self.device)

    def _places_in(self, saved: LivingScene, path: Path) -> np.ndarray:
        if saved is self._first or not self._numbered:
            return saved.places(self._living.ids)
        try:
            return places_in_saved(saved, self._first, self._living)
        except StateMismatchError as error:
            raise StateMismatchError(f"{path}: {error}") from error


def _renumbered(first: LivingScene, before: LivingScene, matching: Matching) -> LivingScene:
    """Give the Gaussians of the first scene the numbers of those that they are now: a state of it holds no ids."""
    now, found = np.full(len(before), -1), matching.origin >= 0
    now[matching.origin[found]] = matching.after.ids[found]
    places = before.places(first.ids)
    ids = np.where(places >= 0, now[places], -1)
    # Below 0 is no id that a Gaussian could ever have.
    return replace(first, ids=np.where(ids >= 0, ids, -1 - np.arange(len(first))))
