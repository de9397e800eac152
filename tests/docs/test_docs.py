"""Every block of commands and of Python in the documentation runs.

A block that no test machine can run says so in its title, `title="needs ..."`; what it names is checked all the same,
and so are the lines that install something (`doc_commands`). Pages share the demo's scene; each has a folder of its
own, in which its blocks run one after the other, with what a reader has there (`doc_blocks.FIRST`) and nothing else.
"""

from __future__ import annotations

import importlib.util
import json
import os
import re
import runpy
import shutil
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from doc_blocks import FENCE, FIRST, PAGES, REPOSITORY, Block, blocks_of, needs_ros
from doc_commands import Started, check, core_libraries, kind_of, run_commands, setup_py, words_of
from missing_ros import MISSING
from packaging.requirements import Requirement

from gsseg_core.cli.arguments import COMMANDS, command_module
from gsseg_core.data.dataset import Dataset

MOST_NOT_RUN = 7
PROGRAMS = {
    "gsseg": "gsseg_core.cli", **({} if MISSING else importlib.import_module("gsseg_ros.child_nodes").NODES),
    "dask": "dask", "python": "", "python3": "",
}  # fmt: skip
MASKS = "docs/masks.md"
APT_NAMES = {"pillow": "pil"}

_COMMAND = re.compile(r"^(?: {4}|\t)(gsseg|python3?|pip|make|ros2|dask|segment_node|replay_node|colcon) ", re.MULTILINE)


