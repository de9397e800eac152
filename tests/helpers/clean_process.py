"""Tests that fork, in a process of their own.

A worker of pytest cannot be forked: a child has its memory and none of its threads, so a lock that one of them holds
stays locked, and what waits for them on its way out, such as a ROS node that a test left behind, hangs or crashes.
"""

from __future__ import annotations

import functools
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from patience import PATIENCE


def in_clean_process(test: Callable[[Path], None]) -> Callable[[Path], None]:
    """Run a test that takes `tmp_path` alone in a new Python, which has imported the test's file and no more."""

    @functools.wraps(test)
    def run(tmp_path: Path) -> None:
        program = (
            f"import sys; sys.path[:] = {sys.path}; from pathlib import Path; import {test.__module__} as file\n"
            f"file.{test.__name__}.__wrapped__(Path({str(tmp_path)!r}))"
        )
        command = [sys.executable, "-W", "error", "-c", program]
        done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False)
        assert done.returncode == 0, done.stderr

    return run
