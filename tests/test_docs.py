"""Every block of commands and of Python in the documentation runs, and the site is built without a warning.

A block that no test machine can run says so in its title, `title="not run by the tests: needs ..."`. Pages share the
demo's scene; each has a folder of its own in which its blocks run one after the other, with what a reader has there:
scene.ply and DATASET, the examples, and nothing else.
"""

from __future__ import annotations

import contextlib
import importlib.util
import itertools
import json
import os
import re
import runpy
import shlex
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from gsseg_core.cli import main

REPOSITORY = Path(__file__).parents[1]
PAGES = [
    "README.md",
    "CONTRIBUTING.md",
    "examples/README.md",
    *sorted(f"docs/{p.name}" for p in REPOSITORY.glob("docs/*.md")),
]
NOT_RUN = "not run by the tests: "
MOST_NOT_RUN = 24
TIMEOUT = 120
PROGRAMS = {"gsseg": "gsseg_core.cli", "segment_node": "gsseg_ros.segment_node", "replay_node": "gsseg_ros.replay_node"}

_FENCE = re.compile(r"^```(?P<info>[^\n`]*)\n(?P<code>.*?)^```$", re.MULTILINE | re.DOTALL)
_COMMAND = re.compile(r"^(?: {4}|\t)(gsseg|python3?|pip|make|ros2|dask|segment_node|replay_node|colcon) ", re.MULTILINE)
_SHELL = re.compile(r"[|&><;`]|\$\(")


@dataclass(frozen=True)
class Block:
    """A fenced block of a page."""

    page: str
    language: str
    title: str
    code: str

    @property
    def runs(self) -> bool:
        return self.language in ("bash", "python") and not self.title.startswith(NOT_RUN)


def blocks_of(page: str) -> list[Block]:
    text = (REPOSITORY / page).read_text(encoding="utf-8")
    found = []
    for match in _FENCE.finditer(text):
        title = re.search(r'title="([^"]*)"', match["info"])
        found.append(Block(page, (match["info"].split() or [""])[0], title[1] if title else "", match["code"]))
    return found


def needs_ros(page: str) -> bool:
    return any(
        re.search(r"segment_node|gsseg_ros|publish_masks", block.code) for block in blocks_of(page) if block.runs
    )


