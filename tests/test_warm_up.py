from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from gsseg_core.errors import SettingsError
from gsseg_core.warm_up import warm_up


def test_a_device_that_is_not_there_is_refused() -> None:
    with pytest.raises(SettingsError, match="device is 'toaster'"):
        warm_up("toaster")


def test_kernels_compile_once_and_the_first_run_says_so(tmp_path: Path) -> None:
    program = (
        "import time; from gsseg_core.warm_up import warm_up; start = time.perf_counter(); warm_up(say=print); "
        "print('seconds', time.perf_counter() - start)"
    )
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    first, second = (
        subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True)
        for _ in range(2)
    )
    assert first.stdout.startswith("compiling kernels"), first.stdout
    assert second.stdout.startswith("seconds"), second.stdout
    slow, fast = (float(run.stdout.split()[-1]) for run in (first, second))
    assert fast < 0.5 * slow
