"""Files appear whole or not at all."""

from __future__ import annotations

import contextlib
import errno
import os
import resource
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from clean_process import in_clean_process
from nobody import become_nobody

from gsseg_core.errors import GssegError, PathTakenError, SettingsError, WriteError
from gsseg_core.files.atomic import check_writable, write_atomically


@contextlib.contextmanager
def small_files_only() -> Iterator[None]:
    """No file may grow beyond 4 kB, as on a full disk. Around one write only: the log of a test run is a file, too."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_new_file_appears_with_its_folders_and_ordinary_permissions(tmp_path: Path) -> None:
    path = tmp_path / "a" / "b" / "report.json"
    with write_atomically(path) as temporary:
        assert temporary.parent == path.parent and temporary.suffix == ".json"
        temporary.write_text("{}")
        assert not path.exists()
    assert path.read_text() == "{}"
    reference = tmp_path / "reference"
    reference.write_text("")
    assert path.stat().st_mode == reference.stat().st_mode
    assert list(path.parent.iterdir()) == [path]


def test_the_temporary_name_has_the_suffix_of_the_file(tmp_path: Path) -> None:
    with write_atomically(tmp_path / "state.npz") as temporary:
        assert temporary.suffix == ".npz"
        temporary.write_bytes(b"x")
    assert (tmp_path / "state.npz").read_bytes() == b"x"


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError, SettingsError])
def test_an_interrupted_write_leaves_the_earlier_file_whole_and_nothing_else(
    tmp_path: Path, error: type[BaseException]
) -> None:
    path = tmp_path / "scene.ply"
    path.write_text("earlier")
    with pytest.raises(error), write_atomically(path) as temporary:
        temporary.write_text("half of the n")
        raise error
    assert path.read_text() == "earlier"
    assert list(tmp_path.iterdir()) == [path]


def test_a_full_disk_is_one_clear_error_and_leaves_the_earlier_file_whole(tmp_path: Path) -> None:
    path = tmp_path / "scene.ply"
    path.write_text("earlier")
    with pytest.raises(WriteError) as caught, small_files_only(), write_atomically(path) as temporary:
        temporary.write_bytes(bytes(100_000))
    why = os.strerror(errno.EFBIG)
    assert str(caught.value) == f"{path}: cannot be written ({why}); what was there before is unchanged"
    assert isinstance(caught.value, GssegError)
    assert path.read_text() == "earlier"
    assert list(tmp_path.iterdir()) == [path]


def test_a_write_that_fails_leaves_no_folder_that_was_made_for_it(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    for place in ("new/folder/a.ply", "mine/a.ply"):
        with pytest.raises(WriteError, match=r"a\.ply: cannot be written"), write_atomically(tmp_path / place):
            raise OSError
    assert [path.name for path in tmp_path.rglob("*")] == ["mine"]


@in_clean_process
def test_a_folder_that_takes_files_and_shows_none_gets_one(tmp_path: Path) -> None:
    (tmp_path / "letters").mkdir()
    (tmp_path / "letters").chmod(0o333)
    become_nobody(tmp_path)
    check_writable("letters/a.json")
    with write_atomically("letters/a.json") as temporary:
        temporary.write_text("new")
    assert Path("letters/a.json").read_text() == "new"


def test_a_folder_that_cannot_be_made_is_one_clear_error(tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("a file, not a folder")
    path = tmp_path / "taken" / "out.png"
    with pytest.raises(WriteError, match=r"taken/out\.png: cannot be written"), write_atomically(path):
        pytest.fail("the body must not run")


def test_a_path_that_is_a_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    with pytest.raises(WriteError, match="cannot be written"), write_atomically(tmp_path / "out") as temporary:
        temporary.write_text("x")
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("make", [os.mkfifo, Path.mkdir, lambda path: path.symlink_to("/dev/null")])
def test_what_is_no_file_is_never_replaced(tmp_path: Path, make: Callable[[Path], object]) -> None:
    path = tmp_path / "out.ply"
    make(path)
    before = path.lstat()
    for attempt in (lambda: check_writable(path), lambda: write_atomically(path).__enter__()):
        with pytest.raises(PathTakenError, match=r"out\.ply: cannot be written \(it is a "):
            attempt()
    assert path.lstat().st_ino == before.st_ino and list(tmp_path.iterdir()) == [path]


def test_a_link_to_a_file_stays_and_the_file_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link.json").symlink_to("real/report.json")
    for text in ("first, where nothing is yet", "second"):
        with write_atomically(tmp_path / "link.json") as temporary:
            temporary.write_text(text)
        assert (tmp_path / "link.json").is_symlink() and (tmp_path / "real/report.json").read_text() == text
    assert len(list((tmp_path / "real").iterdir())) == 1


@in_clean_process
def test_a_temporary_file_of_a_dead_process_is_removed_by_the_next_and_one_of_a_live_process_is_not(
    tmp_path: Path,
) -> None:
    child = os.fork()
    if not child:
        with write_atomically(tmp_path / "a.ply") as temporary:
            temporary.write_text("half")
            os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(child, 0)
    assert len(list(tmp_path.iterdir())) == 1
    with write_atomically(tmp_path / "b.ply") as first, write_atomically(tmp_path / "c.ply") as second:
        first.write_text("b")
        second.write_text("c")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["b.ply", "c.ply"]


@pytest.mark.parametrize("name", ["file/below.json", "x" * 300, "nul\0.json"])
def test_a_path_that_cannot_be_written_is_known_before_the_work(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(WriteError, match="cannot be written"):
        check_writable(tmp_path / name)
    with pytest.raises(WriteError, match="cannot be written"), write_atomically(tmp_path / name):
        pytest.fail("there is nothing to write to")
    check_writable(tmp_path / "file")
    check_writable(tmp_path / "no" / "such" / "folder" / "yet.json")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_folders_that_were_made_are_removed_where_one_of_them_could_not_be(tmp_path: Path) -> None:
    with pytest.raises(WriteError, match="too long"), write_atomically(tmp_path / "made" / ("x" * 300) / "a.json"):
        pytest.fail("there is nothing to write to")
    assert list(tmp_path.iterdir()) == []
