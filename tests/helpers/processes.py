"""Which tests start processes: `make check` leaves them out, by the marker `processes`.

A test is found to be one where its code, or that of a fixture or helper that it uses, names a module that starts
processes. What the code under test starts by itself cannot be seen like this: such a test bears the marker itself, and
one that does not fails in `make check` when its process starts.
"""

from __future__ import annotations

import functools
import sys
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import pytest

MARKER = "processes"
STARTERS = {"browser", "children", "distributed", "gsseg_ros.child_nodes", "multiprocessing", "subprocess"}
EVENTS = {"subprocess.Popen", "os.posix_spawn", "os.system", "os.exec"}
HERE = str(Path(__file__).parents[1])
_refused = False  # When Python ends it becomes None, which refuses nothing either.


def mark(items: Iterable[pytest.Item]) -> None:
    """Give the marker to each test that names what starts processes."""
    for item in items:
        if isinstance(item, pytest.Function) and any(starts(function) for function in _functions(item)):
            item.add_marker(MARKER)


def put_first(items: list[pytest.Item]) -> None:
    """Have files begin that start the most processes: they take longest, and nobody is to wait for one at the end."""
    count = Counter(item.path for item in items if item.get_closest_marker(MARKER))
    items.sort(key=lambda item: (-count[item.path], item.path))


@functools.cache
def starts(function: Any) -> bool:
    """Whether a function of the tests, or one of theirs that it calls, names a module that starts processes."""
    waiting: list[Any] = [function]
    seen: set[int] = set()
    named: set[str] = set()
    methods: list[tuple[str, Any]] = []
    while waiting:
        thing = waiting.pop()
        thing = getattr(thing, "__func__", thing)
        if hasattr(thing, "__wrapped__"):
            waiting.append(thing.__wrapped__)
        module = thing.__name__ if isinstance(thing, ModuleType) else getattr(thing, "__module__", None) or ""
        if module in STARTERS or module.split(".")[0] in STARTERS:
            return True
        if id(thing) not in seen:
            seen.add(id(thing))
            if isinstance(thing, type) and _is_of_tests(vars(sys.modules[module])):
                methods += vars(thing).items()
            elif isinstance(thing, FunctionType) and _is_of_tests(thing.__globals__):
                named |= (names := set(_names(thing.__code__)))
                waiting += [thing.__globals__[name] for name in names if name in thing.__globals__]
        if not waiting:  # Of a class, the methods that somebody names.
            waiting = [method for name, method in methods if name in named or name.startswith("__")]
            methods = [(name, method) for name, method in methods if not (name in named or name.startswith("__"))]
    return False


def refuse_events(event: str, arguments: tuple[Any, ...]) -> None:
    """Fail the test that forks, or starts a process though nobody could see that it would: an audit hook of Python."""
    if event in ("os.fork", "os.forkpty"):
        pytest.fail("it forks the process of all tests, whose threads a child lacks: see helpers/clean_process.py")
    if _refused and event in EVENTS and arguments[:1] != ("uname",):  # Of Python's own module platform.
        pytest.fail(f"it starts a process ({event}) and so needs @pytest.mark.{MARKER}: {arguments[:2]}")


def allow(yes: bool) -> None:
    """Say whether the test that runs now may start processes."""
    global _refused
    _refused = not yes


def _functions(item: pytest.Function) -> Iterator[Any]:
    yield item.function
    for definitions in item._fixtureinfo.name2fixturedefs.values():
        yield definitions[-1].func


def _names(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


def _is_of_tests(names: dict[str, Any]) -> bool:
    return str(names.get("__file__", "")).startswith(HERE)
