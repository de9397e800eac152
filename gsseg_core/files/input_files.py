"""Opening what users hand in: regular files only, below a folder if asked for, and images by their header first."""

from __future__ import annotations

import errno
import os
import stat
import struct
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path
from typing import IO

from PIL import Image, UnidentifiedImageError

from gsseg_core.errors import GssegError, PathNotAllowedError
from gsseg_core.files.limits import LIMITS
from gsseg_core.text import clipped

OPENED = "/proc/self/fd"
"""Where Linux names what a descriptor stands for: to open it there opens that, and not what a path has become since."""

READABLE_IMAGES = frozenset({".bmp", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp"})
"""Suffixes of images that `open_image` reads."""

IMAGE_SUFFIXES = READABLE_IMAGES | {".avif", ".dng", ".exr", ".heic", ".heif", ".jxl", ".ppm"}
"""Suffixes that an image may have in the list of a camera file; what else follows a dot belongs to its name."""

_KINDS = {
    stat.S_IFDIR: "a folder", stat.S_IFIFO: "a named pipe", stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device", stat.S_IFBLK: "a device",
}  # fmt: skip
DAMAGED = (
    OSError, SyntaxError, ValueError, TypeError, AttributeError, LookupError, ArithmeticError, EOFError, MemoryError,
    RuntimeError, struct.error, zlib.error, zipfile.BadZipFile, tokenize.TokenError, Image.DecompressionBombError,
)  # fmt: skip
"""What Pillow, NumPy, zipfile and zlib raise on damaged bytes; RuntimeError where a flipped bit says "encrypted"."""


def open_input(path: str | os.PathLike[str], within: Path | None = None) -> BufferedReader:
    """Open a file for reading; links are followed, and with `within` must lead to a file below that folder.

    Raises
    ------
    PathNotAllowedError
        It lies elsewhere; it has not been opened.
    OSError
        There is none, it cannot be read, or it is no regular file: a named pipe might never have anything to read, and
        a device never an end. `strerror` says which.
    """
    try:
        # Without O_NONBLOCK, a named pipe would keep us waiting for a writer right here.
        flags = os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC
        number = os.open(path, flags) if within is None else _open_below(path, within, flags)
    except ValueError as error:  # a NUL in the path
        raise OSError(errno.EINVAL, str(error), str(path)) from error
    except OSError as error:
        if error.errno == errno.ENXIO:
            raise OSError(errno.ENXIO, "is a socket or a device", str(path)) from error
        raise
    mode = os.fstat(number).st_mode
    if not stat.S_ISREG(mode):
        os.close(number)
        kind = _KINDS.get(stat.S_IFMT(mode), "no file")
        raise OSError(errno.EINVAL, f"is {kind}", str(path))
    return os.fdopen(number, "rb")


def read_input(
    path: str | os.PathLike[str], error: type[GssegError], within: Path | None = None, first: int | None = None
) -> bytes:
    """Read a file, or its first bytes, below `within` if given.

    Raises `error` if it cannot be read, or is larger than any JSON file is, as `Limits.max_json_bytes` says.
    """
    limit = LIMITS.max_json_bytes
    try:
        with open_input(path, within) as file:
            content = file.read(limit + 1 if first is None else first)
    except OSError as cause:
        raise error(f"{path}: cannot be read ({reason(cause)})") from cause
    if len(content) > limit:
        raise error(f"{path}: is too large; expected at most {limit:,} bytes (limit max_json_bytes)")
    return content


def _open_below(path: str | os.PathLike[str], within: Path, flags: int) -> int:
    """Open the file that a path leads to now, and nothing that takes its place meanwhile."""
    found = os.open(path, os.O_PATH | os.O_CLOEXEC)  # opens nothing yet
    try:
        require_below(os.readlink(f"{OPENED}/{found}"), path, within)
        return os.open(f"{OPENED}/{found}", flags)
    finally:
        os.close(found)


def require_below(place: str, path: str | os.PathLike[str], within: Path) -> None:
    """Raise `PathNotAllowedError`, on `path`, unless the place that it leads to is below a folder."""
    root = os.path.realpath(within)
    if place != root and not place.startswith(root.rstrip("/") + "/"):
        raise PathNotAllowedError(f"{path}: leads out of {within}; expected what lies below it, links followed")


def list_folder(folder: Path, within: Path | None) -> list[Path]:
    """List, sorted, what is in a folder that `require_below` allows, none if there is no folder; for `open_input`."""
    if not folder.is_dir():
        return []
    if within is not None:
        require_below(os.path.realpath(folder), folder, within)
    return sorted(folder.iterdir())


def list_below(folder: Path, within: Path | None, depth: int = 4) -> list[Path]:
    """List the files in a folder and, so deep, in those in it that are not hidden; as `list_folder` does."""
    files: list[Path] = []
    for path in list_folder(folder, within):
        if not path.is_dir():
            files.append(path)
        elif depth and not path.name.startswith("."):
            files += list_below(path, within, depth - 1)
    return files


def is_there(path: Path, error: type[GssegError]) -> bool:
    """Tell whether an optional file is there; whatever else has its name is refused.

    Raises
    ------
    GssegError
        Of the given class: a link that leads nowhere, which was meant to be there; a folder; a named pipe.
    """
    try:
        mode = path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError) as cause:
        if path.is_symlink():
            raise error(f"{path}: is a link to {os.readlink(path)}, which does not exist; expected a file") from cause
        return False
    except OSError as cause:
        raise error(f"{path}: cannot be read ({cause.strerror or cause})") from cause
    if not stat.S_ISREG(mode):
        raise error(f"{path}: is {_KINDS.get(stat.S_IFMT(mode), 'no file')}; expected a regular file, or nothing")
    return True


def reason(error: BaseException) -> str:
    """Say on one line why a file cannot be read."""
    said = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return clipped(f"lacks {said}" if isinstance(error, KeyError) else said, 160)


def check_pixels(width: int, height: int, source: str, error: type[GssegError]) -> None:
    """Raise `error` if an image claims to have more pixels than any camera takes."""
    if width * height > LIMITS.max_pixels:
        raise error(
            f"{source}: claims {clipped(width, 24)} x {clipped(height, 24)} pixels; expected at most "
            f"{LIMITS.max_pixels:,} in all (limit max_pixels)"
        )


@contextmanager
def open_image(
    path: str | os.PathLike[str],
    error: type[GssegError],
    kind: str,
    expected: str,
    formats: tuple[str, ...] | None = None,
    within: Path | None = None,
) -> Iterator[Image.Image]:
    """Open an image whose header claims no more pixels than any camera takes; its pixels are not read yet.

    `error` is raised, also for pixels that the body finds to be damaged; messages call the image a `kind`, and say what
    was `expected`. `formats` are those of Pillow, all by default. With `within`, it must lie below that folder, links
    followed.
    """
    try:
        file = open_input(path, within)
    except OSError as cause:
        raise error(f"{path}: cannot be read ({reason(cause)}); expected {expected}") from cause
    with file, decode_image(file, str(path), error, kind, expected, formats) as image:
        yield image


@contextmanager
def decode_image(
    file: IO[bytes],
    source: str,
    error: type[GssegError],
    kind: str,
    expected: str,
    formats: tuple[str, ...] | None = None,
) -> Iterator[Image.Image]:
    """Open an image that is open as a file, or in memory, as `open_image` does; messages begin with its `source`."""
    try:
        with warnings.catch_warnings():  # Pillow warns of images that are within our own limit.
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            image = Image.open(file, formats=formats)
        check_pixels(*image.size, source, error)
        yield image
    except DAMAGED as cause:
        # Of what it does not know, Pillow tells nothing but the address of the object that it was handed.
        why = "of no known format" if isinstance(cause, UnidentifiedImageError) else reason(cause)
        raise error(f"{source}: broken {kind} ({why}); expected {expected}") from cause
