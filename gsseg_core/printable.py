"""Text of others, such as names from files: made harmless where it is shown, on terminals and on pages."""

from __future__ import annotations

import unicodedata
from html import escape

_JOINERS = "\u200c\u200d"
"""They change how their neighbours are written, as in Persian and in emoji, and nothing else."""


def printable(text: str) -> str:
    r"""Return a text on one line, in which every character that steers or hides is seen as its escape.

    What a terminal obeys (ANSI sequences, backspaces, line ends), what turns the reading direction around, what is
    invisible, and halves of surrogate pairs, as in file names that are no UTF-8, become what Python writes for them:
    `\x1b`, `\u202e`, `\udcff`. The result can be encoded. Letters, marks, emoji and spaces of all languages stay.

    Parameters
    ----------
    text : str
        Of any origin.
    """
    if text.isprintable():
        return text
    return "".join(c if _stays(c) else c.encode("unicode_escape").decode("ascii") for c in text)


def clipped(value: object, most: int = 80) -> str:
    """Give a foreign name or value as it goes into a message or a table: printable, and not long."""
    text = str(value)
    return printable(text if len(text) <= most else text[: most - 3] + "...")


def quoted(value: object) -> str:
    """Give a foreign value as Python writes it, in quotes if it is text, as it goes into a message."""
    return clipped(repr(value))


def html_text(value: object) -> str:
    """Make anything harmless between tags and in quoted attributes: `printable`, without markup."""
    return escape(printable(str(value)))


def _stays(character: str) -> bool:
    return character.isprintable() or character in _JOINERS or unicodedata.category(character) == "Zs"
