"""Fitting that is all or nothing: an error half-way leaves learnt attributes, those that end with "_", as they were."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")


def all_or_nothing(fit: Callable[P, R]) -> Callable[P, R]:
    """Decorate a `fit`: if an error ends it half-way, all attributes that end with "_" are those of an earlier one."""

    @wraps(fit)
    def whole(*args: P.args, **kwargs: P.kwargs) -> R:
        attributes = vars(args[0])
        before = {name: value for name, value in attributes.items() if name.endswith("_")}
        try:
            return fit(*args, **kwargs)
        except BaseException:  # Ctrl-C in a notebook, too.
            for name in [name for name in attributes if name.endswith("_") and name not in before]:
                del attributes[name]
            attributes.update(before)
            raise

    return whole