@pytest.fixture
def desk(tmp_path: Path, demo_run: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with what the reader of a page has, and its programs on PATH."""
    (tmp_path / "bin").mkdir()
    for name, module in PROGRAMS.items():
        program = tmp_path / "bin" / name
        program.write_text(f'#!/bin/sh\nexec {sys.executable} {f"-m {module}" if module else ""} "$@"\n')
        program.chmod(0o755)
    shutil.copytree(demo_run / "scene", tmp_path / "demo_out/scene")
    split = json.loads((demo_run / "scene/split.json").read_text())  # Fewer views, for the sake of time.
    split = {"train": split["train"][::6], "test": split["test"][::3]}
    (tmp_path / "demo_out/scene/split.json").write_text(json.dumps(split))
    data = tmp_path / "DATASET"
    shutil.copytree(tmp_path / "demo_out/scene", data, ignore=shutil.ignore_patterns("labels_true", "truth.npz"))
    for mask in (demo_run / "scene/labels_true").iterdir():  # The views to be scored on have true masks.
        if not (data / "labels" / mask.name).exists():
            shutil.copy(mask, data / "labels")
    shutil.copy(demo_run / "scene/scene.ply", tmp_path)
    (tmp_path / "demo_out/segmented").symlink_to(demo_run / "segmented")
    for name in ("benchmarks", "examples"):
        (tmp_path / name).symlink_to(REPOSITORY / name)
    monkeypatch.chdir(tmp_path)
    for name in ("HOME", "PWD"):
        monkeypatch.setenv(name, str(tmp_path))
    monkeypatch.setenv("PATH", f"{tmp_path}/bin{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("PYTHONPATH", f"{REPOSITORY}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    return tmp_path


@pytest.fixture
def started(desk: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Started]:
    """For programs that outlive their block."""
    programs = Started(desk, monkeypatch)
    yield programs
    programs.end()


@pytest.mark.parametrize(
    "page", [page for page in PAGES if page != MASKS and any(block.runs for block in blocks_of(page))]
)
def test_every_block_of_a_page_runs(
    page: str, desk: Path, started: Started, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    skip_without_libraries(page)
    ros = needs_ros(page)
    if ros:
        domain, claim = pytest.importorskip("ros_helpers", exc_type=ImportError).next_domain()
        request.addfinalizer(claim.close)
        for name, value in {
            "ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "ROS_LOG_DIR": str(desk / "ros_log"),
        }.items():  # fmt: skip
            monkeypatch.setenv(name, value)
    if page in FIRST:
        FIRST[page](desk)
    if page == "docs/viewer.md":  # The robot that it follows.
        run_commands(['ros2 run gsseg_ros segment_node --ros-args -p scene_path:="$PWD/scene.ply"'], started)
    names: dict[str, object] = {}
    for block in blocks_of(page):
        if not block.runs:
            continue
        if block.language == "bash":
            run_commands(block.lines, started)
        elif ros:
            started.run([sys.executable, "-c", block.code])
        else:
            names.update(run_python(block, desk, names))


def skip_without_libraries(page: str) -> None:
    commands = [kind_of(line) for block in blocks_of(page) if block.runs for line in block.lines]
    for start, library in {"gsseg view": "viser", "dask": "distributed"}.items():
        if any(command.startswith(start) for command in commands) and importlib.util.find_spec(library) is None:
            pytest.skip(f"{library} is not installed")


def run_python(block: Block, desk: Path, names: dict[str, object]) -> dict[str, object]:
    path = desk / "block.py"  # A file, for tracebacks.
    path.write_text(block.code)
    return runpy.run_path(str(path), init_globals=names)


def test_masks_saved_as_their_page_says_say_what_the_segmenters_said(
    desk: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    torch = pytest.importorskip("torch")
    shutil.rmtree(desk / "DATASET/labels")
    (desk / "DATASET/labels").mkdir()
    monkeypatch.chdir(desk / "DATASET")
    cameras = Dataset(".").cameras[:4]
    height, width = cameras[0].height, cameras[0].width
    square = np.zeros((height, width), bool)
    square[100:200, 100:200] = True
    given = {
        "K": 10, "logits": torch.randn(10, height, width), "results": {3: 0.9 * square, 7: np.zeros_like(square)},
        "masks": np.stack([square, ~square]), "scores": np.array([0.9, 0.8]), "labels": np.array([3, 7]),
    }  # fmt: skip
    blocks = [block for block in blocks_of(MASKS) if block.language == "python"]
    assert len(blocks) == 4 and all(block.runs for block in blocks)
    for block, camera in zip(blocks, cameras, strict=True):
        if "write_mask" in block.code:
            given["labels"] = 3 * square
        run_python(block, desk, {**given, "stem": camera.name})
    views = {view.name: view for view in Dataset(".").views("all")}
    semantic, panoptic, words, hard = (views[camera.name] for camera in cameras)
    assert semantic.class_ids() == set(range(10))
    np.testing.assert_array_equal(panoptic.read_labels(), np.where(square, 3, 7))
    assert words.class_ids() == {3, 7}
    np.testing.assert_array_equal(words.read_labels() == 3, square)
    assert hard.supervised == (3, 7) and hard.class_ids() == {3, 7}


def test_blocks_that_are_not_run_say_what_they_need_and_are_few(capsys: pytest.CaptureFixture[str]) -> None:
    every = [block for page in PAGES for block in blocks_of(page)]
    left = [block for block in every if block.is_program and not block.runs]
    with capsys.disabled():
        print(f" {sum(block.runs for block in every)} blocks of the documentation run, {len(left)} do not ", end="")
    assert len(left) <= MOST_NOT_RUN, [(block.page, block.title) for block in left]
    for block in every:
        known = ("bash", "python", "text", "json", "yaml")
        assert block.language in known, f"{block.page}: block of '{block.language}'"
        if block.language == "json":
            json.loads(block.code)


@pytest.mark.parametrize(
    "block", [block for page in PAGES for block in blocks_of(page) if block.is_program and not block.runs],
    ids=lambda block: f"{block.page}: {block.title}",
)  # fmt: skip
def test_what_a_block_that_is_not_run_names_is_there(block: Block) -> None:
    for line in block.lines:
        check(line)


@pytest.mark.parametrize(
    "line",
    ["make demos", "pip install '.[veiw]'", "pip install ./msgs", "pip install somethingelse",
     "gsseg segment x --dat y", "ros2 run gsseg_ros no_node", "python benchmarks/no.py",
     "ln -s gsseg/messages src/gsseg_msgs", "sudo something"],
)  # fmt: skip
def test_a_wrong_command_is_noticed(line: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises((AssertionError, SystemExit, pytest.fail.Exception)):
        check(line)


def test_examples_in_the_help_can_be_typed() -> None:
    for name in COMMANDS:
        lines = re.findall(r"gsseg .*", command_module(name).EXAMPLES.replace("\\\n", " "))
        assert lines, f"gsseg {name} --help has no example"
        for line in lines:
            check(re.split(r"[>(]", line)[0])


def test_a_robot_gets_every_library_from_apt_or_by_pip_or_is_told_when_it_is_needed() -> None:
    (line,) = [line for block in blocks_of("docs/tutorial_robot.md") for line in block.lines if "'numpy<2'" in line]
    by_pip = set(words_of(line)[2:])
    assert {word for word in by_pip if ">" in word} <= set(setup_py()["install_requires"])
    keys = {element.text for element in ElementTree.parse(REPOSITORY / "package.xml").getroot().iter("exec_depend")}
    by_apt = {library for library in core_libraries() if f"python3-{APT_NAMES.get(library, library)}" in keys}
    missing = core_libraries() - by_apt - {re.split("[<>]", word)[0] for word in by_pip}
    assert missing == {"pycolmap", "shtab", "torch"}
    assert all(name in (REPOSITORY / "docs" / "tutorial_robot.md").read_text() for name in missing)


def test_on_arm_pip_is_asked_for_nothing_that_has_no_wheel_there() -> None:
    asked = map(Requirement, setup_py()["install_requires"])
    skipped = {one.name for one in asked if one.marker and not one.marker.evaluate({"platform_machine": "aarch64"})}
    assert skipped == {"pycolmap"}


@pytest.mark.parametrize("page", PAGES)
def test_commands_stand_in_blocks_that_are_run(page: str) -> None:
    text = FENCE.sub("", (REPOSITORY / page).read_text(encoding="utf-8"))
    found = _COMMAND.search(text)
    assert not found, f"{page}: '{found[0].strip()} ...' is indented; put it into a ```bash block"
