from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from small_scenes import write_dataset

from gsseg_core.errors import SettingsError
from gsseg_core.warm_up import warm_up


def test_a_device_that_is_not_there_is_refused() -> None:
    with pytest.raises(SettingsError, match="device is 'toaster'"):
        warm_up("toaster")


def run(program: str, cache: Path) -> str:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache)}
    command = [sys.executable, "-c", program]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout


def test_kernels_compile_once_the_first_run_says_so_and_no_other_are_needed(tmp_path: Path) -> None:
    cache, data = tmp_path / "cache", write_dataset(tmp_path / "data")
    program = (
        "import time; from gsseg_core.warm_up import warm_up; start = time.perf_counter(); warm_up(say=print); "
        "print('seconds', time.perf_counter() - start)"
    )
    first, second = run(program, cache), run(program, cache)
    assert first.startswith("compiling kernels"), first
    assert second.startswith("seconds"), second
    slow, fast = (float(told.split()[-1]) for told in (first, second))
    assert fast < 0.5 * slow
    compiled = {path.name for path in cache.rglob("*.nb?")}
    run(
        f"from gsseg_core.cli import main; main(['segment', {str(data / 'scene.ply')!r}, '--data', {str(data)!r}, "
        f"'--out', {str(tmp_path / 'out')!r}, '--no-graph'])",
        cache,
    )
    run(
        "from gsseg_core.dataset import Dataset; from gsseg_core.live import LiveSession; "
        "from gsseg_core.scene import GaussianScene; "
        f"session, data = LiveSession(GaussianScene.load({str(data / 'scene.ply')!r})), Dataset({str(data)!r}); "
        "assert not any(map(session.fuse, data.views('train'))); session.segmentation()",
        cache,
    )
    assert {path.name for path in cache.rglob("*.nb?")} == compiled
