"""Files that appear whole or not at all."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import re
import secrets
import stat
from collections.abc import Iterable, Iterator
from pathlib import Path

from gsseg_core.errors import PathTakenError, WriteError

_TEMPORARY = re.compile(r"\.gsseg-[0-9a-f]{12}(\..*)?", re.DOTALL)


@contextlib.contextmanager
def write_atomically(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield the path of an empty file beside `path`, which the body writes; at the end it takes the name `path`.

    An earlier file at `path` stays whole until the new one is complete and on the disk. If the body raises anything,
    the temporary file is removed and the earlier one remains; after a kill, the next write or run in the same folder
    removes it. A link to a file stays, and the file that it leads to is replaced. Parent folders are created, and
    removed again if the body raises. The temporary file has the suffix of `path`, for writers that go by it.

    Raises `PathTakenError` where `path` is a folder, a device, a FIFO or a socket, and `WriteError` in place of any
    `OSError`: disk full, folder not writable.
    """
    path = Path(path)
    temporary, lock, made = None, -1, list[Path]()
    try:
        target = _replaceable(path)
        made = [folder for folder in target.parents if not folder.exists()]
        target.parent.mkdir(parents=True, exist_ok=True)
        remove_leftovers(target.parent)
        temporary, lock = _locked_file(target.parent, path.suffix)
        yield temporary
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary, target)
    except OSError as error:
        why = error.strerror or error
        raise WriteError(f"{path}: cannot be written ({why}); what was there before is unchanged") from error
    finally:
        # After success the temporary name is gone; where even removal fails the first error is the one to report.
        with contextlib.suppress(OSError):
            if temporary is not None:
                temporary.unlink(missing_ok=True)
            if lock >= 0:
                os.close(lock)
        remove_empty(made)  # After a success, none is.


def check_writable(path: str | os.PathLike[str]) -> None:
    """Raise at once what `write_atomically` would raise after the work, but for a full disk; writes nothing."""
    path = Path(path)
    try:
        check_changeable(_replaceable(path), path)
    except OSError as error:
        raise WriteError(f"{path}: cannot be written ({error.strerror or error})") from error


def check_changeable(target: Path, path: Path) -> None:
    """Raise `WriteError`, naming `path`, if this user may neither make nor replace nor remove a file; or `OSError`."""
    folder = target.parent
    while not os.path.lexists(folder):
        folder = folder.parent
    if not folder.is_dir():
        raise WriteError(f"{path}: cannot be written ({folder} is not a folder)")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise WriteError(f"{path}: cannot be written (no permission to write into {folder})")
    if not os.path.lexists(target):
        return
    # Where this bit is set, as for /tmp, everybody makes files, and changes the name of nobody else's.
    if folder.stat().st_mode & stat.S_ISVTX and os.geteuid() not in (0, folder.stat().st_uid, target.lstat().st_uid):
        raise WriteError(f"{path}: cannot be written (it is another user's, and {folder} leaves it to its owner)")


def check_replaceable(path: Path, what: str, is_one: bool) -> None:
    """Raise `PathTakenError` if something is at `path` that is not what will be written there."""
    if os.path.lexists(path) and not is_one:
        raise PathTakenError(f"{path}: is there and is no {what}; expected a new file, or a {what} to replace")


def try_lock(file: int) -> bool | None:
    """Lock an open file for this process; False if another has locked it, None where the file system has no locks.

    The lock ends with the process, however that ends.
    """
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def sync_folder(folder: Path) -> None:
    """Flush the entries of a folder to the disk, where its file system can do that."""
    with contextlib.suppress(OSError):
        file = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(file)
        finally:
            os.close(file)


def remove_empty(folders: Iterable[Path]) -> None:
    """Remove those of some folders, the innermost first, that are there and empty."""
    for folder in folders:
        with contextlib.suppress(OSError, ValueError):  # ValueError: a NUL in the path
            folder.rmdir()


def remove_leftovers(folder: Path) -> None:
    """Remove temporary files in a folder whose writers are dead."""
    names = list[str]()
    # Some let everybody put files into a folder, and nobody see what is there.
    with contextlib.suppress(PermissionError), os.scandir(folder) as entries:
        names = [entry.path for entry in entries if _TEMPORARY.fullmatch(entry.name)]
    for name in names:
        with contextlib.suppress(OSError), open(name, "rb") as file:
            if try_lock(file.fileno()):
                os.unlink(name)


def _replaceable(path: Path) -> Path:
    """Follow a link to the file that is to be replaced; `PathTakenError` if it is none, or `OSError`."""
    target = Path(os.path.realpath(path)) if path.is_symlink() else path
    try:
        mode = os.stat(target).st_mode
    except FileNotFoundError:
        return target
    except ValueError as error:  # a NUL in the path
        raise OSError(errno.EINVAL, str(error)) from error
    if not stat.S_ISREG(mode):
        what = "a folder" if stat.S_ISDIR(mode) else "a device, a FIFO or a socket"
        raise PathTakenError(f"{path}: cannot be written (it is {what}); expected a file, or nothing")
    return target


def _locked_file(folder: Path, suffix: str) -> tuple[Path, int]:
    """Make an empty file that `remove_leftovers` leaves alone while this process lives; returns path and descriptor."""
    while True:
        path = folder / f".gsseg-{secrets.token_hex(6)}{suffix}"
        file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
        # Between the two calls another process may have taken it for a leftover.
        if try_lock(file) is not False and path.exists():
            return path, file
        os.close(file)
