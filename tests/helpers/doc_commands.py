"""Run the documentation's commands: to their end, or until they say that they serve; those that install are checked.

`make` runs dry. `pip install` is held against setup.py, since a test installs nothing: folders are packages, extras
exist, and a package that is asked for by name is one that gsseg needs.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import os
import re
import runpy
import shlex
import signal
import subprocess
import time
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import pytest
from doc_blocks import REPOSITORY
from patience import PATIENCE

from gsseg_core.cli.arguments import build_parser
from gsseg_core.cli.main import main

TIMEOUT = PATIENCE
_SHELL = re.compile(r"[|&><;`]|\$\(")


class Server(NamedTuple):
    """A command that runs until it is interrupted."""

    ready: str  # What its output has, as a pattern, once it serves.
    options: tuple[str, ...] = ()  # Added, so that it meets no other test run, and nobody outside this machine.
    gives: str = ""  # The variable into which a reader copies what `ready` found.


SERVERS = {
    "gsseg view": Server(r"http://", ("--port", "18080")),
    "ros2 run gsseg_ros segment_node": Server(r"\[gsseg\]: active"),
    "dask scheduler": Server(
        r"tcp://[\d.:]+(?=\s)", ("--host", "127.0.0.1", "--port", "0", "--dashboard-address", "127.0.0.1:0"), "ADDRESS"
    ),
    "dask worker": Server(
        "Starting established connection", ("--host", "127.0.0.1", "--nthreads", "1", "--no-dashboard")
    ),
}


class Started:
    """What was started and may still run; ended with the page."""

    def __init__(self, desk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self._desk, self._monkeypatch = desk, monkeypatch
        self._processes: list[subprocess.Popen[str]] = []

    def run(self, command: list[str]) -> None:
        """Run a command to its end; what it leaves in the background is ended with the page."""
        process, output = self._start(command)
        code = process.wait(TIMEOUT)
        assert code == 0, f"{command[-1]}\n{output.read_text()}"

    def serve(self, command: list[str], server: Server) -> None:
        """Start a command that never ends by itself, and wait until it serves."""
        process, output = self._start(command)
        deadline = time.monotonic() + TIMEOUT
        while (found := re.search(server.ready, output.read_text())) is None:
            running = process.poll() is None and time.monotonic() < deadline
            assert running, f"{shlex.join(command)} does not serve\n{output.read_text()}"
            time.sleep(0.05)
        if server.gives:
            self._monkeypatch.setenv(server.gives, found[0])

    def end(self) -> None:
        """End everything, with what it started."""
        for number, patience in ((signal.SIGINT, 3), (signal.SIGKILL, TIMEOUT)):
            for process in self._processes:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(process.pid, number)
            for process in self._processes:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(patience)

    def _start(self, command: list[str]) -> tuple[subprocess.Popen[str], Path]:
        output = self._desk / f"output_{len(self._processes)}.txt"
        with output.open("w") as file:
            process = subprocess.Popen(
                command, cwd=self._desk, stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.STDOUT, text=True,
                start_new_session=True, env={**os.environ, "PYTHONUNBUFFERED": "1"},
            )  # fmt: skip
        self._processes.append(process)
        return process, output


def run_commands(lines: list[str], started: Started) -> None:
    """Run the commands of a block, those between which a shell has to remember something by one shell."""
    for kind, group in itertools.groupby(lines, key=kind_of):
        if kind == "shell":
            started.run(["bash", "-euc", "\n".join(group)])
            continue
        for line in group:
            words = words_of(line)
            if kind == "gsseg":
                if words[1] != "demo":  # That was run for all pages, once.
                    assert main(words[1:]) == 0, line
            elif kind in SERVERS:
                server = SERVERS[kind]
                found = words[3:] if words[0] == "ros2" else words  # On PATH, as in an installed environment.
                started.serve([*found, *server.options], server)
            else:
                check(line)


def kind_of(line: str) -> str:
    """Who is to run a line: a server by its name, gsseg in this process, `check` or else the shell."""
    if _SHELL.search(line.split("#")[0]):
        return "shell"
    words = line.split()
    for name in SERVERS:
        if words[: len(name.split())] == name.split():
            return name
    return {"gsseg": "gsseg", "make": "check", "pip": "check"}.get(words[0], "shell")


def words_of(line: str) -> list[str]:
    return [os.path.expandvars(word) for word in shlex.split(line, comments=True)]


def check(line: str) -> None:
    """Check a command that cannot be run: that what it names is there."""
    words = words_of(line)
    match words:
        case ["make", *_]:
            dry = {**os.environ, "MAKEFLAGS": "n"}
            ran = subprocess.run(words, cwd=REPOSITORY, env=dry, capture_output=True, text=True, check=False)
            assert ran.returncode == 0, ran.stderr
        case ["pip", "install", *what]:
            for word in what:
                assert can_be_installed(word), f"{line}: {word}"
        case ["gsseg", *arguments]:
            build_parser().parse_args(arguments)
        case ["ros2", "run", "gsseg_ros", name, *_]:
            assert (REPOSITORY / "scripts" / name).is_file(), line
        case ["python", "-m", "pytest", *paths] | ["python", *paths]:
            assert all((REPOSITORY / path).is_file() for path in paths if path.endswith(".py")), line
        case ["ln", "-s", target, link]:
            assert (REPOSITORY / Path(target).relative_to("gsseg") / "package.xml").is_file(), line
            assert Path(link).parent == Path("src"), line
        case ["colcon", "build", "&&", *_] | ["rosdep", "install", *_] | ["python3", "-m", "venv", *_]:
            pass
        case _:
            pytest.fail(f"'{line}' is neither run nor checked")


def can_be_installed(word: str) -> bool:
    """Whether pip would find a requirement: a folder with a package, gsseg, or what gsseg needs; and its extras."""
    found = re.fullmatch(r"([\w./-]+)(?:\[([\w,]+)\])?(?:[<>]=?[\d.]+)?", word)
    if not found:
        return False
    name, extras = found[1], found[2].split(",") if found[2] else []
    if name not in (".", "gsseg"):
        is_package = name.startswith("./") and (REPOSITORY / name / "pyproject.toml").is_file()
        return not extras and (is_package or name in {"rosbags", *core_libraries()})
    return set(extras) <= setup_py()["extras_require"].keys()


def core_libraries() -> set[str]:
    return {re.split(r"[<>=!~]", requirement)[0] for requirement in setup_py()["install_requires"]}


@functools.cache
def setup_py() -> dict[str, Any]:
    """Return what setup.py hands to setuptools."""
    with mock.patch("setuptools.setup") as setup:
        runpy.run_path(str(REPOSITORY / "setup.py"))
    return dict(setup.call_args.kwargs)