@pytest.fixture(scope="session")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `gsseg demo` writes, made once."""
    out = tmp_path_factory.mktemp("docs") / "demo_out"
    assert main(["demo", "--out", str(out), "--quiet"]) == 0
    return out


@pytest.fixture
def desk(tmp_path: Path, demo: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with what the reader of a page has, and its programs on PATH."""
    (tmp_path / "bin").mkdir()
    for name, module in {**PROGRAMS, "python": ""}.items():
        program = tmp_path / "bin" / name
        program.write_text(f'#!/bin/sh\nexec {sys.executable} {f"-m {module}" if module else ""} "$@"\n')
        program.chmod(0o755)
    data = tmp_path / "DATASET"
    shutil.copytree(demo / "scene", data, ignore=shutil.ignore_patterns("labels_true", "truth.npz"))
    for mask in (demo / "scene/labels_true").iterdir():  # The views to be scored on have true masks.
        if not (data / "labels" / mask.name).exists():
            shutil.copy(mask, data / "labels")
    split = json.loads((data / "split.json").read_text())  # Fewer views, for the sake of time.
    (data / "split.json").write_text(json.dumps({"train": split["train"][::3], "test": split["test"][::2]}))
    shutil.copy(demo / "scene/scene.ply", tmp_path)
    for name in ("dataset", "demo_out", "examples"):
        (tmp_path / name).symlink_to({"dataset": data, "demo_out": demo, "examples": REPOSITORY / "examples"}[name])
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", f"{tmp_path}/bin{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("PYTHONPATH", f"{REPOSITORY}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    return tmp_path


@pytest.mark.parametrize("page", [page for page in PAGES if any(block.runs for block in blocks_of(page))])
def test_every_block_of_a_page_runs(page: str, desk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ros = needs_ros(page)
    if ros:
        helpers = pytest.importorskip("ros_helpers", exc_type=ImportError)
        for name, value in {
            "ROS_DOMAIN_ID": str(helpers.next_domain()), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "ROS_LOG_DIR": str(desk / "ros_log"),
        }.items():  # fmt: skip
            monkeypatch.setenv(name, value)
    started: list[subprocess.Popen[str]] = []
    names: dict[str, object] = {}
    try:
        for block in blocks_of(page):
            if not block.runs:
                continue
            if block.language == "bash":
                run_bash(block.code, desk, started)
            elif ros:
                run_script([sys.executable, "-c", block.code], desk, started)
            else:
                path = desk / f"block_{len(names)}.py"
                path.write_text(block.code)
                names.update(runpy.run_path(str(path), init_globals=names))
    finally:
        end(started)


def run_bash(code: str, desk: Path, started: list[subprocess.Popen[str]]) -> None:
    """Run commands of `gsseg` in this process, which has its kernels already, and all others by a shell."""
    lines = [line for line in code.replace("\\\n", " ").splitlines() if line.strip()]
    for ours, group in itertools.groupby(lines, key=is_ours):
        if not ours:
            run_script(["bash", "-euc", "\n".join(group)], desk, started)
            continue
        for line in group:
            arguments = shlex.split(line, comments=True)[1:]
            if arguments[0] == "view":
                look(arguments, desk, started)
            elif arguments[0] != "demo":  # That was run for all pages, by the fixture.
                assert main(arguments) == 0, line


def is_ours(line: str) -> bool:
    return line.startswith("gsseg ") and not _SHELL.search(line.split("#")[0])


def run_script(command: list[str], desk: Path, started: list[subprocess.Popen[str]]) -> None:
    """Run a command to its end; what it leaves in the background is ended with the page."""
    with (desk / "output.txt").open("w+") as output:
        process = subprocess.Popen(
            command, cwd=desk, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT, text=True,
            start_new_session=True,
        )  # fmt: skip
        started.append(process)
        code = process.wait(TIMEOUT)
        output.seek(0)
        assert code == 0, f"{command[-1]}\n{output.read()}"


def look(arguments: list[str], desk: Path, started: list[subprocess.Popen[str]]) -> None:
    """Start the viewer until it says where to look; it never ends by itself."""
    if importlib.util.find_spec("viser") is None:
        pytest.skip("viser is not installed")
    process = subprocess.Popen(
        [sys.executable, "-u", "-m", "gsseg_core.cli", *arguments, "--port", "18080"], cwd=desk,
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True,
    )  # fmt: skip
    started.append(process)
    assert process.stdout is not None
    alarm = threading.Timer(TIMEOUT, process.kill)
    alarm.start()
    seen = list(itertools.takewhile(lambda line: "http://" not in line, process.stdout))
    alarm.cancel()
    assert process.poll() is None, "".join(seen)


def end(started: list[subprocess.Popen[str]]) -> None:
    for process in started:
        for number in (signal.SIGINT, signal.SIGKILL):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, number)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(3)
        if process.stdout is not None:
            process.stdout.close()


def test_blocks_that_are_not_run_say_why_and_are_few(capsys: pytest.CaptureFixture[str]) -> None:
    every = [block for page in PAGES for block in blocks_of(page)]
    left = [block for block in every if block.title.startswith(NOT_RUN)]
    with capsys.disabled():
        print(f" {sum(block.runs for block in every)} blocks of the documentation run, {len(left)} do not ", end="")
    assert all(block.title.removeprefix(NOT_RUN).strip() for block in left)
    assert len(left) <= MOST_NOT_RUN
    for block in every:
        assert block.language in ("bash", "python", "text", "json", "yaml"), (
            f"{block.page}: block of '{block.language}'"
        )


@pytest.mark.parametrize("page", PAGES)
def test_commands_stand_in_blocks_that_are_run(page: str) -> None:
    text = _FENCE.sub("", (REPOSITORY / page).read_text(encoding="utf-8"))
    found = _COMMAND.search(text)
    assert not found, f"{page}: '{found[0].strip()} ...' is indented; put it into a ```bash block"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The documentation as a site, built with --strict: a link or anchor that leads nowhere is an error."""
    if importlib.util.find_spec("mkdocs") is None:
        pytest.skip("mkdocs is not installed (pip install '.[docs]')")
    out = tmp_path_factory.mktemp("site")
    run = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(out)],
        cwd=REPOSITORY, capture_output=True, text=True, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"}, check=False,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    yield out


def test_the_site_asks_nobody_for_anything(site: Path) -> None:
    fetched = re.compile(r"""<(?:script|img|iframe|source|video)[^>]+src=["'](?:https?:)?//|<link[^>]+rel=["']?"""
                         r"""(?:stylesheet|preconnect|icon)["']?[^>]+href=["'](?:https?:)?//""")  # fmt: skip
    for path in site.rglob("*.html"):
        assert not fetched.search(path.read_text(encoding="utf-8")), path
    assert "fonts.googleapis" not in (site / "index.html").read_text(encoding="utf-8")


def test_the_reference_names_every_command_class_and_interface(site: Path) -> None:
    import gsseg_core
    from gsseg_core.cli import COMMANDS

    text = {name: (site / f"{name}.html").read_text(encoding="utf-8") for name in ("cli", "api", "ros")}
    assert all(f"gsseg {name}</h2>" in re.sub(r"<a class=\"headerlink.*?</a>", "", text["cli"]) for name in COMMANDS)
    assert all(f'id="gsseg_core.{gsseg_core._HOMES[name]}.{name}"' in text["api"] for name in gsseg_core.__all__)
    for path in REPOSITORY.glob("msg_defs/*/*.*"):
        assert f"{path.parent.name}/{path.stem}" in text["ros"]
