"""Where compiled kernels cannot be kept, everything works all the same."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import gsseg_core
from gsseg_core import warm_up
from gsseg_core.kernels import kernel_cache

# Every module with kernels is imported; one is compiled and run.
EVERY_KERNEL = """
import importlib, os, pathlib, gsseg_core
folder = pathlib.Path(gsseg_core.__file__).parent
kernels = [path for path in folder.rglob("*.py") if "@kernel" in path.read_text()]
for path in kernels:
    importlib.import_module(".".join(path.relative_to(folder.parent).with_suffix("").parts))
import numpy as np
from gsseg_core.kernels import kernel_cache
from gsseg_core.learn.em.rejected_regions import connected_pixels
_, first, _ = connected_pixels(np.zeros((2, 2), np.int32))
print(len(kernels) > 15, kernel_cache.FOLDER, *first, connected_pixels.stats.cache_path)
"""

ONE_KERNEL = """
import numpy as np
from gsseg_core.learn.em.rejected_regions import connected_pixels
print(connected_pixels(np.zeros((2, 2), np.int32))[1].tolist(), sum(connected_pixels.stats.cache_hits.values()))
"""
IS_INCOMPLETE = "from gsseg_core.kernels import kernel_cache; print(kernel_cache.INCOMPLETE)"
# Without a GPU nothing is compiled: what its cache is asked for is all that there is of one.
ONE_OF_THE_GPU = """
from pathlib import Path
from types import SimpleNamespace
from gsseg_core.raster.gpu import device
target = SimpleNamespace(refresh=lambda: None, codegen=lambda: SimpleNamespace(magic_tuple=lambda: ((8, 0),)))
cache = device._try._cache
index = Path(cache._cache_file._index_path)
index.parent.mkdir(parents=True, exist_ok=True)
def load(content):
    index.write_bytes(content)
    return cache.load_overload((), target)
print(load(b""), load(bytes(100)), cache.load_overload((), target))
"""
FULL_DISK = """
import errno, os
def full(*_):
    raise OSError(errno.ENOSPC, "No space left on device")
