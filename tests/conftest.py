"""Fixtures that several test files share."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

DATA = Path(os.environ.get("GSSEG_DATA") or Path(__file__).parents[2] / "shared" / "data")
_NO_DATA = "real data not found"


def pytest_configure() -> None:
    """Let processes that tests start hear SIGINT: a test run in the background is deaf to it, and they inherit that."""
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture
def real_data() -> Path:
    """Folder of the real scenes; the test is skipped where there is none."""
    if not DATA.is_dir():
        pytest.skip(f"{_NO_DATA} under {DATA}")
    return DATA


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say how many tests had to do without the real scenes: a skip must not look like a pass."""
    skips = [report for report in terminalreporter.stats.get("skipped", []) if _NO_DATA in str(report.longrepr)]
    if skips:
        terminalreporter.write_line(f"{len(skips)} tests skipped: real data not found under {DATA} (set GSSEG_DATA)")
