"""Merges saved states of one scene, so that several robots get the result of one robot with all their masks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.class_names import check_same_names, names_together
from gsseg_core.data.view import View
from gsseg_core.errors import StateFileError, StateMismatchError
from gsseg_core.learn.learner_state import OBJECTS_OF_ONE_SESSION, State
from gsseg_core.scene.living_scene import LivingScene


class Saved(NamedTuple):
    """A state with its scene and the name that errors use for it."""

    source: str  # its file, or "the session"
    scene: str  # digest of its scene
    state: State


def merge_states(
    saved: Sequence[Saved], without: Callable[[State, tuple[str, ...], bool], State] | None = None
) -> State:
    """Add up one or more states of one scene: sum the votes exactly, append the views, and unite the class names.

    If two views have the same name, the later one gets a name like "view_2". Learnt codes are dropped, since those of a
    state are only learnt from its own views.

    `without(state, names, all_dropped)` removes views, by name, and their votes from a state; if `all_dropped`, it also
    removes the votes of all views that the state no longer keeps. With this function, a view that several states keep
    counts once. Without it, the view counts as often as states keep it, since its votes are unknown without the scene.
    Views that a state no longer keeps count once if the states before it know all of them, or none of them.

    Raises
    ------
    StateMismatchError
        The states are of different scenes.
    StateFileError
        States have different names for one class; or class ids that each session gave to the objects that it found; or
        votes of whole rays in some but not all states. Or all views of one state are already in an earlier one, so
        they would count twice.
    """
    first = saved[0]
    names: dict[int, str] = {}
    views: dict[str, View] = {}
    dropped: tuple[bytes, ...] = ()
    votes, num_fused = CSRRows.empty(first.state.votes.num_rows, np.int64), 0
    for number, one in enumerate(saved):
        state = one.state
        _check_fits(saved, number, names)
        names = names_together(names, state.class_names)
        if without and number:
            shared, old = shared_views(state, Counter([*(view.digest for view in views.values()), *dropped]))
            state = without(state, shared, old) if shared or old else state
        votes, num_fused = votes.plus(state.votes), num_fused + state.num_fused
        dropped += state.dropped
        for view in state.views:
            name, count = view.name, 1
            while name in views:
                count += 1
                name = f"{view.name}_{count}"
            views[name] = view if name == view.name else _renamed(view, name)
    num_classes = max(one.state.num_classes for one in saved)
    # `replace` keeps the other fields of the first state, so a single state keeps its `per_view`.
    return replace(
        first.state, votes=votes.nonzero(), num_classes=num_classes, views=[*views.values()], num_fused=num_fused,
        class_names=dict(sorted(names.items())), learnt=None, dropped=dropped,
    )  # fmt: skip


def _check_fits(saved: Sequence[Saved], number: int, names: Mapping[int, str]) -> None:
    """Raise if state `number` cannot be added to those before it, whose class names are `names`."""
    one, first = saved[number], saved[0]
    if one.scene != first.scene or not _is_same_map(one.state.living, first.state.living):
        raise StateMismatchError(
            f"{one.source}: belongs to the scene {one.scene[:12]}; expected {first.scene[:12]}, that of "
            f"{first.source}, with the same groups"
        )
    if one.state.whole_rays != first.state.whole_rays:
        older, newer = (one, first) if one.state.whole_rays else (first, one)
        raise StateFileError(
            f"{older.source}: an older gsseg has saved it, whose rays went on behind surfaces; expected votes as "
            f"in {newer.source}: load it in a session, which casts them anew, and save it"
        )
    if one.state.per_view and len(saved) > 1:
        raise StateFileError(
            f"{one.source}: {OBJECTS_OF_ONE_SESSION}; expected classes whose ids mean the same in all states"
        )
    check_same_names(one.state.class_names, names, one.source, "the states before it", StateFileError)
    for other in saved[:number]:
        if _brings_nothing(one.state, other.state):
            raise StateFileError(
                f"{one.source}: {other.source} has all its votes and views already, which would count twice; "
                "expected each state once"
            )


def _renamed(view: View, name: str) -> View:
    """Rename a view, and keep the name that its robot uses as its former name."""
    return replace(view, camera=replace(view.camera, name=name), former_name=view.first_name)


def _is_same_map(one: LivingScene | None, other: LivingScene | None) -> bool:
    """Return whether two states have their views in the same frames; None: the state has no changing scene."""
    if one is None or other is None or one is other:
        return one is other
    return (
        np.array_equal(one.ids, other.ids) and np.array_equal(one.groups, other.groups) and one.frames == other.frames
    )


def _brings_nothing(one: State, other: State) -> bool:
    """Return whether `other` has all views of a state, or the same votes if the state keeps no views."""
    if not len(one.votes.data):
        return False
    if not one.views:
        alike = one.num_fused == other.num_fused and one.num_classes == other.num_classes
        return alike and all(map(np.array_equal, one.votes, other.votes))
    shared, old = shared_views(one, Counter(digests(other)))
    return len(shared) == len(one.views) and (old or not one.dropped or not one.all_known)


def digests(state: State) -> list[bytes]:
    """List the digests of the views in the votes of a state, as far as the state has them."""
    return [*(view.digest for view in state.views), *state.dropped]


def shared_views(state: State, known: Counter[bytes]) -> tuple[tuple[str, ...], bool]:
    """Return the names of the views of a state that are `known`, and whether all its dropped views are known, too.

    Each known view matches only one view, because a camera that stands still has several identical ones.
    """
    left, shared = known.copy(), []
    for view in state.views:
        if left[view.digest]:
            left[view.digest] -= 1
            shared.append(view.name)
    return tuple(shared), bool(state.dropped) and state.all_known and Counter(state.dropped) <= left
