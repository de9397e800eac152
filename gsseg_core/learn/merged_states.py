"""States of one scene added up: what several robots have learnt, as if all masks had come to one of them."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.class_names import names_together
from gsseg_core.data.view import View
from gsseg_core.errors import StateFileError, StateMismatchError
from gsseg_core.learn.learner_state import OBJECTS_OF_ONE_SESSION, State
from gsseg_core.scene.group_frames import is_same
from gsseg_core.scene.living_scene import LivingScene


class Saved(NamedTuple):
    """A state, and what errors call it."""

    source: str  # its file, or "the session"
    scene: str  # digest of its scene
    state: State


def merge_states(saved: Sequence[Saved]) -> State:  # at least one
    """Add up states of one scene: votes exactly, views one after the other, class names together.

    Views of the same name are told apart: the later one is called like "view_2". Codes that were learnt are those of
    the views of one state, and go.

    Raises
    ------
    StateMismatchError
        They are of different scenes.
    StateFileError
        They have different names for one class, or ids that each session gave to the objects that it found; or one
        brings no view that one before it has not, and would count twice; or some have votes of whole rays, and some
        have not.
    """
    first = saved[0]
    names: dict[int, str] = {}
    views: dict[str, View] = {}
    votes = CSRRows.empty(first.state.votes.num_rows, np.int64)
    for number, one in enumerate(saved):
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
        one.state.check_names(names, one.source, "the states before it")
        names = names_together(names, one.state.class_names)
        for other in saved[:number]:
            if _brings_nothing(one.state, other.state):
                raise StateFileError(
                    f"{one.source}: {other.source} has all its votes and views already, which would count twice; "
                    "expected each state once"
                )
        votes = votes.plus(one.state.votes)
        for view in one.state.views:
            name = next(free for free in _names(view.name) if free not in views)
            views[name] = view if name == view.name else replace(view, camera=replace(view.camera, name=name))
    num_fused, num_classes = sum(one.state.num_fused for one in saved), max(one.state.num_classes for one in saved)
    # One state alone stays of its kind.
    return replace(
        first.state, votes=votes.nonzero(), num_classes=num_classes, views=[*views.values()], num_fused=num_fused,
        class_names=dict(sorted(names.items())), learnt=None,
    )  # fmt: skip


def _names(name: str) -> Iterator[str]:
    """Give the names that views of one name get, one after the other."""
    yield name
    yield from (f"{name}_{count}" for count in itertools.count(2))


def _is_same_map(one: LivingScene | None, other: LivingScene | None) -> bool:
    """Whether two states hold their views in the same frames; without a scene of their own, in that of the scene."""
    if one is None or other is None or one is other:
        return one is other
    return (
        np.array_equal(one.ids, other.ids)
        and np.array_equal(one.groups, other.groups)
        and one.frames.keys() == other.frames.keys()
        and all(is_same(frame, other.frames[group]) for group, frame in one.frames.items())
    )


def _brings_nothing(one: State, other: State) -> bool:
    """Whether another state holds all views of a state, or the same votes where no views are kept."""
    if not len(one.votes.data):
        return False
    if not one.views:
        alike = one.num_fused == other.num_fused and one.num_classes == other.num_classes
        return alike and all(map(np.array_equal, one.votes, other.votes))
    known = {view.name: view for view in other.views}
    return all(_is_among(view, known) for view in one.views)


def _is_among(view: View, known: dict[str, View]) -> bool:
    """Whether a view is there, under its name or one that merging gave it."""
    return any(_is_same_view(view, known[name]) for name in itertools.takewhile(known.__contains__, _names(view.name)))


def _is_same_view(one: View, other: View) -> bool:
    return (
        one.group == other.group
        and np.array_equal(one.camera.K, other.camera.K)
        and np.array_equal(one.camera.world_to_camera, other.camera.world_to_camera)
        and np.array_equal(one.read_labels(), other.read_labels())
    )
