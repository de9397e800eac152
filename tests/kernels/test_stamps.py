"""Kernels in the cache are those of the code as it is, also of what they call in other files."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import pytest

from gsseg_core.csr_rows import largest
from gsseg_core.kernels import stamps

FILES = {
    "__init__": "",
    "kernels": "from gsseg_core.kernels.compiler import kernel\nfrom made.calls import (\n    Pair,\n    called,\n)\n"
    "from made.readers import FACTOR, read\n\n@kernel\ndef double(x):\n    return called(Pair(x, 2 * x)) * FACTOR\n",
    "calls": "from collections import namedtuple\nfrom gsseg_core.kernels.compiler import called_by_kernels\n"
    "from made import deep\n\nPair = namedtuple('Pair', ['one', 'other'])\n\n"
    "@called_by_kernels\ndef called(x):\n    return deep.deeper(x.one)\n",
    "deep": "import numba\n\n@numba.njit\ndef deeper(x):\n    return x + 1\n",
    "readers": "from made import formats\nFACTOR = 2\n\ndef read(file):\n    return formats.known(file)\n",
    "formats": "def known(file):\n    return True\n",
}
CALL = "from made.kernels import double; print(double(3), sum(double.stats.cache_hits.values()), flush=True)"

# What takes a program most of its time is to import numba and to have it compile for the first time.
PROGRAMS = """
import os, sys
import gsseg_core.kernels.compiler
import numba
numba.njit(lambda x: x)(1)
sys.dont_write_bytecode = True
for line in sys.stdin:
    folder, call = line.rstrip().split(None, 1)
    if (child := os.fork()) == 0:
        sys.path.insert(0, folder)
        exec(call)
        os._exit(0)
    if os.waitpid(child, 0)[1]:
        print("failed", flush=True)
"""

Programs = Callable[..., str]


@pytest.fixture(name="called_from", scope="module")
def called_from_fixture() -> Iterator[Programs]:
    """Call the kernel of a folder in a program of its own: what it returns, and how many kernels came from the cache.

    These programs begin as copies of one that knows of no kernel yet.
    """
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", PROGRAMS], **pipes) as programs:

        def called_from(folder: Path, call: str = CALL) -> str:
            print(folder, call, file=programs.stdin, flush=True)
            return programs.stdout.readline().strip()

        yield called_from


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory, called_from: Programs) -> Path:
    """Write a package with a kernel, and have it compiled."""
    folder = tmp_path_factory.mktemp("compiled")
    (folder / "made").mkdir()
    for name, content in FILES.items():
        (folder / "made" / f"{name}.py").write_text(content)
    assert called_from(folder) == "8 0" and called_from(folder) == "8 1"
    return folder


@pytest.fixture
def package(compiled: Path, tmp_path: Path) -> Path:
    """Copy that package, with what was compiled: kernels are known by what stands in their sources."""
    return shutil.copytree(compiled, tmp_path, dirs_exist_ok=True)


@pytest.mark.parametrize(
    ("file", "before", "after", "expected"),
    [
        ("deep", "x + 1", "x + 7", "20 0"),
        ("calls", "deeper(x.one)", "deeper(x.other)", "14 0"),
        ("calls", "['one', 'other']", "['other', 'one']", "14 0"),
        ("readers", "FACTOR = 2", "FACTOR = 3", "12 0"),
        ("readers", "formats.known(file)", "not formats.known(file)", "8 1"),
        ("formats", "True", "False", "8 1"),
    ],
)
def test_a_kernel_is_compiled_anew_where_what_it_was_made_of_has_changed_and_nowhere_else(
    package: Path, called_from: Programs, file: str, before: str, after: str, expected: str
) -> None:
    path = package / "made" / f"{file}.py"
    path.write_text(path.read_text().replace(before, after))
    assert called_from(package) == expected


@pytest.mark.parametrize("file", ["pairs", "others"])
def test_a_kernel_is_compiled_anew_where_a_type_that_it_takes_has_another_name_or_place(
    tmp_path: Path, called_from: Programs, file: str
) -> None:
    made = tmp_path / "made"
    made.mkdir()
    kernel = "from gsseg_core.kernels.compiler import kernel\n\n@kernel\ndef add(pair):\n    return pair[0] + pair[1]\n"
    double = "from made.{0} import {1}\nfrom made.adding import add\ndef double(x):\n    return add({1}(x, x))\n"
    pair = "from collections import namedtuple\n{0} = namedtuple('{0}', ['one', 'other'])\n"
    files = {"__init__": "", "adding": kernel, "pairs": pair.format("Pair"), "kernels": double.format("pairs", "Pair")}
    for name, content in files.items():
        (made / f"{name}.py").write_text(content)
    call = CALL.replace("double.stats", "add.stats").replace("import double", "import add, double")
    assert called_from(tmp_path, call) == "6 0" and called_from(tmp_path, call) == "6 1"
    (made / "pairs.py").unlink()
    (made / f"{file}.py").write_text(pair.format("Two"))
    (made / "kernels.py").write_text(double.format(file, "Two"))
    assert called_from(tmp_path, call) == "6 0" and called_from(tmp_path, call) == "6 1"


@pytest.mark.parametrize(
    ("file", "is_compiled_anew"),
    [("compiler", True), ("loading", True), ("parts", True), ("returned", True), ("kernel_cache", False)],
)
def test_kernels_are_compiled_anew_where_what_compiles_them_has_changed(
    tmp_path: Path, file: str, is_compiled_anew: bool
) -> None:
    def stamp() -> bytes:
        spec = spec_from_file_location("stamps", folder / "stamps.py")
        assert spec is not None and spec.loader is not None
        made = module_from_spec(spec)
        spec.loader.exec_module(made)
        return made.stamp_of(largest.py_func)

    folder = shutil.copytree(Path(stamps.__file__).parent, tmp_path / "kernels")
    before = stamp()
    with open(folder / f"{file}.py", "a") as content:
        content.write("\n# Changed.\n")
    assert (stamp() != before) is is_compiled_anew
