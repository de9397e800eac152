"""Where ROS 2 or the messages are not installed, the tests that need them are skipped, and counted."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import pytest
from missing_ros import MISSING


def pytest_pycollect_makemodule(module_path: Path, parent: pytest.Collector) -> pytest.Module:
    return RosModule.from_parent(parent, path=module_path)


class RosModule(pytest.Module):
    def collect(self) -> Iterable[pytest.Item | pytest.Collector]:
        try:
            return super().collect()
        except self.CollectError as error:
            if not MISSING or not isinstance(error.__cause__, ModuleNotFoundError):
                raise
            pytest.skip(f"{' and '.join(MISSING)} not installed", allow_module_level=True)
