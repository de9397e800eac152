"""Values by stamp, the newest ones, for the inputs that wait for one another."""

from __future__ import annotations

from bisect import bisect_left, insort
from collections.abc import Callable, Collection
from typing import Generic, TypeVar

K = TypeVar("K", int, tuple[int, str])
T = TypeVar("T")


def too_many(sizes: Collection[int], capacity: int, most_bytes: int) -> bool:
    """Whether the oldest of what waits, of these sizes (bytes), has to go; the only one need not, whatever its size."""
    return len(sizes) > capacity or (len(sizes) > 1 and sum(sizes) > most_bytes)


class History(Generic[K, T]):
    """Values by stamp, or by stamp and frame, those of the newest stamps.

    As many are kept as their sizes, 1 each unless `size` says otherwise, add up to the capacity; the newest one
    whatever its size.
    """

    def __init__(self, capacity: int, size: Callable[[T], int] = lambda value: 1) -> None:
        self._capacity, self._size, self._total = capacity, size, 0
        self.stamps: list[K] = []  # ascending
        self.values: dict[K, T] = {}

    def add(self, stamp: K, value: T) -> None:
        """Keep the value of a stamp; of two with the same stamp the first stays."""
        if stamp in self.values:
            return
        insort(self.stamps, stamp)
        self.values[stamp] = value
        self._total += self._size(value)
        while self._total > self._capacity and len(self.stamps) > 1:
            self._total -= self._size(self.values.pop(self.stamps.pop(0)))

    def clear(self, since: K | None = None) -> None:
        """Forget the values, or those from a stamp on."""
        first = 0 if since is None else bisect_left(self.stamps, since)
        for stamp in self.stamps[first:]:
            self._total -= self._size(self.values.pop(stamp))
        del self.stamps[first:]
