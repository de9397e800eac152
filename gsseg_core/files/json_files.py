"""JSON files as they come from users."""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from gsseg_core.errors import GssegError
from gsseg_core.files.atomic import write_atomically
from gsseg_core.files.input_files import UnfitError, read_input
from gsseg_core.text import clipped, quoted

_KINDS = {
    dict: "an object", list: "a list", str: "text", bool: "true or false", int: "a number", float: "a number",
    type(None): "null",
}  # fmt: skip


def read_json(path: Path, error: type[GssegError], within: Path | None = None) -> object:
    """Read a JSON file, below `within` if given; raise `error` if it is missing, broken, or larger than any is.

    An object with a key twice is broken: of two names that somebody gave a class, JSON's parser would keep the last.
    """
    content = read_input(path, error, within)
    try:
        # Editors on Windows write a byte order mark, which "utf-8" would hand to the parser.
        return json.loads(content.decode("utf-8-sig"), object_pairs_hook=_with_each_key_once)
    except (ValueError, RecursionError) as cause:
        raise error(f"{path}: not valid JSON ({clipped(cause, 160)})") from cause


def _with_each_key_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    made = dict(pairs)
    if len(made) < len(pairs):
        twice = next(key for key, count in Counter(key for key, _ in pairs).items() if count > 1)
        raise ValueError(f"{quoted(twice)} stands more than once in an object")
    return made


def read_object(path: Path, error: type[GssegError], expected: str, within: Path | None = None) -> dict[str, Any]:
    """Read a JSON file, as `read_json`, that must hold an object: `expected`, in messages."""
    content = read_json(path, error, within)
    if not isinstance(content, dict):
        raise error(f"{path}: holds {kind_of(content)}; expected {expected}")
    return content


@dataclass(frozen=True)
class JsonObject:
    """A JSON object of a file; messages about its fields begin with `where` it stands."""

    error: ClassVar[type[GssegError]]  # raised where a field is missing, or is something else than is expected

    where: str
    fields: Mapping[str, Any]

    def value(self, key: str) -> Any:
        """Read a field."""
        if key not in self.fields:
            raise self.error(f"{self.where}: lacks '{key}' (has {clipped(', '.join(self.fields)) or 'nothing'})")
        return self.fields[key]


def kind_of(content: object) -> str:
    """Name what a JSON file holds, in the words of JSON."""
    return _KINDS[type(content)]


def whole_number(value: object, what: str, least: int, most: int) -> int:
    """Check a number of a JSON header; `UnfitError` unless it is whole, and from `least` to `most`."""
    if type(value) is not int or not least <= value <= most:
        raise UnfitError(f"{what} is {quoted(value)}; expected a whole number from {least} to {most}")
    return value


def write_json(path: str | os.PathLike[str], content: object) -> None:
    """Write JSON atomically."""
    with write_atomically(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
