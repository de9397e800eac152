"""Names of classes as parts of topic names."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping

_LONGEST_TOKEN = 64  # The full name of a topic must stay below 256 characters.


def topic_tokens(class_names: Mapping[int, str]) -> dict[int, str]:
    """Turn class names into unique parts of topic names: ASCII letters, digits and single underscores.

    Where classes would get the same token, that of the lowest id keeps it and the others get `_<id>` appended.
    """
    owners: dict[str, int] = {}
    for number, name in sorted(class_names.items()):
        token = _token(name, number)
        while token in owners:
            token = f"{token}_{number}"
        owners[token] = number
    return {number: token for token, number in owners.items()}


def _token(name: str, number: int) -> str:
    ascii_name = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    token = re.sub(r"[^A-Za-z0-9]+", "_", ascii_name)[:_LONGEST_TOKEN].strip("_")
    if not token:
        return f"class_{number}"
    return f"class_{token}" if token[0].isdigit() else token
