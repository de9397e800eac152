"""JSON files as they come from users."""

from __future__ import annotations

import json
from pathlib import Path

from gsseg_core.errors import GssegError

_KINDS = {
    dict: "an object", list: "a list", str: "text", bool: "true or false", int: "a number", float: "a number",
    type(None): "null",
}  # fmt: skip


def kind_of(content: object) -> str:
    """Name the kind of something read from a JSON file, in the words of JSON."""
    return _KINDS[type(content)]


def read_json(path: Path, error: type[GssegError]) -> object:
    """Read a JSON file; raise `error` with one clear line if it is missing or broken."""
    try:
        # Editors on Windows write a byte order mark, which "utf-8" would hand to the parser.
        return json.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as cause:
        raise error(f"{path}: cannot be read ({cause.strerror or cause})") from cause
    except (ValueError, RecursionError) as cause:
        raise error(f"{path}: not valid JSON ({cause})") from cause
