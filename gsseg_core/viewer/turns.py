"""A lock for what people ask one after the other."""

from __future__ import annotations

import threading
from collections import deque


class Turns:
    """A lock that threads get in the order in which they asked for it; whoever holds it may take it again.

    One of Python's own goes to any that waits. So what was drawn while something took long would come in any order, and
    the last one that is taken back would be another one than the last that was drawn.
    """

    def __init__(self) -> None:
        self._changing = threading.Lock()  # held for a moment, by whoever changes what follows
        self._holder: int | None = None  # the thread, ...
        self._depth = 0  # ... and how often it has taken the lock
        self._waiting: deque[tuple[int, threading.Event]] = deque()  # threads, and what tells them of their turn

    def __enter__(self) -> None:
        """Wait until it is this thread's turn."""
        me, turn = threading.get_ident(), threading.Event()
        with self._changing:
            if self._holder in (None, me):
                self._holder, self._depth = me, self._depth + 1
                return
            self._waiting.append((me, turn))
        try:
            turn.wait()
        except BaseException:  # Ctrl-C; nobody would end this turn.
            with self._changing:
                waits = not turn.is_set()
                if waits:
                    self._waiting.remove((me, turn))
            if not waits:
                self.__exit__()
            raise

    def __exit__(self, *_: object) -> None:
        """Let the next one have it."""
        with self._changing:
            self._depth -= 1
            if self._depth == 0:
                self._holder = None
                if self._waiting:
                    (self._holder, turn), self._depth = self._waiting.popleft(), 1
                    turn.set()

    def held(self) -> bool:
        """Return whether this thread holds it."""
        return self._holder == threading.get_ident()
