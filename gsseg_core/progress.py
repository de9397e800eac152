"""Progress of long work: how far it is, how that is shown on a terminal, and how long its stages took."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from tqdm import tqdm

T = TypeVar("T")

Progress = Callable[[str, int, int], None]
"""Called with what is being done, how many steps of it are done, and of how many."""


def silent(stage: str, done: int, total: int) -> None:
    """Report no progress."""


def with_progress(progress: Progress, stage: str, items: Collection[T]) -> Iterator[T]:
    """Give items one after the other, and tell before each, and at the end, how many are done."""
    for done, item in enumerate(items):
        progress(stage, done, len(items))
        yield item
    progress(stage, len(items), len(items))


@contextmanager
def progress_bars(quiet: bool = False) -> Iterator[Progress]:
    """Show progress while the body runs, unless `quiet`; what is yielded is called with stage, done, total."""
    bars = _Bars()
    try:
        yield silent if quiet else bars
    finally:
        bars.close()  # An error message must not end up on the line of an unfinished bar.


class _Bars:
    """One progress bar a stage, on standard error; where that cannot be written, the work goes on without."""

    def __init__(self) -> None:
        self._stage = ""
        self._bar: tqdm[None] | None = None

    def __call__(self, stage: str, done: int, total: int) -> None:
        from tqdm import tqdm

        with suppress(OSError):
            if self._bar is None or stage != self._stage:
                self.close()
                self._stage, self._bar = stage, tqdm(total=total, desc=stage, file=sys.stderr, dynamic_ncols=True)
            self._bar.update(done - self._bar.n)
            if done == total:
                self.close()

    def close(self) -> None:
        """Finish the bar that is shown, if there is one."""
        bar, self._bar = self._bar, None
        if bar is not None:
            with suppress(OSError):
                bar.close()


class Stopwatch:
    """Seconds per stage of a run, in the order in which the stages ran."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time what happens inside."""
        start = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start
