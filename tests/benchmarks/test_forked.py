"""A job in a forked child leaves alone what its parent has still to collect."""

from __future__ import annotations

import gc
import os
from pathlib import Path

from forked import in_child


class OfOneProcess:
    """Ends any other process that collects it, as a ROS node does whose threads are not there."""

    def __init__(self) -> None:
        self.process = os.getpid()
        self.itself = self

    def __del__(self) -> None:
        if os.getpid() != self.process:
            os._exit(3)


def test_a_child_collects_nothing_that_its_parent_has_left(tmp_path: Path) -> None:
    gc.disable()
    try:
        OfOneProcess()
        assert in_child(lambda: 0 * gc.collect(), tmp_path, 60).code == 0
    finally:
        gc.enable()
