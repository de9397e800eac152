"""How long tests wait for what must come: far longer than it ever takes, so that a busy machine fails none of them."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import pytest

PATIENCE = 1200.0
"""Seconds until a wait gives up."""


def wait_until(
    condition: Callable[[], Any], what: str, timeout: float = PATIENCE,
    pause: Callable[[], Any] = lambda: time.sleep(0.01),
) -> None:  # fmt: skip
    """Wait until the condition holds; fails the test, saying what was waited for."""
    deadline = time.monotonic() + timeout
    while not condition():
        if time.monotonic() > deadline:
            pytest.fail(f"waited {timeout:g} s in vain for {what}")
        pause()
