"""Names of classes and views: read from `classes.json`, checked, and looked up.

Names end up in file names, pictures, reports and on terminals, long after they were read. So they are checked where
they come in, before anything is learnt.
"""

from __future__ import annotations

import os
import re
import unicodedata
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

from gsseg_core.errors import ClassesFileError, GssegError, SettingsError
from gsseg_core.files.json_files import read_object
from gsseg_core.files.limits import MAX_LABEL
from gsseg_core.text import clipped, quoted

BACKGROUND_NAME = "background"

MAX_CLASS_NAME = 200  # characters
MAX_VIEW_NAME = 240  # bytes in UTF-8: files are called after views, and a file name has 255 at most

_LISTED, NOTED = 20, 5


def read_classes(path: str | os.PathLike[str], within: Path | None = None) -> dict[int, str]:
    """Read `classes.json`, an object from id to name; sorted by id, 0 being "background" unless named otherwise.

    With `within`, the file must lie below that folder, links followed (else `PathNotAllowedError`). Raises
    `ClassesFileError` where it is missing or broken, an id is not a whole number from 0 to 65534, or a name is not one
    line of text of at most 200 characters.
    """
    path = Path(path)
    content = read_object(path, ClassesFileError, 'an object such as {"1": "chair"}', within)
    names = {0: BACKGROUND_NAME}
    for key, name in content.items():
        if not re.fullmatch(r"0|[1-9][0-9]{0,4}", key) or int(key) > MAX_LABEL:
            raise ClassesFileError(f"{path}: id {quoted(key)} is unusable; expected whole numbers from 0 to 65534")
        names[int(key)] = check_class_name(name, ClassesFileError, f"{path}: id {key} has")
    return dict(sorted(names.items()))


def class_name(names: Mapping[int, str], k: int) -> str:
    """Name of a class, one like "class_07" where it has none."""
    return names.get(k, f"class_{k:02d}")


def names_together(known: Mapping[int, str], given: Mapping[int, str]) -> dict[int, str]:
    """Add names of classes to those that are known; one like "class_07" replaces none."""
    return {**known, **{k: name for k, name in given.items() if k not in known or name != class_name({}, k)}}


def check_same_names(
    names: Mapping[int, str], known: Mapping[int, str], source: object, where: str, error: type[GssegError]
) -> None:
    """Raise `error` if a source names a class otherwise than `known` does, which are the names `where` says.

    Names like "class_07", which were made up where there were none, fit any other.
    """
    for k in sorted(names.keys() & known.keys()):
        here, there = names[k], known[k]
        if here != there and class_name({}, k) not in (here, there):
            raise error(f"{source}: calls class {k} {quoted(here)}; expected {quoted(there)}, as in {where}")


def check_class_names(names: Mapping[int, str], error: type[GssegError]) -> None:
    """Raise `error` unless every name of a class is one line of text."""
    for k, name in names.items():
        check_class_name(name, error, f"class names: id {k} has")


def check_class_name(name: object, error: type[GssegError], who: str) -> str:
    """Return the name of a class, or raise `error` if it is unusable: what it says begins with `who` has the name."""
    if flaw := flaw_of_class_name(name):
        raise error(f"{who} the name {flaw}")
    return str(name)


def flaw_of_class_name(name: object) -> str:
    """Say what is wrong with the name of a class, as the end of "has the name ...", or "" if it is usable."""
    if not isinstance(name, str) or not name.strip():
        return f"{quoted(name)}; expected text"
    is_long = len(name) > MAX_CLASS_NAME
    too_long = f"{quoted(name)} of {len(name):,} characters; expected at most {MAX_CLASS_NAME}" if is_long else ""
    return _flaw(name) or too_long


def flaw_of_view_name(name: str) -> str:
    """Say what is wrong with the name of a view, as the end of "has the name ...", or "" if it is usable."""
    size = len(name.encode(errors="replace"))
    wanted = f"expected at most {MAX_VIEW_NAME}, since files are called after it"
    return _flaw(name) or (f"{quoted(name)} of {size:,} bytes; {wanted}" if size > MAX_VIEW_NAME else "")


def listed(names: Iterable[str], most: int = _LISTED, written: Callable[[str], str] = clipped) -> str:
    """List names for a message: the first ones, as they are `written`, and how many more there are."""
    every = [written(name) for name in names]
    more = len(every) - most
    return ", ".join(every[:most]) + (f" and {more:,} more" if more > 0 else "")


def id_of(text: str, class_names: Mapping[int, str]) -> int | None:
    """Return the id that a text is, if it is one of the classes'."""
    number = int(text) if text.isascii() and text.isdecimal() and len(text) < 9 else -1
    return number if number in class_names else None


def meant_by(text: str, class_names: Mapping[int, str]) -> list[int]:
    """Return the ids that a text means: itself, if it is the id of a class; else those of all classes of that name."""
    number = id_of(text, class_names)
    return [k for k, name in class_names.items() if name == text] if number is None else [number]


def class_ids(wanted: Iterable[str], class_names: Mapping[int, str], source: object = "") -> list[int]:
    """Look up classes by id or name: their ids in the order asked for, each once.

    A number is the id of a class where there is one; everything else is a name. Raises `SettingsError`, whose message
    begins with the `source`, if any, where there is no such class, or several have this name.
    """
    ids, where = [], f"{source}: " if source else ""
    for name in wanted:
        meant = meant_by(name, class_names)
        if not meant:
            known = listed(f"{k} ({clipped(known)})" for k, known in class_names.items())
            raise SettingsError(f"{where}class {quoted(name)} does not exist; expected one of {known}")
        if len(meant) > 1:
            found = f"{len(meant)} classes have the name {quoted(name)}"
            raise SettingsError(f"{where}{found}; expected one of their ids, {listed(map(str, meant))}")
        ids += meant
    return list(dict.fromkeys(ids))


def _flaw(name: str) -> str:
    # Cc: control characters; Cs: halves of characters, which no file can hold; Zl, Zp: ends of lines.
    unusable = next((c for c in name if unicodedata.category(c) in ("Cc", "Cs", "Zl", "Zp")), "")
    return f"{quoted(name)}, with the character {unusable!a}; expected one line of text" if unusable else ""
