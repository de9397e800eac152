"""Reading what belongs to one scene from an npz: anything wrong with the file is one clear error."""

from __future__ import annotations

import json
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from gsseg_core.confined_files import open_input
from gsseg_core.errors import GssegError, StateFileError, StateMismatchError

# What NumPy, zipfile and zlib raise on damaged bytes; RuntimeError where a flipped bit says "encrypted".
_DAMAGED = (
    OSError, KeyError, IndexError, ValueError, TypeError, AttributeError, EOFError, RuntimeError, MemoryError,
    struct.error, zipfile.BadZipFile, zlib.error, SyntaxError, tokenize.TokenError,
)  # fmt: skip

_BEGINNING = 1024
"""Bytes of a header that are enough to tell its format."""


@contextmanager
def open_npz(
    path: Path, what: str, file_format: str, digest: str, within: Path | None = None
) -> Iterator[tuple[np.lib.npyio.NpzFile, Any]]:
    """Open an npz with a JSON header, of a given format and scene.

    Parameters
    ----------
    path : pathlib.Path
        The file.
    what : str
        What it should be, for messages: "a saved state".
    file_format, digest : str
        What the header must say under "format" and "scene".
    within : pathlib.Path, optional
        A folder below which the file must lie, links followed.

    Yields
    ------
    NpzFile, dict
        The arrays and the header. Whatever goes wrong with them in the body counts as damage to the file.

    Raises
    ------
    StateFileError
        The file is missing, damaged, or of another format.
    StateMismatchError
        It belongs to another scene.
    PathNotAllowedError
        The file lies outside `within`.
    """
    try:
        # Opened here, since np.load leaves a file open that it cannot read.
        with open_input(path, within) as opened, np.load(opened, allow_pickle=False) as file:
            header = json.loads(str(file["header"]))
            if header["format"] != file_format:
                raise StateFileError(f"{path}: format is {header['format']!r}; expected {file_format!r}")
            if header["scene"] != digest:
                raise StateMismatchError(
                    f"{path}: belongs to the scene {header['scene'][:12]}; expected {digest[:12]}, the scene in use"
                )
            yield file, header
    except GssegError:
        raise
    except FileNotFoundError as error:
        raise StateFileError(f"{path}: does not exist; expected {what}") from error
    except _DAMAGED as error:
        raise StateFileError(f"{path}: is not {what}, or is damaged ({error})") from error


def npz_format(path: Path) -> str:
    """Read from the header of an npz what it says that it is; empty if it is missing, damaged or says nothing.

    Only the first bytes are looked at: whether the rest is whole, and of which scene, does not matter.
    """
    if not path.is_file():
        return ""
    try:
        with zipfile.ZipFile(path) as file, file.open("header.npy") as header:
            # NumPy stores text as UTF-32, after a line on its type that is shorter than 256 bytes.
            beginning = header.read(_BEGINNING)
    except _DAMAGED:
        return ""
    for order in ("utf-32-le", "utf-32-be"):
        _, said, rest = beginning.partition('{"format": "'.encode(order))
        if said:
            return rest[: len(rest) // 4 * 4].decode(order, "replace").partition('"')[0]
    return ""
