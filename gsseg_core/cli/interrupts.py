"""Ctrl-C in the program `gsseg`: it ends with exit code 130, in silence.

So it does by SIGTERM, as of `kill`, `timeout` or a service that stops, and by SIGHUP, once its terminal is closed: with
128 and the signal's number. Of all three, what follows says Ctrl-C.

Python raises KeyboardInterrupt wherever it happens to be; in an import, in a callback from C or at the end of the
program nobody can catch it. There the program leaves at once, which harms no file: all are written under another name
and renamed. Only while a command works is the interrupt raised, so that it can clean up; a second one ends the program.
"""

from __future__ import annotations

import os
import signal
import sys
from types import FrameType, TracebackType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sys import UnraisableHookArgs

_SIGNALS = signal.SIGINT, signal.SIGTERM, signal.SIGHUP

_raised = 0  # number of the signal that was


def exit_code() -> int:
    """Exit code of the program that was interrupted."""
    return 128 + (_raised or signal.SIGINT)


def leave_at_once() -> None:
    """From now on Ctrl-C ends this process on the spot."""
    _handle(_leave)
    sys.excepthook, sys.unraisablehook = _print_exception, _print_unraisable


def raise_once() -> None:
    """From now on the first Ctrl-C raises KeyboardInterrupt."""
    _handle(_raise)


def was_raised() -> bool:
    """Whether KeyboardInterrupt was raised; an error that arrives in its place follows from it."""
    return bool(_raised)


def _handle(handler: object) -> None:
    # A program in the background may have been started to ignore Ctrl-C, or by `nohup`; it stays so.
    for number in _SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, handler)  # type: ignore[arg-type]


def _leave(number: int, frame: FrameType | None) -> None:
    os._exit(128 + number)


def _raise(number: int, frame: FrameType | None) -> None:
    global _raised
    _raised = number
    _handle(_leave)
    raise KeyboardInterrupt


def _print_exception(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    if not issubclass(kind, KeyboardInterrupt):
        sys.__excepthook__(kind, error, trace)


def _print_unraisable(unraisable: UnraisableHookArgs) -> None:
    if issubclass(unraisable.exc_type, KeyboardInterrupt):
        os._exit(exit_code())  # Raised where Python could only have printed it.
    sys.__unraisablehook__(unraisable)
