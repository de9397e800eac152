"""Folders that the node writes into: they lie below its root, and hold nothing but exports (Linux).

A path is only a question: between the look at it and the opening, any part of it can become a link to somewhere else.
A pinned folder is what was looked at.
"""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Iterator
from pathlib import Path

from gsseg_core.errors import GssegError, PathNotAllowedError, PathTakenError, WriteError
from gsseg_core.files.input_files import OPENED
from gsseg_core.files.run_folder import COMMIT_FILE, RUN_FILE, STAGING, StagedRun, staged_run
from gsseg_core.files.run_manifest import Manifest


@contextlib.contextmanager
def pinned_folder(folder: Path, within: Path) -> Iterator[Path]:
    """Give a second name of a folder, under which it stays the same folder whatever becomes of its path.

    The folder is made where it is missing, below `within` or that itself; both are without links. Where the body raises
    an error, folders that were made and are empty go again, and in errors of gsseg the first name stands in the place
    of the second. Raises `PathNotAllowedError`: the folder is not below `within`; `WriteError`: it cannot be made, or a
    part of its path is a file, or has become a link.
    """
    if folder != within and within not in folder.parents:
        raise PathNotAllowedError(f"{folder}: does not lie below {within}; expected a path below it")
    kind = os.O_PATH | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
    with contextlib.ExitStack() as opened:
        try:
            descriptor = os.open(within, kind)
            opened.callback(os.close, descriptor)
            for part in folder.relative_to(within).parts:
                with contextlib.suppress(FileExistsError):
                    os.mkdir(part, dir_fd=descriptor)
                    opened.push(functools.partial(_remove_where_failed, part, descriptor))
                descriptor = os.open(part, kind, dir_fd=descriptor)
                opened.callback(os.close, descriptor)
        except OSError as error:
            raise WriteError(f"{folder}: cannot be written ({error.strerror or error})") from error
        pinned = Path(OPENED, str(descriptor))
        try:
            yield pinned
        except GssegError as error:
            raise type(error)(str(error).replace(str(pinned), str(folder))) from error


def _remove_where_failed(name: str, parent: int, error: type[BaseException] | None, *_: object) -> None:
    if error is not None:
        with contextlib.suppress(OSError):  # Somebody may have put something there.
            os.rmdir(name, dir_fd=parent)


def require_own_folder(out: Path, kind: str, scene: Path | None = None) -> None:
    """Refuse a folder that holds anything but holds no results of this kind, or whose results the scene is one of.

    Raises `PathTakenError`, `WriteError`: it is such a folder, or cannot be looked into.
    """
    if os.path.lexists(out) and not os.path.isdir(out):
        raise PathTakenError(f"{out}: is not a folder; expected one, or nothing")
    try:
        there = sorted(os.listdir(out))
    except FileNotFoundError:
        return
    except OSError as error:  # Also where a name is too long.
        raise WriteError(f"{out}: cannot be written ({error.strerror or error}); expected a folder") from error
    # A first run that was killed while its files were moved into their places is not in the manifest yet.
    manifests = (RUN_FILE, COMMIT_FILE)
    foreign = [name for name in there if name not in manifests and not STAGING.fullmatch(name)]
    if foreign and not any(Manifest.read(out / name).files(kind) for name in manifests):
        raise PathTakenError(
            f"{out}: holds {foreign[0][:60]!r}, and no results of gsseg {kind}; expected a folder that is new, "
            "empty, or holds such results"
        )
    StagedRun(out, kind).keep_apart(filter(None, [scene]))


@contextlib.contextmanager
def staged_export(folder: Path, within: Path, scene: Path | None = None) -> Iterator[StagedRun]:
    """Give a run whose files become the export in a folder below `within`, which must hold nothing but exports.

    The file of the scene must be none of an earlier export there, which goes.

    Raises `PathNotAllowedError`, `PathTakenError`, `WriteError`: as `pinned_folder`, `require_own_folder` and
    `gsseg_core.files.run_folder.staged_run` do.
    """
    with pinned_folder(folder, within) as pinned:
        require_own_folder(pinned, "segment")
        with staged_run(pinned, "segment", inputs=filter(None, [scene])) as run:
            yield run
