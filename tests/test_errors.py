"""Errors that say in other words than their own that memory is not enough."""

from __future__ import annotations

import pytest

from gsseg_core.errors import explained, memory_ran_out


@pytest.mark.parametrize(
    ("error", "ran_out"),
    [
        (MemoryError("Unable to allocate 1.50 GiB"), True),
        (type("OutOfMemoryError", (RuntimeError,), {})("CUDA out of memory"), True),
        (RuntimeError("can't start new thread"), True),
        (ImportError("/lib/_qhull.so: failed to map segment from shared object"), True),
        (RuntimeError("dictionary changed size during iteration"), False),
        (ImportError("No module named 'scipy'"), False),
        (ValueError("can't start new thread"), False),
    ],
)
def test_whether_memory_ran_out_is_told_by_the_error(error: Exception, ran_out: bool) -> None:
    assert memory_ran_out(error) == ran_out


def test_an_error_of_memory_without_a_text_has_no_empty_brackets() -> None:
    assert explained(MemoryError()) == "memory is not enough"
    assert explained(MemoryError("for 1 GiB")) == "memory is not enough (for 1 GiB)"
    assert explained(ValueError("memory")) is None
