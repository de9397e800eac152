"""Undoes operations that fail half-way, whatever stops them: an error, Ctrl-C or too little memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

Undo = Callable[[], object]


def checkpoint(thing: object, ending: str = "", /, **copies: Any) -> Undo:
    """Return a function that restores the attributes that end with `ending`; pass `copies` of mutable ones."""
    attributes = vars(thing)
    before = {**{name: value for name, value in attributes.items() if name.endswith(ending)}, **copies}

    def undo() -> None:  # Must need almost no memory, because there may be none left.
        for name in [name for name in attributes if name.endswith(ending) and name not in before]:
            del attributes[name]
        attributes.update(before)

    return undo


@contextmanager
def all_or_nothing(*undo: Undo) -> Iterator[None]:
    """Call the `undo` functions in order if the body raises anything."""
    try:
        yield
    except BaseException:
        for step in undo:
            step()
        raise


def fits_whole(fit: Callable[P, R]) -> Callable[P, R]:
    """Decorate a `fit` so that an error half-way restores all attributes that end with "_" to those from before."""

    @wraps(fit)
    def whole(*args: P.args, **kwargs: P.kwargs) -> R:
        with all_or_nothing(checkpoint(args[0], "_")):
            return fit(*args, **kwargs)

    return whole
