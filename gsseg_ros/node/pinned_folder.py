"""Folders to write into that must lie below one folder, whoever moves them meanwhile (Linux).

A path is only a question: between the look at it and the opening, any part of it can become a link to somewhere else.
Here what was looked at is what is opened.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from gsseg_core.errors import GssegError, PathNotAllowedError, WriteError
from gsseg_core.files.input_files import OPENED


@contextlib.contextmanager
def pinned_folder(folder: Path, within: Path) -> Iterator[Path]:
    """Give a second name of a folder, under which it stays the same folder whatever becomes of its path.

    The folder is made where it is missing, below `within` or that itself; both are without links. In the errors of
    gsseg that the body raises, the first name stands in the place of the second.

    Raises
    ------
    PathNotAllowedError
        The folder is not below `within`.
    WriteError
        It cannot be made, or a part of its path is a file, or has become a link.
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
                descriptor = os.open(part, kind, dir_fd=descriptor)
                opened.callback(os.close, descriptor)
        except OSError as error:
            raise WriteError(f"{folder}: cannot be written ({error.strerror or error})") from error
        pinned = Path(OPENED, str(descriptor))
        try:
            yield pinned
        except GssegError as error:
            raise type(error)(str(error).replace(str(pinned), str(folder))) from error
