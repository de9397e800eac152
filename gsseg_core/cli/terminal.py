"""Standard output and standard error of the command line: they may be closed, full, or of few characters."""

from __future__ import annotations

import contextlib
import io
import os
import sys
from collections.abc import Iterator
from typing import TextIO

from gsseg_core.errors import WriteError
from gsseg_core.text import one_line


def prepare() -> None:
    """Have both streams take whatever is printed: what their encoding lacks, as escapes; if they are closed, nowhere.

    A file that is opened later must not get the number of a closed stream either.
    """
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def tell(text: str) -> None:
    """Print what a command has found.

    Raises
    ------
    WriteError
        Standard output cannot be written.
    BrokenPipeError
        Its reader has left, as `head` does.
    """
    with _named():
        print(text, flush=True)


def flush() -> None:
    """Write what is still to be written to standard output; raises as `tell` does."""
    with _named():
        sys.stdout.flush()


def note(text: str) -> None:
    """Write a line for people to standard error; where that cannot be written, nobody reads it."""
    try:
        print(f"gsseg: {one_line(text)}", file=sys.stderr, flush=True)
    except OSError:
        abandon(sys.stderr)


def abandon(stream: TextIO) -> None:
    """Send the rest of a stream nowhere, since Python writes it at the end, and would complain."""
    with contextlib.suppress(OSError, ValueError):  # It may be a stand-in, without a file.
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
