"""Objects come out of the scratch file as they went in; nothing of it outlives the process."""

from __future__ import annotations

import copy
import errno
import os
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from gsseg_core.files import scratch_file
from gsseg_core.files.scratch_file import ScratchFile

array = arrays.arrays(st.sampled_from([np.uint8, np.float32, np.int64]), st.integers(0, 100))


@pytest.fixture(autouse=True)
def small_disk_is_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scratch_file, "SPARED", 0)


@given(st.lists(st.tuples(st.sampled_from("abc"), st.none() | st.lists(array, max_size=3)), max_size=12))
def test_it_holds_what_a_dict_would(steps: list[tuple[str, Any]]) -> None:
    scratch, expected = ScratchFile(), dict[str, Any]()
    for name, value in steps:
        if value is None:
            scratch.drop(name)
            expected.pop(name, None)
        else:
            assert scratch.put(name, value)
            expected[name] = value
        for key in "abc":
            found = scratch.get(key)
            assert (found is None) == (key not in expected)
            for one, other in zip(found or [], expected.get(key, []), strict=True):
                np.testing.assert_array_equal(one, other)
                assert one.dtype == other.dtype and one.flags.writeable
    scratch.clear()
    assert scratch.nbytes == 0


def test_what_is_read_can_be_changed_and_stays_as_it_was() -> None:
    scratch = ScratchFile()
    scratch.put("a", np.arange(5))
    scratch.get("a")[:] = 0
    np.testing.assert_array_equal(scratch.get("a"), np.arange(5))


def test_space_of_what_was_dropped_is_used_again() -> None:
    scratch = ScratchFile()
    scratch.put("other", np.zeros(1))
    for number in range(20):
        assert scratch.put("a", np.full(1000, number))
    assert scratch._file is not None and os.fstat(scratch._file.fileno()).st_size < 3 * 8192
    assert not scratch._holes, "what is filled again is no hole, and is not looked at every time"
    np.testing.assert_array_equal(scratch.get("a"), np.full(1000, 19))


def test_the_file_stays_small_however_long_objects_of_all_sizes_come_and_go() -> None:
    scratch, sizes = ScratchFile(), np.random.default_rng(0).integers(100, 200, 2000).tolist()
    for number, size in enumerate(sizes):
        scratch.drop(str(number - 20))
        assert scratch.put(str(number), np.full(size, number % 256, np.uint8))
    assert scratch._file is not None and os.fstat(scratch._file.fileno()).st_size < 2 * scratch.nbytes
    for number in range(1980, 2000):
        np.testing.assert_array_equal(scratch.get(str(number)), np.full(sizes[number], number % 256, np.uint8))


def test_no_file_can_be_seen_and_a_copy_begins_empty(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    scratch = ScratchFile()
    assert scratch.put("a", np.zeros(1000)) and scratch.nbytes >= 8000
    assert list(tmp_path.iterdir()) == []
    assert pickle.loads(pickle.dumps(scratch)).nbytes == copy.deepcopy(scratch).nbytes == 0


def test_a_full_disk_keeps_nothing_and_what_was_there_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    scratch = ScratchFile()
    scratch.put("a", np.arange(9))
    monkeypatch.setattr(scratch_file, "SPARED", 1 << 62)
    assert not scratch.put("b", np.zeros(9)) and scratch.get("b") is None
    monkeypatch.setattr(scratch_file, "SPARED", 0)

    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "pwrite", full)
    assert not scratch.put("c", np.zeros(9)) and scratch.get("c") is None
    np.testing.assert_array_equal(scratch.get("a"), np.arange(9))


def test_where_no_file_can_be_made_nothing_is_kept(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(scratch_file, "_folder", lambda: str(tmp_path / "none"))
    scratch = ScratchFile()
    assert not scratch.put("a", np.zeros(9)) and scratch.get("a") is None and scratch.nbytes == 0
