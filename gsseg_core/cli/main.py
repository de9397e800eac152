"""The program `gsseg`: how it starts and ends, and what becomes of errors. What it takes is in `arguments`.

Only `main` imports what takes time, so that Ctrl-C is heard from the start.
"""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from typing import TYPE_CHECKING

from gsseg_core.cli import interrupts

if TYPE_CHECKING:
    from argparse import Namespace
    from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code: 0, 2 on an error of input or output, 130 when interrupted.

    Without arguments it takes those of the process, and handles Ctrl-C from then on.
    """
    if arguments is None:
        interrupts.leave_at_once()
    from gsseg_core.cli import terminal
    from gsseg_core.errors import GssegError, explained

    terminal.prepare()
    try:
        try:
            return _run(arguments)
        finally:
            terminal.flush()
    except KeyboardInterrupt:
        return interrupts.exit_code()
    except BrokenPipeError:
        return 0  # The reader of our output has left, as `head` does; there is nobody to tell.
    except Exception as error:
        if interrupts.was_raised():
            return interrupts.exit_code()
        if (what := explained(error)) is None:
            raise
        hint = "" if isinstance(error, GssegError) else "; expected smaller views, or a smaller scene"
        terminal.note(f"error: {what}{hint}")
        return 2


def _run(arguments: Sequence[str] | None) -> int:
    from gsseg_core.cli.arguments import build_parser

    given = sys.argv[1:] if arguments is None else arguments
    options = build_parser(given).parse_args(given)

    from gsseg_core.freed_memory import end_without_a_search, keep_freed_memory

    _refuse_empty(options)
    _check_threads()
    keep_freed_memory()
    try:
        if arguments is None:
            end_without_a_search()
            interrupts.raise_once()
        return options.run(options)
    finally:
        if arguments is None:
            interrupts.leave_at_once()


def _refuse_empty(options: Namespace) -> None:
    """Raise `SettingsError` for what was given as "": as a path, that would be the current folder."""
    from gsseg_core.errors import SettingsError

    for name, value in vars(options).items():
        if value == "" or (isinstance(value, list) and "" in value):
            raise SettingsError(f"{name} is ''; expected a value (is a variable of the shell unset?)")


def _check_threads() -> None:
    """Raise `SettingsError` for a number of threads that numba refuses, since it does so by a traceback."""
    from gsseg_core.errors import SettingsError
    from gsseg_core.text import quoted

    found = os.environ.get("NUMBA_NUM_THREADS", "1")
    with suppress(ValueError):
        if int(found) > 0:
            return
    raise SettingsError(
        f"environment variable NUMBA_NUM_THREADS: is {quoted(found)}; expected a number of threads from 1, or none set"
    )
