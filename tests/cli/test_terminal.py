"""Standard output and error: closed, full, or of few characters, they cost no result and bring no traceback."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from gsseg_core.cli import terminal
from gsseg_core.data.label_images import write_mask
from gsseg_core.progress import progress_bars, with_progress
from gsseg_core.text import counted, table

GSSEG = [sys.executable, "-m", "gsseg_core.cli"]
NAME = "Stühle 椅子"


@pytest.fixture
def scoring(tmp_path: Path) -> list[str]:
    """A command that writes a result, scores.json, and prints the name of a class."""
    for folder in ("pred", "truth"):
        (tmp_path / folder).mkdir()
        write_mask(tmp_path / folder / "a.png", np.ones((9, 9), np.int32), 8)
    (tmp_path / "classes.json").write_text(json.dumps({"1": NAME}))
    return [
        *GSSEG,
        "eval",
        "--pred",
        f"{tmp_path}/pred",
        "--truth",
        f"{tmp_path}/truth",
        "--json",
        f"{tmp_path}/s.json",
    ]


@contextmanager
def full() -> Iterator[int]:
    if not os.path.exists("/dev/full"):
        pytest.skip("no /dev/full")
    device = os.open("/dev/full", os.O_WRONLY)
    yield device
    os.close(device)


@pytest.mark.parametrize("closed", ["<&- >&- 2>&-", "<&- 2>&-", "<&-", ">&- 2>&-"])
def test_no_file_gets_the_number_of_a_stream_that_was_closed(tmp_path: Path, closed: str) -> None:
    program = (
        "import sys; from gsseg_core.cli import terminal; terminal.prepare(); "
        "file = open(sys.argv[1], 'w'); file.write(str(file.fileno()))"
    )
    command = ["sh", "-c", f'exec "$@" {closed}', "sh", sys.executable, "-c", program, tmp_path / "number"]
    assert subprocess.run(command, check=False).returncode == 0
    assert int((tmp_path / "number").read_text()) > 2


def test_a_name_that_the_terminal_cannot_show_is_escaped(scoring: list[str], tmp_path: Path) -> None:
    environment = {**os.environ, "LC_ALL": "C", "PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0"}
    done = subprocess.run(scoring, capture_output=True, text=True, env=environment, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert NAME.encode("ascii", "backslashreplace").decode() in done.stdout and (tmp_path / "s.json").is_file()


def test_a_path_that_steers_the_terminal_is_printed_as_escapes(capsys: pytest.CaptureFixture[str]) -> None:
    terminal.tell("Objects: \x1b[2Jout/classes\nLabels: 椅子 out")
    assert capsys.readouterr().out == "Objects: \\x1b[2Jout/classes\nLabels: 椅子 out\n"


@pytest.mark.parametrize("command", ["eval", "--help"])
def test_a_full_standard_output_is_one_line_and_the_results_stay(
    scoring: list[str], tmp_path: Path, command: str
) -> None:
    line = scoring if command == "eval" else [*GSSEG, command]
    buffered = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    with full() as device:
        done = subprocess.run(line, stdout=device, stderr=subprocess.PIPE, text=True, env=buffered, check=False)
    assert done.returncode == 2
    assert done.stderr == "gsseg: error: standard output: cannot be written (No space left on device)\n"
    assert (tmp_path / "s.json").is_file() == (command == "eval")


@pytest.mark.parametrize("lost", ["closed stdout", "reader of stdout left", "closed stdout and stderr"])
def test_where_nobody_reads_the_command_does_its_work_all_the_same(
    scoring: list[str], tmp_path: Path, lost: str
) -> None:
    shell = {"closed stdout": '"$@" >&-', "closed stdout and stderr": '"$@" >&- 2>&-'}
    shell["reader of stdout left"] = '{ "$@"; echo $? >code; } | true; exit $(cat code)'
    done = subprocess.run(
        ["bash", "-c", shell[lost], "bash", *scoring], capture_output=True, text=True, check=False, cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])},
    )  # fmt: skip
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert json.loads((tmp_path / "s.json").read_text())["views"] == 1


def test_an_error_that_cannot_be_printed_is_still_exit_code_2(scoring: list[str]) -> None:
    with full() as device:
        done = subprocess.run([*scoring[:-1], "/dev/null/a"], stderr=device, stdout=subprocess.PIPE, check=False)
    assert (done.returncode, done.stdout) == (2, b"")


def test_work_goes_on_where_progress_cannot_be_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    with (
        full() as device,
        open(device, "wb", 0, closefd=False) as raw,
        io.TextIOWrapper(raw, write_through=True) as text,
    ):
        monkeypatch.setattr(sys, "stderr", text)
        with progress_bars() as progress:
            for done in range(3):
                progress("work", done, 2)
        monkeypatch.undo()


def test_tables_show_names_that_a_terminal_would_obey_or_that_fill_it() -> None:
    text = table(["class"], [["\x1b[2Jred\x07\u202e"], ["x" * 5000]])
    assert r"\x1b[2Jred\x07\u202e" in text and max(map(len, text.splitlines())) == 60


def test_one_is_not_many() -> None:
    assert [counted(n, "view") for n in (0, 1, 1200)] == ["0 views", "1 view", "1,200 views"]
    assert counted(2, "class", "classes") == "2 classes"


def test_items_come_with_word_of_how_many_are_done_and_no_more_where_that_ends_the_work() -> None:
    told: list[object] = []
    for item in with_progress(lambda *what: told.append(what), "look", "ab"):
        told.append(item)
    assert told == [("look", 0, 2), "a", ("look", 1, 2), "b", ("look", 2, 2)]
    items = with_progress(lambda stage, done, total: 1 // (1 - done), "look", "ab")
    assert next(items) == "a"
    with pytest.raises(ZeroDivisionError):
        next(items)
