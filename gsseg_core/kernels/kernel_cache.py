"""Where compiled kernels are kept from one run to the next, and what is done where they cannot be.

numba looks for a folder when a kernel is defined, that is, when its module is imported, and raises an error if it may
write to none. So this module looks first; where there is no such folder, the kernels do without.
"""

from __future__ import annotations

import os
import pickle
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

_PACKAGE = Path(__file__).resolve().parents[1]

NOT_WHOLE = (EOFError, pickle.UnpicklingError)
"""What reading raises of a file that was not on the disk when the power failed: for ever, unless it is flushed."""

REMEDY = "set NUMBA_CACHE_DIR to a folder that you can write to"


if not os.path.isabs(os.environ.get("XDG_CACHE_HOME", "/")):
    # Not set, says its specification; numba would load kernels from the folder in which the user happens to be.
    del os.environ["XDG_CACHE_HOME"]


def candidates() -> list[str]:
    """List the folders that numba tries, in its order."""
    user = "~/Library/Caches" if sys.platform == "darwin" else os.environ.get("XDG_CACHE_HOME", "~/.cache")
    own = str(_PACKAGE / "__pycache__")
    chosen = filter(None, [os.environ.get("NUMBA_CACHE_DIR")])
    known = os.path.join(os.path.expanduser(user), "numba")
    # Of a user without a home, "~" stays, which numba takes for a folder where he happens to be.
    return [*chosen, own, *filter(os.path.isabs, [known])]


def writable(folder: str) -> bool:
    """Whether a file can be written there; only trying tells, on read-only and full disks and for root alike."""
    try:
        os.makedirs(folder, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(4096))
    except OSError:
        return False
    return True


FOLDER: str | None = next(filter(writable, candidates()), None)
"""The folder that numba will take; None where it can write to none, so that each run compiles anew."""

INCOMPLETE = False
"""Whether a kernel could not be written to that folder, as on a disk that is full, so that each run compiles it."""


def keep(kernel: Any, enable: Callable[[Any], None]) -> None:
    """Have a kernel kept from one run to the next, by what enables that of its kind, if it can be.

    In the folder numba makes one for each of ours. Where root has run gsseg as this user, that may be root's.
    """
    global FOLDER
    if FOLDER is not None:
        try:
            enable(kernel)
        except RuntimeError:
            FOLDER = None
