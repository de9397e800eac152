"""Ctrl-C that comes while a kernel works: KeyboardInterrupt once it has ended, whatever it returns."""

from __future__ import annotations

import _thread
import runpy
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from clean_process import in_clean_process

KERNEL = """
from typing import NamedTuple
import numpy as np
from gsseg_core.kernels.compiler import kernel

class Pair(NamedTuple):
    one: np.ndarray
    two: np.ndarray

@kernel
def work(steps):
    x = np.zeros(8)
    for i in range(steps):
        x[i % 8] = np.sqrt(x[(i + 3) % 8] + i)
    return x, (Pair(x + 1, x), Pair(x, x - 1)), x
"""


def compiled_anew(folder: Path) -> Any:
    path = folder / "made_for_a_test.py"
    path.write_text(KERNEL)
    return runpy.run_path(str(path))["work"]


@in_clean_process
def test_ctrl_c_while_a_kernel_works_is_raised_when_it_has_ended(tmp_path: Path) -> None:
    work = compiled_anew(tmp_path)
    work(1)
    for _ in range(3):
        begins = threading.Event()
        threading.Thread(target=lambda begins=begins: (begins.wait(), _thread.interrupt_main())).start()
        with pytest.raises(KeyboardInterrupt):
            begins.set()
            while True:
                work(50_000_000)


def test_a_kernel_returns_what_its_function_does_also_from_the_cache(tmp_path: Path) -> None:
    for _ in range(2):
        work = compiled_anew(tmp_path)
        (x, pairs, y), (x_, pairs_, y_) = work(20), work.py_func(20)
        np.testing.assert_array_equal([x, *pairs[0], *pairs[1], y], [x_, *pairs_[0], *pairs_[1], y_])
        assert [type(pair).__name__ for pair in pairs] == ["Pair", "Pair"]
        assert all(array.flags.writeable for pair in pairs for array in pair)
