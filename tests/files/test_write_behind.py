"""What is written behind the work is there when the work ends, and its errors are those of the work."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from gsseg_core.errors import WriteError
from gsseg_core.files.atomic import write_atomically
from gsseg_core.files.write_behind import writing_behind

KERNELS = "gsseg_core.files.write_behind.kernels_run_beside_each_other"


@pytest.fixture(autouse=True)
def kernels_of_two_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(KERNELS, lambda: True)


def write(path: Path, text: str) -> None:
    with write_atomically(path) as temporary:
        temporary.write_text(text)


def test_all_files_are_there_at_the_end_and_another_thread_has_written_them(tmp_path: Path) -> None:
    threads = []
    with writing_behind() as behind:
        for number in range(5):
            behind(write, tmp_path / str(number), text=f"text {number}")
        behind(lambda: threads.append(threading.current_thread()))
    assert [(tmp_path / str(number)).read_text() for number in range(5)] == [f"text {number}" for number in range(5)]
    assert threads != [threading.current_thread()]


def test_the_first_error_is_raised_at_the_end(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(WriteError, match="file/a: cannot be written"), writing_behind() as behind:
        behind(write, tmp_path / "file" / "a", "text")


def test_an_error_ends_the_work_at_the_next_file(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    failed = threading.Event()

    def fail() -> None:
        try:
            write(tmp_path / "file" / "a", "text")
        finally:
            failed.set()

    with pytest.raises(WriteError, match="file/a: cannot be written"), writing_behind() as behind:
        behind(fail)
        failed.wait()
        while True:
            behind(lambda: None)


def test_an_error_of_the_work_itself_is_the_one_that_is_raised(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(KeyError), writing_behind() as behind:
        behind(write, tmp_path / "file" / "a", "text")
        raise KeyError


def test_where_kernels_cannot_run_beside_each_other_the_caller_writes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(KERNELS, lambda: False)
    threads = []
    with writing_behind() as behind:
        behind(lambda: threads.append(threading.current_thread()))
    assert threads == [threading.current_thread()]
