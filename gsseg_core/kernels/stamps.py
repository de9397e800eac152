"""Stamps of kernels: a kernel in the cache is compiled anew once anything that it was compiled from has changed.

numba looks at the file of the kernel alone. What it calls is in other files, too, and constants come from there: after
an update of the package a kernel would go on as it was, while its own file is the same.
"""

from __future__ import annotations

import hashlib
import re
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

_IMPORT = re.compile(r"^(?:from ([\w.]+) import (\([^)]*\)|.*)|import ([\w.]+))", re.MULTILINE)
_COMPILES = re.compile(rb"^(?:from|import) (?:numba|llvmlite|\S*kernels\.compiler)", re.MULTILINE)


def stamp_of(kernel: Callable[..., Any]) -> bytes:
    """Hash all that a kernel may be compiled from, when it is defined: files, and numbers that come from others.

    The files are that of its module, those of all modules with compiled code that this imports, directly or not, and
    those here by which all are compiled. Other modules give it numbers and the fields of tuples, which count by their
    values: to change the reader of a format compiles nothing anew. Imports inside functions do not count, since kernels
    have none.
    """
    module = kernel.__module__
    return _stamp(module, Path(kernel.__code__.co_filename).parents[module.count(".")])


@cache
def _stamp(module: str, root: Path) -> bytes:
    waiting, seen, found = [module], {module}, list[tuple[str, bytes, str]]()
    while waiting:
        name = waiting.pop()
        content, imported = _read(name, root)
        if name != module and not _COMPILES.search(content):
            continue
        found.append((name, content, repr(_numbers(sys.modules.get(name)))))
        waiting += [one for one in imported if one not in seen]
        seen.update(imported)
    return hashlib.sha256(repr((sorted(found), _compilers())).encode()).digest()


@cache
def _compilers() -> list[bytes]:
    """Read what takes part in compiling: imports of kernels do not lead there, as it depends on numba's version."""
    contents = [path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py"))]
    return [content for content in contents if _COMPILES.search(content)]


@cache
def _read(module: str, root: Path) -> tuple[bytes, list[str]]:
    """Read a module's file, if there is one, and list the modules of its package that it may import."""
    place = root.joinpath(*module.split("."))
    file = next((one for one in (place.with_suffix(".py"), place / "__init__.py") if one.is_file()), None)
    if file is None:  # What is imported from a module need not be one.
        return b"", []
    content = file.read_bytes()
    imported = {
        name
        for source, names, whole in _IMPORT.findall(content.decode("utf-8", "replace"))
        for name in (source or whole, *(f"{source}.{one}" for one in re.findall(r"\w+", names)))
        if name.partition(".")[0] == module.partition(".")[0]
    }
    return content, sorted(imported)


def _numbers(module: ModuleType | None) -> list[tuple[str, str, str]]:
    """List the numbers in a module with their types, and the fields of its tuples, by name."""
    found = []
    for name, value in vars(module or object).items():
        if isinstance(value, int | float | np.number):
            # As Python writes it: NumPy writes its numbers otherwise from version to version.
            plain = value.item() if isinstance(value, np.number) else value
            found.append((name, type(value).__name__, repr(plain)))
        elif hasattr(value, "_fields"):
            found.append((name, "fields", repr(value._fields)))
    return sorted(found)
