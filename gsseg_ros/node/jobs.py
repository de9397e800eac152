"""Runs long work: a thread that fuses views, a slot for jobs that exclude each other, turns for requests."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Generic, TypeVar

from gsseg_ros.errors import BusyError, CanceledError
from gsseg_ros.node.history import too_many

T = TypeVar("T")

END_SECONDS = 5.0
"""How long the end of a thread is waited for, at most."""


class Job:
    """A job that can be asked to stop."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._canceled = threading.Event()

    def cancel(self) -> None:
        """Ask it to stop."""
        self._canceled.set()

    def check(self) -> None:
        """Stop here if that was asked. Raises `CanceledError`: it was."""
        if self._canceled.is_set():
            raise CanceledError(f"{self.name} was canceled; what was known before is kept")


class JobSlot:
    """Holds one job at a time: learning, or whatever replaces the scene or its state."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._job: Job | None = None

    @contextmanager
    def take(self, name: str) -> Iterator[Job]:
        """Run a job in the body. Raises `BusyError`: another one is running."""
        with self._changed:
            if self._job is not None:
                raise BusyError(f"{self._job.name} is running; expected to start {name} after it: cancel it, or wait")
            job = self._job = Job(name)
        try:
            yield job
        finally:
            with self._changed:
                self._job = None
                self._changed.notify_all()

    @property
    def busy(self) -> bool:
        """Whether a job runs."""
        return self._job is not None

    def cancel(self, timeout_s: float) -> bool:
        """Ask the running job to stop, and wait for that; return whether the slot is free."""
        with self._changed:
            if self._job is not None:
                self._job.cancel()
            return self._changed.wait_for(lambda: self._job is None, timeout_s)


class Requests:
    """Counts the requests at work, so that a lifecycle transition can wait for their end."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._count = 0

    @contextmanager
    def one(self) -> Iterator[None]:
        """Count the body as one request."""
        with self._changed:
            self._count += 1
        try:
            yield
        finally:
            with self._changed:
                self._count -= 1
                self._changed.notify_all()

    def drained(self, timeout_s: float) -> bool:
        """Wait until none is at work; return whether it came to that in time."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._count, timeout_s)


class Turns:
    """Lets so many requests be at work at a time, and so many more wait for their turn; each holds a thread."""

    def __init__(self, at_work: int, waiting: int) -> None:
        self._places, self._turns = threading.Semaphore(at_work + waiting), threading.Semaphore(at_work)

    @contextmanager
    def take(self, name: str) -> Iterator[None]:
        """Wait for a turn, and work in the body.

        Raises `BusyError`: as many as may already wait; this is found at once.
        """
        if not self._places.acquire(blocking=False):
            raise BusyError(f"{name}: too many requests are at work or wait already; expected to be asked again later")
        try:
            with self._turns:
                yield
        finally:
            self._places.release()

    def await_place(self) -> None:
        """Wait until one more may wait; another one may be faster to do so."""
        with self._places:
            pass


class Worker(Generic[T]):
    """Handles items one after the other, in a thread of its own; of too many that wait, the oldest are dropped.

    `handle` must not raise. Of those that wait there are `capacity` at most, with `most_bytes` by `size` together; one
    may wait whatever its size.
    """

    def __init__(self, handle: Callable[[T], None], capacity: int, size: Callable[[T], int], most_bytes: int) -> None:
        self.dropped = 0  # items
        self._handle, self._capacity, self._size, self._most_bytes = handle, capacity, size, most_bytes
        self._items: deque[T] = deque()
        self._in_hand: list[T] = []
        self._changed = threading.Condition()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="fusion", daemon=True)
        self._thread.start()

    def submit(self, item: T) -> None:
        """Add an item; returns at once."""
        with self._changed:
            self._items.append(item)
            while too_many(list(map(self._size, self._items)), self._capacity, self._most_bytes):
                self._items.popleft()
                self.dropped += 1
            self._changed.notify()

    @property
    def waiting(self) -> int:
        """Number of items that wait."""
        return len(self._items)

    @property
    def unfinished(self) -> list[T]:
        """The items that wait, and that in hand."""
        with self._changed:
            return [*self._in_hand, *self._items]

    def clear(self) -> int:
        """Forget the items that wait; return how many they were."""
        with self._changed:
            forgotten = len(self._items)
            self._items.clear()
            return forgotten

    def stop(self) -> None:
        """Finish the item in hand, and end."""
        with self._changed:
            self._stopping = True
            self._items.clear()
            self._changed.notify()
        self._thread.join(END_SECONDS)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._items or self._stopping)
                if self._stopping:
                    return
                self._in_hand = [item := self._items.popleft()]
            self._handle(item)
            with self._changed:
                self._in_hand = []
