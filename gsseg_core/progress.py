"""Progress on a terminal."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from tqdm import tqdm

from gsseg_core.learner import Progress, silent


@contextmanager
def progress_bars(quiet: bool = False) -> Iterator[Progress]:
    """Show progress while the body runs, unless `quiet`; what is yielded is called with stage, done, total."""
    if quiet:
        yield silent
        return
    bars = _Bars()
    try:
        yield bars
    finally:
        # An error message must not end up on the line of an unfinished bar.
        bars.close()


class _Bars:
    """One progress bar a stage, on standard error."""

    def __init__(self) -> None:
        self._stage = ""
        self._bar: tqdm[None] | None = None

    def __call__(self, stage: str, done: int, total: int) -> None:
        if self._bar is None or stage != self._stage:
            self.close()
            self._stage, self._bar = stage, tqdm(total=total, desc=stage, file=sys.stderr, dynamic_ncols=True)
        self._bar.update(done - self._bar.n)
        if done == total:
            self.close()

    def close(self) -> None:
        """Finish the bar that is shown, if there is one."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None
