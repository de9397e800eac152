"""Names of classes and views: which are usable, and which class is meant by one.

What is named ends up in file names, pictures, reports and on terminals, long after it was read. So a name is looked at
where it comes in, before anything is learnt.
"""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable, Mapping

from gsseg_core.errors import SettingsError
from gsseg_core.text import clipped, quoted

MAX_CLASS_NAME = 200
"""Characters of a class name."""

MAX_VIEW_NAME = 240
"""Bytes of a view's name, in UTF-8: files are called after it, and a file name has 255 at most."""

_LISTED = 20


def flaw_of_class_name(name: str) -> str:
    """Say what is wrong with the name of a class, as the end of "has the name ...", or "" if it is usable."""
    if not name.strip():
        return f"{quoted(name)}; expected text"
    return _flaw(name) or (
        f"{quoted(name)} of {len(name):,} characters; expected at most {MAX_CLASS_NAME}"
        if len(name) > MAX_CLASS_NAME
        else ""
    )


def flaw_of_view_name(name: str) -> str:
    """Say what is wrong with the name of a view, as the end of "has the name ...", or "" if it is usable."""
    flaw = _flaw(name)
    size = 0 if flaw else len(name.encode())
    return flaw or (
        f"{quoted(name)} of {size:,} bytes; expected at most {MAX_VIEW_NAME}, since files are called after it"
        if size > MAX_VIEW_NAME
        else ""
    )


def listed(names: Iterable[str]) -> str:
    """List names for a message: the first ones, and how many more there are."""
    every = [clipped(name) for name in names]
    more = len(every) - _LISTED
    return ", ".join(every[:_LISTED]) + (f" and {more:,} more" if more > 0 else "")


def class_ids(wanted: Iterable[str], class_names: Mapping[int, str]) -> list[int]:
    """Ids of the classes that are meant, in the order asked for, each once.

    A number is the id of a class where there is one; everything else is a name.

    Parameters
    ----------
    wanted : iterable of str
        Names or ids.
    class_names : mapping from id to name
        All classes.

    Raises
    ------
    SettingsError
        There is no such class, or several have this name.
    """
    ids = []
    for name in wanted:
        number = int(name) if name.isascii() and name.isdigit() and len(name) < 9 else -1
        meant = [number] if number in class_names else [k for k, known in class_names.items() if known == name]
        if not meant:
            known = listed(f"{k} ({clipped(known)})" for k, known in class_names.items())
            raise SettingsError(f"class {quoted(name)} does not exist; expected one of {known}")
        if len(meant) > 1:
            raise SettingsError(
                f"{len(meant)} classes have the name {quoted(name)}; expected one of their ids, "
                f"{listed(map(str, meant))}"
            )
        ids += meant
    return list(dict.fromkeys(ids))


def _flaw(name: str) -> str:
    # Cc: control characters; Cs: halves of characters, which no file can hold; Zl, Zp: ends of lines.
    unusable = next((c for c in name if unicodedata.category(c) in ("Cc", "Cs", "Zl", "Zp")), "")
    return f"{quoted(name)}, with the character {unusable!a}; expected one line of text" if unusable else ""
