"""Names of the views that masks become: put together of where and when a mask came from, and read again."""

from __future__ import annotations

import re
from typing import NamedTuple

CAMERAS_KEPT = 16
"""How many cameras may have masks of one stamp under one topic."""

_NUMBERS = "|".join(map(str, range(2, CAMERAS_KEPT + 1)))
_NAME = re.compile(rf"([^_]+)_(?:(.+?)_)??([0-9]+)_([0-9]+)(?:_({_NUMBERS}))?")  # `.+?`: names of cameras have _, too.


class ViewName(NamedTuple):
    """Where and when the mask of a view came from, as texts; joined, they are its name, which no other view has."""

    activation: str  # of the node, by a token: stamps repeat, and views of another one may come with a saved state
    camera: str  # what its topics begin with; empty for the only one
    epoch: str  # how often time had been set back since this activation
    stamp: str  # ns
    number: str = ""  # of its camera among those with masks of this stamp under one topic; empty for the first

    @classmethod
    def of(cls, name: str) -> ViewName | None:
        """Read the name of a view; None if it is of no mask that came as a message."""
        parts = _NAME.fullmatch(name)
        return None if parts is None else cls(*parts.groups(""))

    def __str__(self) -> str:
        """Put the name together."""
        return "_".join(filter(None, self))
