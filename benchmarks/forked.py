"""Jobs in forked children of one warm process: modules are imported and kernels loaded once, a job starts in no time.

A process that has started threads of OpenMP cannot be forked, so numba's own threads are used here: import this module
before anything that imports numba.
"""

from __future__ import annotations

import os
import resource
import select
import signal
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

THREADS = {"NUMBA_THREADING_LAYER": "workqueue", "NUMBA_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
"""Variables that are set for this process; one that is no fork of it must not inherit them."""

os.environ.update(THREADS)

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests/helpers"))  # Small scenes and the robot are there.

from machine import memory_of  # noqa: E402 - it imports NumPy, which reads these

MOST_MEMORY = 2 << 30
"""Bytes that a child may have in memory: a bomb must not take the machine with it."""


@dataclass(frozen=True)
class Ended:
    """How a child ended.

    Attributes
    ----------
    code : int
        Its exit code; minus the number of the signal that ended it.
    in_time : bool
        Whether it ended by itself.
    seconds : float
        How long it ran.
    peak : int
        Most memory that it had, with what it shares with its parent, in bytes.
    output, errors : str
        What it wrote.
    """

    code: int
    in_time: bool
    seconds: float
    peak: int
    output: str
    errors: str


def in_child(job: Callable[[], int | None], folder: Path, seconds: float) -> Ended:
    """Run a job in a forked child, and end the child with SIGKILL after so many seconds.

    Parameters
    ----------
    job : callable
        Returns the exit code.
    folder : pathlib.Path
        Gets what the child writes to stdout and stderr.
    seconds : float
        Patience, or the moment of the kill.
    """
    paths = folder / "stdout", folder / "stderr"
    sys.stdout.flush()
    sys.stderr.flush()
    started = time.perf_counter()
    child = os.fork()
    if child == 0:
        os._exit(_do(job, paths))
    in_time = _ended_within(child, seconds)
    if not in_time:
        os.kill(child, signal.SIGKILL)
    _, status, usage = os.wait4(child, 0)
    took = time.perf_counter() - started
    output, errors = (path.read_text(errors="replace") if path.is_file() else "" for path in paths)
    code = os.waitstatus_to_exitcode(status)
    return Ended(code, in_time, took, usage.ru_maxrss << 10, output, errors)


def run_command(arguments: list[str]) -> int:
    """Do what `gsseg` with these arguments does; returns the exit code."""
    from gsseg_core.cli import main as cli

    try:
        return cli.main(arguments)
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else 1


def _do(job: Callable[[], int | None], paths: tuple[Path, Path]) -> int:
    for number, path in zip((1, 2), paths, strict=True):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
    resource.setrlimit(resource.RLIMIT_AS, (memory_of("VmSize") + MOST_MEMORY - memory_of("VmRSS"),) * 2)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        code = job() or 0
    except BaseException:
        traceback.print_exc()
        code = 1
    sys.stdout.flush()
    sys.stderr.flush()
    return code


def _ended_within(child: int, seconds: float) -> bool:
    """Wait for a child; to the millisecond, for a kill that shall hit what takes a few of them."""
    deadline = time.perf_counter() + seconds
    descriptor = os.pidfd_open(child)
    try:
        poller = select.poll()
        poller.register(descriptor, select.POLLIN)
        left = deadline - time.perf_counter()
        if left > 0.005 and poller.poll((left - 0.002) * 1000):
            return True
        while time.perf_counter() < deadline:
            if poller.poll(0):
                return True
        return bool(poller.poll(0))
    finally:
        os.close(descriptor)
