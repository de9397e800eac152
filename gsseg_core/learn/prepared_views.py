"""Keeps views that are prepared for learning: in memory up to a budget, further ones in a temporary file."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TypeVar

from gsseg_core.files.scratch_file import ScratchFile
from gsseg_core.learn.free_memory import free_memory
from gsseg_core.raster.backends import free_memory_on
from gsseg_core.raster.observation import Observation

MEMORY_SHARE = 8  # the default budget is the free memory divided by this
MEMORY_BUDGET = 2 << 30  # bytes; default budget if the system does not tell how much memory is free

R = TypeVar("R")

_KEEPING = threading.Lock()  # guards changes of kept views; global, since objects that go to workers can't have locks


def default_budget(device: str = "cpu") -> int:
    """Return the default number of bytes of prepared views to keep in memory."""
    if device != "cpu":  # On a GPU, views are nearly all that takes memory.
        return free_memory_on(device) // 2
    free = free_memory()
    return MEMORY_BUDGET if free is None else free // MEMORY_SHARE


class PreparedViews:
    """Prepared views by name; a copy that is sent to another process has only those in memory.

    They take at most `budget` bytes of memory; 0 keeps nothing. Further views go to a temporary file if `with_file`.
    """

    def __init__(self, budget: int, with_file: bool) -> None:
        self.in_memory: dict[str, Observation] = {}
        self._sizes: dict[str, int] = {}  # bytes of each view in memory, cached since they are summed for each new view
        self._budget, self._with_file = budget, with_file
        self._file, self._answers = ScratchFile(), ScratchFile()  # views, and the last `Observation.answered` of each

    def emptied(self) -> PreparedViews:
        """Return an empty store with the same settings."""
        return PreparedViews(self._budget, self._with_file)

    @property
    def nbytes(self) -> tuple[int, int]:
        """Bytes of views in memory and in the temporary file."""
        in_file = self._file.nbytes + self._answers.nbytes
        return sum(self._sizes.values()), in_file

    def keep(self, name: str, observation: Observation) -> None:
        """Keep a view in memory or in the file, if there is room."""
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
        """Call `work` with a view; for a view in the file, also save the last result of `Observation.shares`."""
        before, made = observation.answered, work(name, observation)
        if self._file.holds(name) and observation.answered is not before:
            with _KEEPING:
                self._answers.put(name, observation.answered)
        return made

    def drop(self, name: str) -> None:
        """Drop a view."""
        with _KEEPING:
            self.in_memory.pop(name, None)
            self._sizes.pop(name, None)
            self._file.drop(name)
            self._answers.drop(name)

    def clear(self) -> None:
        """Drop all views."""
        self.in_memory.clear()
        self._sizes.clear()
        self._file.clear()
        self._answers.clear()
