"""Ids of classes by their names: segmenters number their classes, each in its own way."""

from __future__ import annotations

import os
from collections.abc import Mapping

from gsseg_core.data.class_names import BACKGROUND_NAME, class_name
from gsseg_core.errors import StateFileError, UnknownLabelError
from gsseg_core.files.limits import MAX_LABEL
from gsseg_core.learn.learner_state import State

VOTES_LIMIT = 2 << 30
"""Bytes of votes up to which classes without declared names are added as their labels turn up."""


def require_affordable(needed: int, max_classes: int, num_gaussians: int, what: str, remedy: str) -> None:
    """Raise `UnknownLabelError` where more classes would be needed than are allowed, or than there is memory for.

    The message begins with `what` the last of them is for, and ends in a `remedy`.
    """
    most, why = most_classes(max_classes, num_gaussians)
    if needed > most:
        raise UnknownLabelError(f"{what} {needed - 1}; expected at most {most - 1}{why}{remedy}")


def most_classes(max_classes: int, num_gaussians: int, num_declared: int = 0) -> tuple[int, str]:
    """How many classes there may be, and why: those declared, if any, or else what is allowed and there is memory for.

    The reason is the end of a sentence that the number is in.
    """
    if num_declared:
        return num_declared, " (as named)"
    affordable = VOTES_LIMIT // (8 * num_gaussians)
    if max_classes <= affordable:
        return max_classes, f", as max_classes is {max_classes}"
    return affordable, f" for a scene of {num_gaussians} Gaussians"


def check_classes_of(
    state: State, path: str | os.PathLike[str], declared: Mapping[int, str], max_classes: int, num_gaussians: int
) -> None:
    """Raise `StateFileError` if a state has too many classes, or other names than were declared, if any were."""
    most, why = most_classes(max_classes, num_gaussians, max(declared) + 1 if declared else 0)
    if state.num_classes > most:
        raise StateFileError(f"{path}: holds {state.num_classes} classes; expected at most {most}{why}")
    if declared:
        state.check_names(declared, path, "the names that were given")


def ids_by_name(
    names: Mapping[int, str], known: Mapping[int, str], max_classes: int, *, keep_numbers: bool = True
) -> dict[int, int]:
    """Find the ids of a segmenter's classes by their names.

    A class that is known has its id. A new one gets the segmenter's number, if that is free and below `max_classes`,
    and else the next one after all. 0 is the background's.

    Parameters
    ----------
    names : mapping from number to name
        The segmenter's classes.
    known : mapping from id to name
        The classes so far; of several of one name the first counts, and names like "class_07" are none.
    max_classes : int
        0: there are no new classes, and what is not known is background.
    keep_numbers : bool
        Whether the segmenter's numbers are wanted as ids.

    Returns
    -------
    dict of int to int
        Id by number.

    Raises
    ------
    UnknownLabelError
        There would be more classes than labels.
    """
    known = {k: name for k, name in known.items() if name != class_name({}, k)}
    ids = {BACKGROUND_NAME: 0} | {name: k for k, name in sorted(known.items(), reverse=True)}
    if not max_classes:
        return {k: ids.get(name, 0) for k, name in names.items()}
    taken = {0, *known}
    for k, name in sorted(names.items()):
        if keep_numbers and name not in ids and k < max_classes and k not in taken:
            ids[name] = k
            taken.add(k)
    following = max(taken) + 1
    for _, name in sorted(names.items()):
        if name not in ids:
            ids[name] = following
            following += 1
    if following > MAX_LABEL + 1:
        raise UnknownLabelError(f"classes would have ids up to {following - 1}; expected at most {MAX_LABEL}")
    return {k: ids[name] for k, name in names.items()}


def add_names(known: dict[int, str], names: Mapping[int, str], ids: Mapping[int, int]) -> bool:
    """Add the classes of a segmenter, with the ids that `ids_by_name` found, to the known ones; whether any is new."""
    added = {ids[k]: name for k, name in names.items() if ids[k] and known.get(ids[k]) != name}
    known.update(added)
    return bool(added)
