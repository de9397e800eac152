"""Views that are prepared for learning: kept in memory as far as a budget goes, and the rest in a temporary file."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TypeVar

from gsseg_core.files.scratch_file import ScratchFile
from gsseg_core.learn.free_memory import free_memory
from gsseg_core.raster.backends import free_memory_on
from gsseg_core.raster.observation import Observation

MEMORY_SHARE = 8  # they take this part of the free memory, unless asked otherwise; more goes to the file
MEMORY_BUDGET = 2 << 30  # bytes of them where the system does not say how much is free

R = TypeVar("R")

_KEEPING = threading.Lock()  # while what is kept changes; not in each object, as those travel to workers


def default_budget(device: str = "cpu") -> int:
    """Bytes of prepared views that are kept in memory where nobody says how many."""
    if device != "cpu":  # Views are all that a GPU is for.
        return free_memory_on(device) // 2
    free = free_memory()
    return MEMORY_BUDGET if free is None else free // MEMORY_SHARE


class PreparedViews:
    """Prepared views by name; a copy sent elsewhere has those in memory alone.

    They take `budget` bytes of memory at most, and 0 keeps nothing; more may go to a temporary file, if `with_file`.
    """

    def __init__(self, budget: int, with_file: bool) -> None:
        self.in_memory: dict[str, Observation] = {}
        self._sizes: dict[str, int] = {}  # bytes of each of these: asked once, not of all for every view that comes
        self._budget, self._with_file = budget, with_file
        self._file, self._answers = ScratchFile(), ScratchFile()  # views, and what each was asked and answered last

    def emptied(self) -> PreparedViews:
        """Return one like this that keeps nothing yet."""
        return PreparedViews(self._budget, self._with_file)

    @property
    def nbytes(self) -> tuple[int, int]:
        """Bytes that are kept, in memory and in the temporary file."""
        in_file = self._file.nbytes + self._answers.nbytes
        return sum(self._sizes.values()), in_file

    def keep(self, name: str, observation: Observation) -> None:
        """Keep a view, where there is room."""
        with _KEEPING:
            size = observation.nbytes
            if self.nbytes[0] + size <= self._budget:
                self.in_memory[name], self._sizes[name] = observation, size
            elif self._budget > 0 and self._with_file:
                self._file.put(name, observation)

    def get(self, name: str) -> Observation | None:
        """Return a view, if it is kept."""
        kept: Observation | None = self.in_memory.get(name)
        if kept is None:
            kept = self._file.get(name)
            if kept is not None:
                kept.answered = self._answers.get(name)
        return kept

    def ask(self, name: str, observation: Observation, work: Callable[[str, Observation], R]) -> R:
        """Work with a view; if it lies in the file, what `Observation.shares` answered last is kept beside it."""
        before, made = observation.answered, work(name, observation)
        if self._file.holds(name) and observation.answered is not before:
            with _KEEPING:
                self._answers.put(name, observation.answered)
        return made

    def drop(self, name: str) -> None:
        """Keep nothing of a view."""
        with _KEEPING:
            self.in_memory.pop(name, None)
            self._sizes.pop(name, None)
            self._file.drop(name)
            self._answers.drop(name)

    def clear(self) -> None:
        """Keep nothing."""
        self.in_memory.clear()
        self._sizes.clear()
        self._file.clear()
        self._answers.clear()
