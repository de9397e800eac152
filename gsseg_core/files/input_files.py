"""Opening what users hand in: regular files only, below a folder if asked for, and images by their header first."""

from __future__ import annotations

import errno
import os
import stat
import struct
import sys
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
"""Folder in which Linux has a link to each open file, by its descriptor: it leads to the file that was opened, even if
another one has taken its path since."""

READABLE_IMAGES = frozenset({".bmp", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp"})
"""Suffixes of images that `open_image` reads."""

IMAGE_SUFFIXES = READABLE_IMAGES | {".avif", ".dng", ".exr", ".heic", ".heif", ".jxl", ".ppm"}
"""Suffixes that an image may have in the list of a camera file; what else follows a dot belongs to its name."""

_KINDS = {
    stat.S_IFDIR: "a folder", stat.S_IFIFO: "a named pipe", stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device", stat.S_IFBLK: "a device",
}  # fmt: skip
_UNPACKERS = (("lzma", "LZMAError"), ("compression.zstd", "ZstdError"))
DAMAGED = (
    OSError, SyntaxError, ValueError, TypeError, AttributeError, LookupError, ArithmeticError, EOFError,
    RuntimeError, struct.error, zlib.error, zipfile.BadZipFile, tokenize.TokenError, Image.DecompressionBombError,
    # Of what zipfile has loaded to unpack with: not every Python has them.
    *(getattr(sys.modules.get(name), error, zlib.error) for name, error in _UNPACKERS),
)  # fmt: skip
"""What Pillow, NumPy, zipfile and zlib raise on damaged bytes; RuntimeError where a flipped bit says "encrypted".

That memory is not enough is no damage: a mask would count as broken, and be left out, without a word of the cause.
"""


class UnfitError(ValueError):
    """Content of a file that can be read, but not used; the message says what was found, and what was expected."""


def open_input(path: str | os.PathLike[str], within: Path | None = None) -> BufferedReader:
    """Open a file for reading; links are followed, and with `within` must lead to a file below that folder.

    Raises `PathNotAllowedError` where it lies elsewhere, before it is opened, and `OSError`, whose `strerror` says why,
    where it cannot be read or is no regular file: a named pipe might never have anything to read, a device never end.
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


@contextmanager
def open_expected(
    path: str | os.PathLike[str], error: type[GssegError], expected: str = "", within: Path | None = None
) -> Iterator[BufferedReader]:
    """Open a file by `open_input`; raise `error`, which says what was `expected`, if it cannot be opened or read."""
    try:
        with open_input(path, within) as file:
            yield file
    except OSError as cause:
        wanted = f"; expected {expected}" if expected else ""
        raise error(f"{path}: cannot be read ({reason(cause)}){wanted}") from cause


def read_input(
    path: str | os.PathLike[str], error: type[GssegError], within: Path | None = None, most: int | None = None
) -> bytes:
    """Read a file, below `within` if given; raise `error` if it cannot be read, or has more than so many bytes.

    By default, that is as many as any JSON file has, `Limits.max_json_bytes`.
    """
    limit, named = (LIMITS.max_json_bytes, " (limit max_json_bytes)") if most is None else (most, "")
    with open_expected(path, error, within=within) as file:
        content = file.read(limit + 1)
    if len(content) > limit:
        raise error(f"{path}: is too large; expected at most {limit:,} bytes{named}")
    return content


def _open_below(path: str | os.PathLike[str], within: Path, flags: int) -> int:
    """Open the file that a path leads to, once it is known to lie below `within`: never one that replaces it then."""
    found = os.open(path, os.O_PATH | os.O_CLOEXEC)  # opens nothing yet
    try:
        require_below(os.readlink(f"{OPENED}/{found}"), path, within)
        return os.open(f"{OPENED}/{found}", flags)
    finally:
        os.close(found)


def require_below(target: str, path: str | os.PathLike[str], within: Path) -> None:
    """Raise `PathNotAllowedError`, naming `path`, unless `target`, to which its links lead, is below a folder."""
    root = os.path.realpath(within)
    if target != root and not target.startswith(root.rstrip("/") + "/"):
        raise PathNotAllowedError(f"{path}: leads out of {within}; expected what lies below it, links followed")


def list_folder(folder: Path, error: type[GssegError], within: Path | None) -> list[Path]:
    """List what is in a folder and not hidden, sorted; nothing if there is no folder. With `within`, it must lie below.

    Hidden is, for one, `._mask.png`, which macOS writes beside each `mask.png` on disks that are not its own.

    Raises `error` where it cannot be read.
    """
    try:
        if not folder.is_dir():
            return []
        if within is not None:
            require_below(os.path.realpath(folder), folder, within)
        return sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    except OSError as cause:
        raise error(f"{folder}: cannot be read ({reason(cause)}); expected a folder that can be listed") from cause


def list_below(folder: Path, error: type[GssegError], within: Path | None, depth: int = 4) -> list[Path]:
    """List the files of a folder and, `depth` levels down, of its folders, by `list_folder`."""
    files: list[Path] = []
    for path in list_folder(folder, error, within):
        if not path.is_dir():
            files.append(path)
        elif depth:
            files += list_below(path, error, within, depth - 1)
    return files


def is_there(path: Path, error: type[GssegError]) -> bool:
    """Tell whether an optional file is there; raise `error` if something else has its name.

    That is a folder, a named pipe, or a link that leads nowhere: its file was meant to be there.
    """
    try:
        mode = path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError) as cause:
        if path.is_symlink():
            raise error(f"{path}: is a link to {os.readlink(path)}, which does not exist; expected a file") from cause
        return False
    except (OSError, ValueError) as cause:  # ValueError: a NUL in the path
        raise error(f"{path}: cannot be read ({reason(cause)})") from cause
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

    Raises `error`, also for pixels that turn out to be damaged in the body; messages call the image a `kind`, and say
    what was `expected`. `formats` are names of Pillow's, all by default. With `within`, the image must lie below that
    folder, links followed.
    """
    with (
        open_expected(path, error, expected, within) as file,
        decode_image(file, str(path), error, kind, expected, formats) as image,
    ):
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
        if image.format == "PNG":
            _check_png(file)
        yield image
    except DAMAGED as cause:
        # Of what it does not know, Pillow tells nothing but the address of the object that it was handed.
        why = "of no known format" if isinstance(cause, UnidentifiedImageError) else reason(cause)
        raise error(f"{source}: broken {kind} ({why}); expected {expected}") from cause


def _check_png(file: IO[bytes]) -> None:
    """Raise `ValueError` where pixels of a PNG are not as its checksums say, which Pillow does not compare."""
    place = file.tell()
    file.seek(8)
    # Chunks whose name has a small first letter have no say in what the pixels are.
    while len(head := file.read(8)) == 8 and (kind := head[4:]) != b"IEND":
        left, checksum = int.from_bytes(head[:4], "big"), zlib.crc32(kind)
        if not kind[:1].isupper():
            file.seek(left + 4, os.SEEK_CUR)
            continue
        while left and (block := file.read(min(left, 1 << 20))):
            left, checksum = left - len(block), zlib.crc32(block, checksum)
        if file.read(4) != checksum.to_bytes(4, "big"):
            raise ValueError(f"chunk {kind.decode('latin-1')} is not as its checksum says")
    file.seek(place)
