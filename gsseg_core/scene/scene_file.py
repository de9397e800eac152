"""Opening the file of a scene: one clear error for whatever is missing, damaged, or claims too much."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path

from gsseg_core.errors import SceneFileError
from gsseg_core.files.input_files import DAMAGED, UnfitError, open_expected, reason
from gsseg_core.files.limits import LIMITS
from gsseg_core.text import clipped


@contextmanager
def open_scene(path: Path, within: Path | None, expected: str) -> Iterator[BufferedReader]:
    """Open a file that should be `expected`, such as "an SPZ file"; what the body raises counts as damage to the file.

    Raises `SceneFileError` where the file is missing, damaged, too large for the memory, or the body raised
    `UnfitError`, whose message says what was found and expected; `PathNotAllowedError` where it does not lie below
    `within`, links followed.
    """
    with open_expected(path, SceneFileError, expected, within) as file, refusing_damage(path, expected):
        yield file


@contextmanager
def refusing_damage(path: Path, expected: str) -> Iterator[None]:
    """Raise `SceneFileError` in place of what the body raises of the content of a file, as `open_scene` does."""
    try:
        yield
    except UnfitError as error:
        raise SceneFileError(f"{path}: {error}") from error
    except MemoryError as error:
        raise SceneFileError(f"{path}: memory is not enough ({reason(error)}); expected a smaller scene") from error
    except DAMAGED as error:
        raise SceneFileError(f"{path}: truncated or not {expected} ({reason(error)}); expected it whole") from error


def size_of(file: BufferedReader) -> int:
    """Size of an open file in bytes."""
    return os.fstat(file.fileno()).st_size


def check_count(count: int) -> None:
    """Raise `UnfitError` if a file claims more Gaussians than any scene has, or fewer than none."""
    if not 0 <= count <= LIMITS.max_gaussians:
        raise UnfitError(
            f"claims {clipped(f'{count:,}', 40)} Gaussians; expected at most {LIMITS.max_gaussians:,} (limit "
            "max_gaussians)"
        )


def check_size(found: int, least: int, what: str) -> None:
    """Raise `UnfitError` if there are fewer bytes of something than its count takes."""
    if found < least:
        raise UnfitError(f"{what}: {found:,} bytes are there; expected at least {least:,} (the file is truncated)")
