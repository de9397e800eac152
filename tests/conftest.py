"""Fixtures that several test files share."""

from __future__ import annotations

import contextlib
import fcntl
import gc
import io
import os
import pickle
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING
from unittest import mock

import browser
import processes
import pytest
from hypothesis import HealthCheck, settings

if TYPE_CHECKING:
    from operator_backends import Backend
    from playwright.sync_api import Browser, Page

DATA = Path(os.environ.get("GSSEG_DATA") or Path(__file__).parents[2] / "shared" / "data")
_NO_DATA = "real data not found"
_NO_GPU = "no GPU to be had"
_NO_BROWSER = "no Chromium"
# As `gsseg view` has it: a browser may leave while it is being sent something. A thread may say so in a later test.
_LEFT = pytest.mark.filterwarnings("ignore:Queued a .* on a closed connection:UserWarning")


# How fast examples are drawn and run says something of the machine only. Who changes what a law is about looks longer,
# by --hypothesis-profile=long.
settings.register_profile("short", deadline=None, suppress_health_check=[HealthCheck.too_slow], max_examples=25)
settings.register_profile("long", settings.get_profile("short"), max_examples=500)
settings.load_profile("short")


def pytest_configure(config: pytest.Config) -> None:
    """Let processes that tests start hear SIGINT: a test run in the background is deaf to it, and they inherit that.

    Where tests that start processes are left out, nothing waits for the disk.
    """
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.addaudithook(processes.refuse_events)
    gc.disable()  # Until all is imported, of which nothing is garbage: a fifth of that time.
    if _starts_none(config):
        os.fsync = lambda file: None  # The machine goes on, and there are 5,000 of them.


def _starts_none(config: pytest.Config) -> bool:
    return bool(config.option.markexpr == f"not {processes.MARKER}")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests that start processes, which `make check` leaves out; beside each other, they begin."""
    processes.mark(items)
    for item in items:
        item.add_marker(_LEFT)
    if "PYTEST_XDIST_WORKER" in os.environ:
        processes.put_first(items)


def pytest_collection_finish() -> None:
    """Take what has been imported for all tests as there to stay; Python would look through it again and again."""
    assert "forked" not in sys.modules, "benchmarks/forked.py sets how numba runs, for programs of its own"
    gc.freeze()
    gc.enable()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Hold the tests that are left where those that start processes are left out to starting none."""
    processes.allow(not _starts_none(item.config))
    try:
        return (yield)
    finally:
        processes.allow(True)


@pytest.fixture
def real_data() -> Path:
    """Folder of the real scenes; the test is skipped where there is none."""
    if not DATA.is_dir():
        pytest.skip(f"{_NO_DATA} under {DATA}")
    return DATA


@pytest.fixture(scope="session")
def demo_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `gsseg demo` wrote, to be read only: made once for all workers.

    What it printed is in said.txt, the `DemoScene` that it built in built.pickle.
    """
    from gsseg_core.cli.main import main
    from gsseg_core.demo import run, table_scene

    def build_and_keep(folder: Path, seed: int) -> table_scene.DemoScene:
        built = table_scene.build_demo(folder, seed)
        (out / "built.pickle").write_bytes(pickle.dumps(built))
        return built

    own = tmp_path_factory.getbasetemp()
    top = own.parent if "PYTEST_XDIST_WORKER" in os.environ else own
    out = top / "demo_run"
    with (top / "demo_run.lock").open("w") as lock, contextlib.redirect_stdout(io.StringIO()) as said:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (out / "said.txt").exists():
            with mock.patch.object(run, "build_demo", build_and_keep):
                assert main(["demo", "--out", str(out), "--quiet"]) == 0
            (out / "said.txt").write_text(said.getvalue())
    return out


@pytest.fixture(scope="session", params=["cpu", "cuda"])
def backend(request: pytest.FixtureRequest) -> Backend:
    """Each implementation of the view operator; the tests of one that cannot run here are skipped."""
    from operator_backends import BACKENDS, why_missing  # It imports torch, which most tests do without.

    why = why_missing(request.param)
    if why:
        pytest.skip(f"{_NO_GPU}: {why}")
    return BACKENDS[request.param]


@pytest.fixture(scope="module")
def chromium() -> Iterator[Browser]:
    """A headless Chromium; the test is skipped where there is none. One a module: while it runs, so does its loop."""
    why = browser.why_missing()
    if why:
        pytest.skip(f"{_NO_BROWSER}: {why}")
    with browser.started_chromium() as started:
        yield started


@pytest.fixture
def page(chromium: Browser) -> Iterator[Page]:
    """An empty page of it; what the page logs as an error fails the test."""
    with browser.opened_page(chromium) as opened:
        yield opened


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say how many tests had to do without the real scenes, a GPU or a browser: a skip must not look like a pass."""
    skips = [str(report.longrepr) for report in terminalreporter.stats.get("skipped", [])]
    without = {
        _NO_DATA: f"real data not found under {DATA} (set GSSEG_DATA)",
        _NO_GPU: "no GPU, so the operator was tested on a simulated one alone (docs/gpu.md)",
        _NO_BROWSER: f"no Chromium to open pages with (install one, or set {browser.VARIABLE})",
    }
    for reason, text in without.items():
        count = sum(reason in skip for skip in skips)
        if count:
            terminalreporter.write_line(f"{count} tests skipped: {text}")
