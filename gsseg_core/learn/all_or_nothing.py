"""What is done whole or not at all: whatever ends it half-way, Ctrl-C or too little memory too, it is undone."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

Undo = Callable[[], object]


def checkpoint(thing: object, ending: str = "", /, **copies: Any) -> Undo:
    """Return what gives an object the attributes back that end so; `copies` are of those that change in place."""
    attributes = vars(thing)
    before = {**{name: value for name, value in attributes.items() if name.endswith(ending)}, **copies}

    def undo() -> None:  # It takes no memory to speak of: there may be none.
        for name in [name for name in attributes if name.endswith(ending) and name not in before]:
            del attributes[name]
        attributes.update(before)

    return undo


@contextmanager
def all_or_nothing(*undo: Undo) -> Iterator[None]:
    """Undo what the body has done, one after the other, if it raises anything."""
    try:
        yield
    except BaseException:
        for step in undo:
            step()
        raise


def fits_whole(fit: Callable[P, R]) -> Callable[P, R]:
    """Decorate a `fit`: if an error ends it half-way, all attributes that end with "_" are those of an earlier one."""

    @wraps(fit)
    def whole(*args: P.args, **kwargs: P.kwargs) -> R:
        with all_or_nothing(checkpoint(args[0], "_")):
            return fit(*args, **kwargs)

    return whole
