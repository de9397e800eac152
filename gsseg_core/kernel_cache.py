"""How kernels are compiled: where they are kept from one run to the next, and what is done where they cannot be.

numba looks for a folder when a kernel is defined, that is, when its module is imported, and raises an error if it may
write to none. So each room with kernels imports this module first, which looks before numba does; where there is no
such folder, the kernels do without.
"""

from __future__ import annotations

import contextlib
import os
import sys
import tempfile
from collections.abc import Callable
from typing import Any

REMEDY = "set NUMBA_CACHE_DIR to a folder that you can write to"


def candidates() -> list[str]:
    """List the folders that numba tries, in its order."""
    user = "~/Library/Caches" if sys.platform == "darwin" else os.environ.get("XDG_CACHE_HOME", "~/.cache")
    own = os.path.join(os.path.dirname(os.path.abspath(__file__)), "__pycache__")
    chosen = filter(None, [os.environ.get("NUMBA_CACHE_DIR")])
    return [*chosen, own, os.path.join(os.path.expanduser(user), "numba")]


def writable(folder: str) -> bool:
    """Whether a file can be written there; only trying tells, on read-only and full disks and for root alike."""
    try:
        os.makedirs(folder, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(4096))
    except OSError:
        return False
    return True


def called_by_kernels(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """Compile a function that only kernels call, never Python: without the code that Python would call it by.

    That code, which takes arrays apart and puts them together, is a tenth of what there is to compile.
    """
    import numba

    njit: Any = numba.njit  # Its types know fewer options than it takes.
    return njit(function, no_cpython_wrapper=True, no_cfunc_wrapper=True, **options)


def _do_without() -> None:
    """Have numba compile the kernels of gsseg as if nobody had asked to keep them."""
    from numba.core.dispatcher import Dispatcher

    keep = Dispatcher.enable_caching

    def enable_caching(self: Dispatcher) -> None:
        if not self.py_func.__module__.startswith(__package__):
            keep(self)

    Dispatcher.enable_caching = enable_caching  # type: ignore[method-assign]


FOLDER: str | None = next(filter(writable, candidates()), None)
"""The folder that numba will take; None where it can write to none, so that each run compiles anew."""

if FOLDER is None:
    with contextlib.suppress(ImportError):  # Without numba there are no kernels; `gsseg doctor` says so.
        _do_without()
