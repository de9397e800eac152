"""Files appear whole or not at all."""

from __future__ import annotations

import contextlib
import errno
import os
import resource
from collections.abc import Iterator
from pathlib import Path

import pytest

from gsseg_core.atomic import write_atomically
from gsseg_core.errors import GssegError, SettingsError, WriteError


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


def test_the_suffix_of_the_temporary_name_can_be_chosen(tmp_path: Path) -> None:
    with write_atomically(tmp_path / "state", suffix=".npz") as temporary:
        assert temporary.suffix == ".npz"
        temporary.write_bytes(b"x")
    assert (tmp_path / "state").read_bytes() == b"x"


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