os.replace = full
"""


@pytest.fixture
def nowhere(tmp_path: Path) -> dict[str, str]:
    """The environment of a copy of the package that numba can write nothing for; root may write to any real folder."""
    shutil.copytree(Path(gsseg_core.__file__).parent, tmp_path / "gsseg_core", ignore=shutil.ignore_patterns("__pyc*"))
    for room in [tmp_path / "gsseg_core", *(path.parent for path in (tmp_path / "gsseg_core").rglob("__init__.py"))]:
        (room / "__pycache__").touch()  # A file, where a folder is expected.
    environment = {**os.environ, "PYTHONPATH": str(tmp_path), "HOME": "/dev/null", "PYTHONDONTWRITEBYTECODE": "1"}
    for name in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME"):
        environment.pop(name, None)
    return environment


def run(environment: dict[str, str], *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, env=environment, cwd="/")


def test_every_kernel_loads_and_runs_where_none_can_be_kept(nowhere: dict[str, str], tmp_path: Path) -> None:
    done = run(nowhere, "-c", EVERY_KERNEL)
    assert done.stdout == "True None 0 None\n", done.stderr
    done = run(nowhere, "-m", "gsseg_core.cli", "segment", "--help")
    assert done.returncode == 0 and done.stderr == ""
    done = run({**nowhere, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}, "-c", EVERY_KERNEL)
    assert done.stdout.startswith(f"True {tmp_path}/cache 0 {tmp_path}/cache/"), done.stderr
    assert list((tmp_path / "cache").rglob("*.nbi"))


def test_kernels_run_where_folders_or_files_of_the_cache_are_somebody_elses(
    nowhere: dict[str, str], tmp_path: Path
) -> None:
    environment = {**nowhere, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    assert run(environment, "-c", ONE_KERNEL).stdout == "[0] 0\n"
    (kept,) = (tmp_path / "cache").rglob("kernel.*connected_pixels*.nbi")
    kept.unlink()
    kept.mkdir()  # Root may read any file, but none that is a folder; nor write into a file.
    done = run(environment, "-c", ONE_KERNEL)
    assert done.stdout == "[0] 0\n", done.stderr
    shutil.rmtree(kept.parent)
    kept.parent.touch()
    done = run(environment, "-c", ONE_KERNEL)
    assert done.stdout == "[0] 0\n", done.stderr


@pytest.mark.parametrize("unusable", ["", "relative", "~"])
def test_no_kernel_is_loaded_from_the_folder_in_which_the_user_happens_to_be(tmp_path: Path, unusable: str) -> None:
    environment = {**os.environ, "HOME": str(tmp_path), "XDG_CACHE_HOME": unusable}
    ours = "from gsseg_core.kernels import kernel_cache as k; print(k.candidates()[-1])"
    numbas = "from numba.misc.appdirs import AppDirs; print(AppDirs(appname='numba', appauthor=False).user_cache_dir)"
    done = run(environment, "-c", f"{ours}; {numbas}")
    assert done.stdout == 2 * f"{tmp_path}/.cache/numba\n", done.stderr


@pytest.mark.parametrize("home", ["~", "here"])  # "~" is what is left of it for a user whom the system does not know
def test_a_user_without_a_home_gets_no_folder_of_kernels_where_he_happens_to_be(
    monkeypatch: pytest.MonkeyPatch, home: str
) -> None:
    monkeypatch.setenv("HOME", home)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    assert all(map(os.path.isabs, kernel_cache.candidates()))


def test_a_kernel_that_is_not_whole_on_the_disk_is_compiled_anew_and_kept(tmp_path: Path) -> None:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    assert run(environment, "-c", ONE_KERNEL).stdout == "[0] 0\n"
    for suffix in ("nbi", "nbc"):  # as a power failure leaves files that were written just before
        (kept,) = tmp_path.rglob(f"kernel.*connected_pixels*.{suffix}")
        for content in (b"", kept.read_bytes()[:100], bytes(kept.stat().st_size)):
            kept.write_bytes(content)
            done = run(environment, "-c", ONE_KERNEL)
            assert done.stdout == "[0] 0\n", done.stderr
    assert run(environment, "-c", ONE_KERNEL).stdout == "[0] 1\n"


def test_a_kernel_of_the_gpu_that_is_not_whole_on_the_disk_is_compiled_anew(tmp_path: Path) -> None:
    done = run({**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}, "-c", ONE_OF_THE_GPU)
    assert done.stdout == "None None None\n", done.stderr


def test_a_disk_too_full_to_keep_a_kernel_does_not_end_the_run(tmp_path: Path) -> None:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    done = run(environment, "-c", FULL_DISK + ONE_KERNEL)
    assert done.stdout == "[0] 0\n", done.stderr
    assert run(environment, "-c", ONE_KERNEL).stdout == "[0] 0\n"
    (kept,) = tmp_path.rglob("kernel.*connected_pixels*.nbc")
    kept.write_bytes(b"")
    done = run(environment, "-c", FULL_DISK + ONE_KERNEL)
    assert done.stdout == "[0] 0\n", done.stderr


def test_a_kernel_that_could_not_be_kept_is_noted(tmp_path: Path) -> None:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    for before, noted in ((FULL_DISK, True), ("", False)):
        done = run(environment, "-c", before + ONE_KERNEL + IS_INCOMPLETE)
        assert done.stdout == f"[0] 0\n{noted}\n", done.stderr


def test_who_waited_is_told_that_some_kernels_could_not_be_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel_cache, "INCOMPLETE", True)
    monkeypatch.setattr(warm_up, "_warm", set())
    lines: list[str] = []
    warm_up.warm_up(say=lines.append)
    assert lines[-1] == warm_up.NOT_KEPT and "NUMBA_CACHE_DIR" in lines[-1]


def test_only_trying_tells_whether_a_folder_can_be_written_to(tmp_path: Path) -> None:
    assert kernel_cache.writable(str(tmp_path / "new/folder")) and not list((tmp_path / "new/folder").iterdir())
    (tmp_path / "file").touch()
    assert not kernel_cache.writable(str(tmp_path / "file"))
    assert not kernel_cache.writable("/proc/gsseg")


def test_numbas_own_order_of_folders_is_followed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from numba.misc.appdirs import AppDirs

    monkeypatch.setenv("NUMBA_CACHE_DIR", "/first")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    first, own, user = kernel_cache.candidates()
    assert first == "/first" and own.endswith("gsseg_core/__pycache__")
    assert user == AppDirs(appname="numba", appauthor=False).user_cache_dir


@pytest.mark.parametrize(("folder", "told"), [("/x", "only the first run"), (None, "set NUMBA_CACHE_DIR to a folder")])
def test_who_waits_for_a_compilation_is_told_whether_it_comes_again(
    monkeypatch: pytest.MonkeyPatch, folder: str | None, told: str
) -> None:
    monkeypatch.setattr(kernel_cache, "FOLDER", folder)
    lines: list[str] = []
    listener = warm_up._FirstCompilation(lines.append)
    listener.on_start(None)
    listener.on_start(None)
    assert len(lines) == 1 and told in lines[0]
