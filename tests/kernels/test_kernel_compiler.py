"""What a kernel calls is but a part of it, and everything computes what it computes for numba."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import numba as nb
import numpy as np
import pytest
from numba.core.codegen import JITCodeLibrary

KERNELS = """
import numba as nb
import numpy as np
from gsseg_core.kernels.compiler import called_by_kernels, kernel

@nb.njit
def plain(x):
    return x + 1

@called_by_kernels
def part(x):
    return 2.5 * plain(x)

@kernel
def inner(x):
    return part(x) - 1

@kernel(parallel=True)
def outer(xs):
    squares = np.zeros(len(xs))
    for i in nb.prange(len(xs)):
        squares[i] = inner(xs[i]) ** 2
    rest = np.zeros(len(xs) - 1)
    for i in nb.prange(1, len(xs)):
        rest[i - 1] = squares[i] - squares[i - 1]
    return rest
"""
XS = np.linspace(0, 1, 9)


@pytest.fixture
def load(tmp_path: Path) -> Callable[[], ModuleType]:
    """Load a module with kernels that nobody compiled before; loaded again, it finds in the cache what it had."""
    path = tmp_path / "made_for_a_test.py"
    path.write_text(KERNELS)

    def load() -> ModuleType:
        spec = importlib.util.spec_from_file_location(path.stem, path)
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    return load


@pytest.fixture
def with_code(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Names of all that becomes machine code, but for numba's runtime, which may do so at the first kernel."""
    names: list[str] = []
    make = JITCodeLibrary._finalize_specific

    def note(self: JITCodeLibrary) -> None:
        names.extend({self.name} - {"nrt"})
        make(self)

    monkeypatch.setattr(JITCodeLibrary, "_finalize_specific", note)
    yield names


def test_only_what_python_may_call_becomes_machine_code(load: Callable[[], ModuleType], with_code: list[str]) -> None:
    module = load()
    made = module.outer(XS)
    assert with_code == ["plain", "inner", "outer"]
    assert np.array_equal(made, np.diff((2.5 * (XS + 1) - 1) ** 2))
    assert module.plain(2.0) == 3.0 and module.inner(1.0) == 4.0 and len(with_code) == 3
    assert np.array_equal(made, nb.njit(parallel=True)(module.outer.py_func)(XS))
    assert len(with_code) > 8  # numba's own way: wrappers of both loops, and all that they call.


def test_a_kernel_calls_another_that_is_in_the_cache(load: Callable[[], ModuleType], with_code: list[str]) -> None:
    assert load().inner(1.0) == 4.0
    module = load()
    assert np.array_equal(module.outer(XS), np.diff((2.5 * (XS + 1) - 1) ** 2))
    assert module.inner.stats.cache_hits and module.inner(1.0) == 4.0
    again = load()
    assert np.array_equal(again.outer(XS), module.outer(XS)) and again.outer.stats.cache_hits


def test_a_program_may_begin_with_a_kernel_that_calls_a_parallel_one(tmp_path: Path) -> None:
    caller = "\n@kernel\ndef caller(xs):\n    return outer(xs).sum()\n"
    (tmp_path / "made_for_a_test.py").write_text(KERNELS + caller)
    begin = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import numpy as np; import made_for_a_test as made; "
    # Compiled while the other is in the cache, then loaded where none was before it.
    for call in ("outer", "caller", "caller"):
        work = f"{begin}print(np.sum(made.{call}(np.linspace(0, 1, 9))))"
        run = subprocess.run([sys.executable, "-c", work], capture_output=True, text=True, check=True)
        assert float(run.stdout) == pytest.approx(4.0**2 - 1.5**2)


def test_a_kernel_that_is_loaded_reads_nothing_that_only_compiling_needs(load: Callable[[], ModuleType]) -> None:
    load().outer(XS)
    module = load()
    made = module.outer(XS)
    assert module.outer.stats.cache_hits and np.array_equal(made, np.diff((2.5 * (XS + 1) - 1) ** 2))
    (loaded,) = module.outer.overloads.values()
    assert loaded.library._shared_module is None


def test_all_kernels_load_without_the_parts_of_numba_that_compile_and_it_compiles_after_them() -> None:
    program = """
import sys
import numpy as np, numba
from gsseg_core.warm_up import warm_up
warm_up()
print([name for name in ("numba.np.arraymath", "numba.typed.typedlist", "scipy.linalg") if name in sys.modules])
warned = "no such class"
@numba.njit
def largest(x):
    if not len(x):
        raise ValueError(warned)
    return x.max() + 1
print(largest(np.array([1.0, 2.0])))
try:
    largest(np.empty(0))
except ValueError as error:
    print(error)
"""
    subprocess.run([sys.executable, "-c", "from gsseg_core.warm_up import warm_up; warm_up()"], check=True)
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["[]", "3.0", "no such class"]


def test_numba_compiles_as_it_did_after_a_kernel_that_fails(with_code: list[str]) -> None:
    from gsseg_core.kernels.compiler import kernel

    with pytest.raises(nb.TypingError):
        kernel(lambda x: x.no_such_thing)(1)
    assert nb.njit(lambda x: x + 1)(1) == 2 and with_code


def test_numba_of_a_version_that_was_not_tried_compiles_in_its_own_way(
    load: Callable[[], ModuleType], with_code: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from gsseg_core.kernels import compiler

    monkeypatch.setattr(nb, "__version__", "0.99.0")
    spec = importlib.util.spec_from_file_location("compiler_of_another_numba", compiler.__file__)
    assert spec is not None and spec.loader is not None
    other = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(other)
    made = other.kernel(parallel=True)(load().outer.py_func)(XS)
    assert np.array_equal(made, np.diff((2.5 * (XS + 1) - 1) ** 2))
    assert len(with_code) > 5  # wrappers of both loops, and all that they call


def test_kernels_stay_functions_where_numba_is_told_to_compile_none() -> None:
    program = (
        "import numpy as np; from gsseg_core.csr_rows import CSRRows; print(*CSRRows.from_dense(np.eye(2)).indptr)"
    )
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=False)
    assert done.stdout == "0 1 2\n", done.stderr


@pytest.mark.parametrize(("told", "policy"), [({}, "PASSIVE"), ({"OMP_WAIT_POLICY": "active"}, "ACTIVE")])
def test_threads_that_wait_for_others_sleep_unless_the_user_says_otherwise(told: dict[str, str], policy: str) -> None:
    program = (
        "import numba, numpy as np; from gsseg_core.spatial.row_order import take_rows;"
        "take_rows(np.zeros((9, 2)), np.arange(9)); print(numba.threading_layer())"
    )
    given = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    environment = {**given, "OMP_DISPLAY_ENV": "true", **told}
    run = [sys.executable, "-c", program]
    done = subprocess.run(run, env=environment, capture_output=True, text=True, check=True)
    if done.stdout.strip() != "omp":
        pytest.skip(f"threads are of numba's layer {done.stdout.strip()}, not of OpenMP")
    assert f"OMP_WAIT_POLICY = '{policy}'" in done.stderr
