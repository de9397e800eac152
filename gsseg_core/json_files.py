"""JSON files as they come from users."""

from __future__ import annotations

import json
from pathlib import Path

from gsseg_core.confined_files import open_input
from gsseg_core.errors import GssegError

_KINDS = {
    dict: "an object", list: "a list", str: "text", bool: "true or false", int: "a number", float: "a number",
    type(None): "null",
}  # fmt: skip


def kind_of(content: object) -> str:
    """Name the kind of something read from a JSON file, in the words of JSON."""
    return _KINDS[type(content)]


def read_json(path: Path, error: type[GssegError], within: Path | None = None) -> object:
    """Read a JSON file, below `within` if given; raise `error` with one clear line if it is missing or broken."""
    try:
        # Editors on Windows write a byte order mark, which "utf-8" would hand to the parser.
        with open_input(path, within) as file:
            return json.loads(file.read().decode("utf-8-sig"))
    except OSError as cause:
        raise error(f"{path}: cannot be read ({cause.strerror or cause})") from cause
    except (ValueError, RecursionError) as cause:
        raise error(f"{path}: not valid JSON ({cause})") from cause
