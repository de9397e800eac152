"""Standard output and standard error of the command line: they may be closed, full, or of a poor encoding."""

from __future__ import annotations

import contextlib
import io
import os
import sys
from collections.abc import Iterator
from typing import TextIO

from gsseg_core.errors import WriteError
from gsseg_core.text import one_line, printable


def prepare() -> None:
    """Have both streams take whatever is printed: what their encoding lacks as escapes, and nowhere if they are closed.

    A closed stream is opened anew, and so is standard input, since a file that is opened later would get its number,
    and what a library prints: each gets the lowest number that is free.
    """
    for name in ("stdin", "stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "r" if name == "stdin" else "w"))  # noqa: SIM115
        elif isinstance(stream, io.TextIOWrapper) and name != "stdin":
            stream.reconfigure(errors="backslashreplace")


def tell(text: str) -> None:
    """Print what a command has found, line by line as `printable` has it: paths are whatever their owner called them.

    Raises `WriteError` where standard output cannot be written, `BrokenPipeError` where its reader has left, as `head`
    does.
    """
    with _named():
        print("\n".join(map(printable, text.split("\n"))), flush=True)


def flush() -> None:
    """Write what is still to be written to standard output; raises as `tell` does."""
    with _named():
        sys.stdout.flush()


def note(text: str) -> None:
    """Write a line for people to standard error, or nowhere if that cannot be written."""
    try:
        print(f"gsseg: {one_line(text)}", file=sys.stderr, flush=True)
    except OSError:
        abandon(sys.stderr)


def abandon(stream: TextIO) -> None:
    """Send the rest of a stream nowhere: Python would write it at the end, and fail."""
    with contextlib.suppress(OSError, ValueError):  # A replaced stream may have no descriptor.
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


@contextlib.contextmanager
def _named() -> Iterator[None]:
    """Say that it is standard output that cannot be written."""
    try:
        yield
    except OSError as error:
        abandon(sys.stdout)
        if isinstance(error, BrokenPipeError):
            raise
        raise WriteError(f"standard output: cannot be written ({error.strerror or error})") from error
