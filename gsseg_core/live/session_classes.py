"""Classes of a live session: their names and numbers, and how many there may be."""

from __future__ import annotations

import os
from collections.abc import Mapping

from gsseg_core.data.class_names import BACKGROUND_NAME, check_class_names, check_same_names, class_name, names_together
from gsseg_core.data.dataset import Dataset
from gsseg_core.errors import ClassesFileError, SettingsError, StateFileError, UnknownLabelError
from gsseg_core.files.limits import MAX_LABEL
from gsseg_core.learn.learner import Learner
from gsseg_core.learn.learner_state import State

VOTES_LIMIT = 2 << 30
"""Bytes of votes up to which classes without declared names are added as their labels turn up.

Those that are there already may go beyond: what they take depends on where their masks lie.
"""


class SessionClasses:
    """Classes of a session: those that were declared by names and no others, or else those that turn up."""

    def __init__(self, declared: Mapping[int, str] | None, max_classes: int) -> None:
        check_class_names(declared or {}, SettingsError)
        self.declared, self._max_classes = bool(declared), max_classes  # the latter counts where none were declared
        self.names = {0: BACKGROUND_NAME, **(declared or {})}  # as far as they are known; replaced and never changed

    @property
    def least(self) -> int:
        """How many there are before any view has come: those declared, or the background alone."""
        return max(self.names) + 1 if self.declared else 1

    def limit(self, votes: Learner) -> tuple[int, str]:
        """How many there may be: those declared, or what is allowed and there is memory for beside the votes so far.

        Second comes the reason, as the end of a sentence that the number is in.
        """
        if self.declared:
            return self.least, " (as named)"
        affordable = votes.most_classes(VOTES_LIMIT)
        if self._max_classes <= affordable:
            return self._max_classes, f", as max_classes is {self._max_classes}"
        return affordable, f" for a scene of {len(votes.scene)} Gaussians"

    def reset(self, names: Mapping[int, str]) -> None:
        """Replace the names, unless they were declared."""
        if not self.declared:
            self.names = {0: BACKGROUND_NAME, **names}

    def number(self, names: Mapping[int, str], count: int, *, keep_numbers: bool) -> tuple[dict[int, int], bool]:
        """Find the ids of a segmenter's classes as `ids_by_name` does, and add those that are new; whether any is."""
        most = 0 if self.declared else self._max_classes
        ids = ids_by_name(names, self.names, most, count, keep_numbers=keep_numbers)
        named = {} if self.declared else {ids[k]: name for k, name in names.items() if ids[k]}
        added = {k: name for k, name in named.items() if class_name(self.names, k) != name}
        self.names = {**self.names, **added}
        return ids, bool(added)

    def check_state(self, state: State, path: str | os.PathLike[str], votes: Learner) -> None:
        """Raise `StateFileError` if a state has too many classes, or other names than were declared."""
        most, why = self.limit(votes)
        if state.num_classes > most:
            raise StateFileError(f"{path}: holds {state.num_classes} classes; expected at most {most}{why}")
        if self.declared:
            check_same_names(state.class_names, self.names, path, "the names that were given", StateFileError)

    def check_label(self, label: int, votes: Learner, found: str, remedy: str) -> None:
        """Raise `UnknownLabelError` where there may be no such class: what was `found`, what is expected, a remedy."""
        most, why = self.limit(votes)
        if label >= most:
            raise UnknownLabelError(f"{found}; expected at most {most - 1}{why}{remedy}")

    def check_dataset(self, dataset: Dataset, *, fused: bool) -> None:
        """Raise `ClassesFileError` if a dataset has other names than were declared, or than `fused` views have.

        0 is the background, whatever it is called.
        """
        # Not `dataset.class_names`: to make up names takes reading all masks.
        given = next((view.class_names for view in dataset.views()), None) or {}
        called, known = {k: name for k, name in given.items() if k}, self.names if self.declared or fused else {}
        check_same_names(called, known, dataset.root, "the session that is to learn from it", ClassesFileError)

    def count_with(self, dataset: Dataset, num_classes: int, votes: Learner) -> int:
        """Count the classes with those of a dataset; raises `UnknownLabelError` if they are too many."""
        if self.declared:
            return num_classes
        (most, why), count = self.limit(votes), max(num_classes, dataset.num_classes)
        if count > most:
            raise UnknownLabelError(
                f"{dataset.root}: has {count} classes; expected at most {most}{why}, or class_names that declare them"
            )
        return count

    def add(self, dataset: Dataset, *, fused: bool) -> None:
        """Add the names of a dataset's classes, unless names were declared; raises as `check_dataset` does."""
        if not self.declared:
            self.check_dataset(dataset, fused=fused)
            self.names = names_together(self.names, dataset.class_names)


def ids_by_name(
    names: Mapping[int, str],  # the segmenter's classes by its numbers
    known: Mapping[int, str],  # classes so far; of several of one name the first counts, those like "class_07" are none
    max_classes: int,  # 0: there are no new classes, and what is not known is background
    count: int = 0,  # classes that there are by number, known by a name or not: masks without names may have these
    *,
    keep_numbers: bool = True,  # whether the segmenter's numbers are wanted as ids
) -> dict[int, int]:
    """Find the ids of a segmenter's classes, by its numbers; `UnknownLabelError` for more classes than labels.

    A class that is known by its name has its id. A new one gets the segmenter's number, if that is free and below
    `max_classes`, and else the next one after all. 0 is the background's.
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
    following = max(count, max(taken) + 1)
    for _, name in sorted(names.items()):
        if name not in ids:
            ids[name] = following
            following += 1
    if following > MAX_LABEL + 1:
        raise UnknownLabelError(f"classes would have ids up to {following - 1}; expected at most {MAX_LABEL}")
    return {k: ids[name] for k, name in names.items()}
