"""Text from files and messages, made fit for a terminal."""

from __future__ import annotations

import re

# Sequences that move the cursor, change colours or set titles; then whatever is left of what is no visible text:
# control characters, marks that turn the direction of reading, and halves of characters.
_SEQUENCES = re.compile(r"\x1b\[[0-?]*[ -/]*[@-~]|\x1b\][^\x07\x1b]*(?:\x07|\x1b\\)?|\x1b[@-Z\\-_]")
_UNSEEN = re.compile(r"[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


def printable(text: str) -> str:
    """Return text without what a terminal would obey instead of showing; a question mark stands for each such thing."""
    return _UNSEEN.sub("?", _SEQUENCES.sub("?", text))
