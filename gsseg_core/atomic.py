"""Files that appear whole or not at all."""

from __future__ import annotations

import contextlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path

from gsseg_core.errors import WriteError


@contextlib.contextmanager
def write_atomically(path: str | os.PathLike[str], *, suffix: str | None = None) -> Iterator[Path]:
    """Give a temporary path beside `path`, and move what was written there to `path` at the end.

    An earlier file at `path` stays whole until the new one is complete and on the disk. If the body raises, whatever
    it raises, the temporary file is removed and the earlier file remains.

    Parameters
    ----------
    path : path
        Where the file shall be. Its parent folders are created.
    suffix : str, optional
        Suffix of the temporary name, for writers that go by it; that of `path` by default.

    Yields
    ------
    pathlib.Path
        Name of a file, not yet existing, that the body must create.

    Raises
    ------
    WriteError
        In place of any `OSError`: disk full, folder not writable, `path` is a folder.

    Examples
    --------
    >>> with write_atomically("out/report.json") as temporary:  # doctest: +SKIP
    ...     temporary.write_text("{}")
    """
    path = Path(path)
    temporary = path.with_name(f".gsseg-{secrets.token_hex(6)}{path.suffix if suffix is None else suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        why = error.strerror or error
        raise WriteError(f"{path}: cannot be written ({why}); what was there before is unchanged") from error
    finally:
        # After success the temporary name is gone; where even removal fails the first error is the one to report.
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
