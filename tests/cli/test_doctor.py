"""First contact: help that reads well, tab completion, and `gsseg doctor`."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest
from small_scenes import write_dataset

from gsseg_core.cli import doctor
from gsseg_core.cli.arguments import COMMANDS, build_parser, command_module
from gsseg_core.cli.completion import SHELLS, subparsers
from gsseg_core.cli.doctor import Finding, describe, examine, works
from gsseg_core.cli.main import main
from gsseg_core.kernels import kernel_cache


def help_of(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    with pytest.raises(SystemExit) as ended:
        main([*arguments, "--help"])
    assert ended.value.code == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_help_fits_a_terminal_of_80_columns_and_shows_examples(
    command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    text = help_of(capsys, *command.split())
    assert max(map(len, text.splitlines())) <= 80
    if command:
        assert f"\nexamples:\n  {'bash: ' * (command == 'completion')}gsseg {command}" in text
    else:
        assert all(f"    {name} " in text or f"    {name}\n" in text for name in COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_example_in_the_help_is_a_command_line_that_is_understood(command: str) -> None:
    parser = build_parser()
    lines = command_module(command).EXAMPLES.replace("\\\n", " ").splitlines()
    found = [re.search(r"gsseg ([^>(]+)", line) for line in lines]
    examples = [match[1].split() for match in found if match]
    assert examples
    for example in examples:
        assert parser.parse_args(example).run is command_module(command).run


def test_every_argument_is_explained() -> None:
    for name, parser in subparsers(build_parser()).items():
        for action in parser._actions:
            assert action.help, f"gsseg {name}: {action.option_strings or action.dest} is not explained"


LARGE = ("numpy", "numba", "scipy", "torch", "PIL", "distributed", "pycolmap", "shtab", "viser", "rclpy")
# Each of these takes a tenth of the time that a user waits for `gsseg --help`; kernel_cache tries whether it can write.
SLOW = (
    "dataclasses",
    "inspect",
    "importlib.metadata",
    "webbrowser",
    "gsseg_core.kernels.kernel_cache",
    "gsseg_core.cli.segment",
)


@pytest.mark.parametrize(
    ("program", "not_loaded"),
    [
        ("sys.argv = ['gsseg', '--help']; from gsseg_core.cli.main import main; main()", (*LARGE, *SLOW)),
        ("from gsseg_core.cli.arguments import build_parser; build_parser()", LARGE),
        ("import gsseg_core; gsseg_core.__all__", (*LARGE, *SLOW)),
    ],
    ids=["gsseg --help", "gsseg COMMAND --help", "import gsseg_core"],
)
def test_help_waits_for_no_kernel_and_no_large_library(program: str, not_loaded: tuple[str, ...]) -> None:
    check = f"print(*(name for name in {not_loaded} if name in sys.modules), file=sys.stderr)"
    code = f"import atexit, sys; atexit.register(lambda: {check}); {program}"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stderr == "\n"


@pytest.mark.parametrize("shell", SHELLS)
def test_completion_knows_every_command_and_option(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", shell]) == 0
    script = capsys.readouterr().out
    for name, parser in subparsers(build_parser()).items():
        assert name in script
        for action in parser._actions:
            for option in action.option_strings:
                assert option.lstrip("-") in script, f"gsseg {name} {option}"


def test_bash_completes_commands_options_choices_and_folders(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bash = shutil.which("bash")
    assert bash is not None
    main(["completion", "bash"])
    (tmp_path / "script").write_text(capsys.readouterr().out)
    (tmp_path / "capture").mkdir()
    (tmp_path / "capture.ply").touch()

    def offered(*words: str) -> set[str]:
        line = " ".join(f"'{word}'" for word in words)
        program = (
            f"source {tmp_path}/script; COMP_WORDS=({line}); COMP_CWORD={len(words) - 1}; "
            '_shtab_gsseg gsseg "${COMP_WORDS[COMP_CWORD]}" "${COMP_WORDS[COMP_CWORD-1]}"; '
            'printf "%s\\n" "${COMPREPLY[@]}"'
        )
        run = subprocess.run([bash, "-c", program], capture_output=True, text=True, check=True, cwd=tmp_path)
        return {word.strip() for word in run.stdout.split("\n") if word.strip()}

    assert offered("gsseg", "seg") == {"segment"}
    assert offered("gsseg", "segment", "--memory") == {"--memory-budget"}
    assert offered("gsseg", "segment", "--learner", "v") == {"votes"}
    assert {word.rstrip("/") for word in offered("gsseg", "eval", "--pred", "cap")} == {"capture"}
    every = {"capture", "capture.ply"}
    for before in (["segment"], ["segment", "--labels"], ["eval", "--truth"], ["merge"], ["doctor"]):
        assert {word.rstrip("/") for word in offered("gsseg", *before, "cap")} == every, before


def test_a_missing_shtab_is_one_line_that_says_what_to_type(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "shtab", None)
    assert main(["completion", "bash"]) == 2
    assert capsys.readouterr().err.endswith("pip install shtab\n")


@pytest.fixture(scope="module")
def findings() -> list[Finding]:
    return examine()


def named(findings: list[Finding], name: str) -> Finding:
    return next(finding for finding in findings if finding.name == name)


def test_doctor_finds_that_the_core_works(findings: list[Finding], capsys: pytest.CaptureFixture[str]) -> None:
    assert works(findings)
    assert named(findings, "numpy").state == metadata.version("numpy")
    assert "segmented 5,184 Gaussians" in named(findings, "run").state
    assert Path(named(findings, "cache").state).is_dir()
    assert main(["doctor"]) == 0
    text = capsys.readouterr().out
    assert "gsseg works here" in text and all(finding.name in text for finding in findings)


def test_doctor_says_what_to_type_for_all_that_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    requires = ["numpy>=2.0", "nosuch-library>=1", 'dask>=1; extra == "distributed"', 'nosuch-viewer; extra == "view"']
    monkeypatch.setattr(doctor.metadata, "requires", lambda name: requires)
    monkeypatch.setattr(doctor.importlib.util, "find_spec", lambda name: None)
    found = examine()
    assert not works(found)
    assert named(found, "nosuch-library").fix == "pip install nosuch-library"
    assert named(found, "view").mark == "-" and "pip install 'gsseg[view]'" in named(found, "view").fix
    assert named(found, "rclpy").mark == "-"
    assert all(finding.fix for finding in found if finding.mark in ("-", "!!") and finding.name != "programs")
    assert "does not work here" in describe(found)


def test_doctor_of_a_file_for_a_dataset_says_what_to_type_to_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_dataset(tmp_path)
    assert main(["doctor", str(tmp_path / "scene.ply"), "--scene", str(tmp_path / "scene.ply")]) == 2
    assert f"it is a file: type gsseg doctor {tmp_path}\n" in capsys.readouterr().err


def test_doctor_reports_a_kernel_cache_that_cannot_be_written(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel_cache, "FOLDER", None)
    found = named(examine(), "cache")
    assert found.mark == "-" and "NUMBA_CACHE_DIR" in found.fix and kernel_cache.candidates()[-1] in found.state


def test_doctor_reports_a_kernel_cache_that_has_no_room_for_all_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel_cache, "INCOMPLETE", True)
    found = named(examine(), "cache")
    assert found.mark == "-" and "NUMBA_CACHE_DIR" in found.fix
    assert f"cannot write to {kernel_cache.FOLDER}" in found.state


def test_doctor_reports_kernels_that_do_not_run(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object, **__: object) -> None:
        raise RuntimeError("no code for this processor")

    monkeypatch.setattr("gsseg_core.warm_up.warm_up", broken)
    monkeypatch.setattr(doctor, "examine", lambda say=None: list(doctor._kernels(print)))
    assert main(["doctor"]) == 2


def test_doctor_works_in_a_folder_that_is_gone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    assert "cd to one that is there" in [finding.fix for finding in doctor._devices()]


def test_doctor_looks_for_ros_without_importing_it() -> None:
    program = "import sys; from gsseg_core.cli.doctor import examine; examine(); sys.exit('rclpy' in sys.modules)"
    environment = {**os.environ, "PYTHONPATH": str(Path(doctor.__file__).parents[2])}
    subprocess.run([sys.executable, "-c", program], check=True, env=environment)
