"""Codes without their zeros: of K classes, a Gaussian has votes for a few, and so have those around it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numba as nb
import numpy as np

_NONE = np.uint32(2**32 - 1)


class Rows(NamedTuple):
    """Entries of an (N, K) array, row by row; all others are zero. What several of them share, they hold in common.

    Attributes
    ----------
    start : (N + 1,) int64
        Entries of row i are start[i] to start[i + 1].
    classes : (Z,) uint32
        Column of each entry, ascending in a row.
    values : (Z,)
        The entries.
    """

    start: np.ndarray
    classes: np.ndarray
    values: np.ndarray

    @classmethod
    def of(
        cls,
        array: np.ndarray,  # (N, K)
    ) -> Rows:
        """Keep the entries that are not zero."""
        array = np.ascontiguousarray(array)
        start = np.zeros(len(array) + 1, np.int64)
        _count(array, start[1:])
        np.cumsum(start, out=start)
        rows = cls(start, np.empty(start[-1], np.uint32), np.empty(start[-1], array.dtype))
        _fill(array, *rows)
        return rows

    @classmethod
    def joined(
        cls,
        parts: Sequence[Rows],  # at least one
    ) -> Rows:
        """Put rows below each other."""
        lengths = np.concatenate([np.diff(part.start) for part in parts])
        return cls(
            starts(lengths),
            np.concatenate([part.classes for part in parts]),
            np.concatenate([part.values for part in parts]),
        )

    def with_values(self, values: np.ndarray) -> Rows:
        """Have other entries in the same places."""
        return self._replace(values=values)

    def dense(self, num_classes: int) -> np.ndarray:
        """Write out, zeros and all: (N, K)."""
        out = np.zeros((len(self.start) - 1, num_classes), self.values.dtype)
        self.write(out)
        return out

    def write(
        self,
        out: np.ndarray,  # (N, K)
    ) -> None:
        """Write the entries into an array, and leave the rest of it as it is."""
        _write(*self, out)

    def united(self, other: Rows) -> tuple[Rows, Rows]:
        """Give both the places of either, filled up with zeros."""
        start = np.zeros_like(self.start)
        _count_united(self.start, self.classes, other.start, other.classes, start[1:])
        np.cumsum(start, out=start)
        classes = np.empty(start[-1], np.uint32)
        values = np.empty(start[-1], self.values.dtype), np.empty(start[-1], other.values.dtype)
        _unite(*self, *other, start, classes, *values)
        return Rows(start, classes, values[0]), Rows(start, classes, values[1])

    def moved(
        self,
        ids: np.ndarray,  # (N,) distinct
        count: int,
    ) -> Rows:
        """Make row ids[i], of `count` rows, of row i; the others have no entries."""
        source = np.full(count, -1, np.int64)
        source[ids] = np.arange(len(ids))
        start = np.zeros(count + 1, np.int64)
        start[1:][ids] = np.diff(self.start)
        np.cumsum(start, out=start)
        _, classes, values = self.take(source[source >= 0])
        return Rows(start, classes, values)

    def normalised(self) -> Rows:
        """Scale each row of float32 to sum 1, in place; rows of zeros stay zero."""
        _normalise(self.start, self.values)
        return self

    def nonzero(self) -> Rows:
        """Leave out entries that have become zero."""
        kept = self.values != 0
        return Rows(starts(kept)[self.start], self.classes[kept], self.values[kept])

    def take(
        self,
        ids: np.ndarray,  # (M,)
    ) -> Rows:
        """Copy some rows: M of them."""
        start = starts((self.start[1:] - self.start[:-1])[ids])
        rows = Rows(start, np.empty(start[-1], np.uint32), np.empty(start[-1], self.values.dtype))
        _take(*self, ids, *rows)
        return rows

    def places(
        self,
        ids: np.ndarray,  # (M,)
    ) -> Rows:
        """Of some rows, where in `values` their entries stand, as values: (Z',) int64."""
        lengths = (self.start[1:] - self.start[:-1])[ids]
        start = starts(lengths)
        places = np.empty(start[-1], np.int64)
        _place(self.start, ids, start, places)
        return Rows(start, self.classes[places], places)


def starts(
    counts: np.ndarray,  # (n,)
) -> np.ndarray:
    """Tell where each of several parts begins, and the last one ends: (n + 1,) int64."""
    return np.concatenate([[0], np.cumsum(counts)])


@nb.njit(parallel=True, nogil=True, cache=True)
def largest(
    array: np.ndarray,  # (N, K) float32
) -> tuple[np.ndarray, np.ndarray]:
    """Find the largest entry of each row, (N,) float32, and its column, (N,) int32: the first of equal ones.

    0 and column -1 where no entry is above 0.
    """
    entries, columns = np.empty(array.shape[0], np.float32), np.empty(array.shape[0], np.int32)
    for i in nb.prange(array.shape[0]):
        most, column = np.float32(0), np.int32(-1)
        for k in range(array.shape[1]):
            if array[i, k] > most:
                most, column = array[i, k], np.int32(k)
        entries[i], columns[i] = most, column
    return entries, columns


@nb.njit(parallel=True, nogil=True, cache=True)
def _count(array: np.ndarray, counts: np.ndarray) -> None:
    for i in nb.prange(array.shape[0]):
        n = 0
        for k in range(array.shape[1]):
            n += array[i, k] != 0
        counts[i] = n


@nb.njit(parallel=True, nogil=True, cache=True)
def _fill(array: np.ndarray, start: np.ndarray, classes: np.ndarray, values: np.ndarray) -> None:
    for i in nb.prange(array.shape[0]):
        z = start[i]
        if z < start[i + 1]:
            for k in range(array.shape[1]):
                if array[i, k] != 0:
                    classes[z], values[z] = k, array[i, k]
                    z += 1


@nb.njit(parallel=True, nogil=True, cache=True)
def _write(start: np.ndarray, classes: np.ndarray, values: np.ndarray, out: np.ndarray) -> None:
    for i in nb.prange(out.shape[0]):
        for z in range(start[i], start[i + 1]):
            out[i, classes[z]] = values[z]


@nb.njit(parallel=True, nogil=True, cache=True)
def _normalise(start: np.ndarray, values: np.ndarray) -> None:
    for i in nb.prange(start.shape[0] - 1):
        total = np.float32(0.0)
        for z in range(start[i], start[i + 1]):
            total += values[z]
        if total > 0:
            for z in range(start[i], start[i + 1]):
                values[z] /= total


@nb.njit(parallel=True, nogil=True, cache=True)
def _take(
    start: np.ndarray,
    classes: np.ndarray,
    values: np.ndarray,
    ids: np.ndarray,
    taken_start: np.ndarray,
    taken_classes: np.ndarray,
    taken: np.ndarray,
) -> None:
    for m in nb.prange(ids.shape[0]):
        first = start[ids[m]]
        for j in range(taken_start[m + 1] - taken_start[m]):
            taken_classes[taken_start[m] + j], taken[taken_start[m] + j] = classes[first + j], values[first + j]


@nb.njit(parallel=True, nogil=True, cache=True)
def _place(start: np.ndarray, ids: np.ndarray, part_start: np.ndarray, places: np.ndarray) -> None:
    for m in nb.prange(ids.shape[0]):
        for j in range(part_start[m + 1] - part_start[m]):
            places[part_start[m] + j] = start[ids[m]] + j


@nb.njit(parallel=True, nogil=True, cache=True)
def _count_united(
    start: np.ndarray, classes: np.ndarray, other_start: np.ndarray, other_classes: np.ndarray, counts: np.ndarray
) -> None:
    for i in nb.prange(counts.shape[0]):
        a, b, n = start[i], other_start[i], 0
        while a < start[i + 1] or b < other_start[i + 1]:
            first = classes[a] if a < start[i + 1] else _NONE
            second = other_classes[b] if b < other_start[i + 1] else _NONE
            a += first <= second
            b += second <= first
            n += 1
        counts[i] = n


@nb.njit(parallel=True, nogil=True, cache=True)
def _unite(
    start: np.ndarray,
    classes: np.ndarray,
    values: np.ndarray,
    other_start: np.ndarray,
    other_classes: np.ndarray,
    other_values: np.ndarray,
    united_start: np.ndarray,
    united_classes: np.ndarray,
    united_values: np.ndarray,
    united_other: np.ndarray,
) -> None:
    for i in nb.prange(start.shape[0] - 1):
        a, b = start[i], other_start[i]
        for z in range(united_start[i], united_start[i + 1]):
            first = classes[a] if a < start[i + 1] else _NONE
            second = other_classes[b] if b < other_start[i + 1] else _NONE
            united_classes[z] = min(first, second)
            united_values[z] = values[a] if first <= second else 0
            united_other[z] = other_values[b] if second <= first else 0
            a += first <= second
            b += second <= first
