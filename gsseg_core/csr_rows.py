"""Sparse (N, K) arrays in compressed rows: of K classes, a Gaussian has votes for a few."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numba as nb
import numpy as np
import numpy.typing as npt

from gsseg_core.kernels.compiler import kernel
from gsseg_core.simd import AHEAD, prefetch

_NONE = np.uint32(2**32 - 1)
_AT_A_TIME = 1 << 22  # entries, zeros among them, of rows that are written out in full at a time


class CSRRows(NamedTuple):
    """A sparse (N, K) array in compressed rows, as SciPy's `csr_array`, with kernels that use all cores."""

    indptr: np.ndarray  # (N + 1,) int64: entries of row i are indptr[i] to indptr[i + 1]
    indices: np.ndarray  # (Z,) uint32: column of each entry, ascending in a row
    data: np.ndarray  # (Z,): the entries; arrays of one pattern share `indptr` and `indices`

    @classmethod
    def from_dense(cls, array: np.ndarray) -> CSRRows:  # (N, K)
        """Keep the entries that are not zero."""
        array = np.ascontiguousarray(array)
        counts = np.empty(len(array), np.int64)
        _count(array, counts)
        rows = cls.room_for(counts, array.dtype)
        _fill(array, rows)
        return rows

    @classmethod
    def empty(cls, num_rows: int, dtype: npt.DTypeLike = np.float32) -> CSRRows:
        """Make rows without entries."""
        return cls(np.zeros(num_rows + 1, np.int64), np.empty(0, np.uint32), np.empty(0, dtype))

    @classmethod
    def room_for(cls, counts: np.ndarray, dtype: npt.DTypeLike) -> CSRRows:  # (N,)
        """Make rows of so many entries each, with nothing written into them."""
        indptr = starts(counts)
        return cls(indptr, np.empty(indptr[-1], np.uint32), np.empty(indptr[-1], dtype))

    @classmethod
    def vstack(cls, parts: Sequence[CSRRows]) -> CSRRows:  # at least one
        """Stack rows below each other."""
        indptrs, indices, data = zip(*parts, strict=True)
        lengths = np.concatenate([np.diff(indptr) for indptr in indptrs])
        return cls(starts(lengths), np.concatenate(indices), np.concatenate(data))

    @property
    def num_rows(self) -> int:
        """N."""
        return len(self.indptr) - 1

    @property
    def rows(self) -> np.ndarray:
        """Row of each entry, (Z,) int64."""
        return np.repeat(np.arange(self.num_rows), np.diff(self.indptr))

    def with_data(self, data: np.ndarray) -> CSRRows:
        """Replace the entries and keep where they stand."""
        return self._replace(data=data)

    def dense(self, num_classes: int) -> np.ndarray:
        """Return the array with its zeros, (N, K)."""
        return self._written(slice(0, self.num_rows), num_classes)

    def blocks(self, num_classes: int) -> Iterator[np.ndarray]:
        """Give the array with its zeros, (N, K), some rows after the other: it need not be in memory as a whole."""
        for some in slices(self.num_rows, num_classes):
            yield self._written(some, num_classes)

    def _written(self, some: slice, num_classes: int) -> np.ndarray:
        out = np.zeros((some.stop - some.start, num_classes), self.data.dtype)
        _write(self._replace(indptr=self.indptr[some.start : some.stop + 1]), out)
        return out

    def united(self, other: CSRRows) -> tuple[CSRRows, CSRRows]:
        """Give two arrays the union of their patterns, filled up with explicit zeros."""
        counts = np.empty(self.num_rows, np.int64)
        _count_united(self, other, counts)
        united = CSRRows.room_for(counts, self.data.dtype)
        united_other = united.with_data(np.empty(len(united.data), other.data.dtype))
        _unite(self, other, united, united_other.data)
        return united, united_other

    def plus(self, other: CSRRows) -> CSRRows:
        """Add two arrays; sums of zero are entries still."""
        one, two = self.united(other)
        return one.with_data(one.data + two.data)

    def normalised(self) -> CSRRows:
        """Scale each row of float32 to sum 1, in place; rows of zeros stay zero."""
        _normalise(self)
        return self

    def sums(self) -> np.ndarray:
        """Sum of each row of whole numbers, (N,) int64."""
        ends = starts(self.data)[self.indptr]
        return np.asarray(ends[1:] - ends[:-1])

    def known(self) -> np.ndarray:
        """Tell which rows of float32 have an entry above zero, (N,) bool."""
        return np.asarray(largest(self)[0] > 0)

    def has_column(self, column: int) -> bool:
        """Tell whether any row has an entry there."""
        return bool((self.indices == column).any())

    def nonzero(self) -> CSRRows:
        """Drop entries that have become zero."""
        return self.entries(self.data != 0)

    def entries(self, kept: np.ndarray) -> CSRRows:  # (Z,) bool
        """Copy the array with some of its entries alone."""
        return CSRRows(starts(kept)[self.indptr], self.indices[kept], self.data[kept])

    def take(self, ids: np.ndarray) -> CSRRows:  # (M,)
        """Copy some rows: M of them."""
        rows = CSRRows.room_for(np.diff(self.indptr)[ids], self.data.dtype)
        _copy_rows(self, ids, self, rows)
        return rows

    def replaced(self, rows: np.ndarray, others: CSRRows) -> CSRRows:  # (N,) int64
        """Copy the array with rows of another one in place of some: `rows` says which for each, -1 for its own."""
        lengths = np.diff(self.indptr)
        taken = np.flatnonzero(rows >= 0)
        lengths[taken] = np.diff(others.indptr)[rows[taken]]
        made = CSRRows.room_for(lengths, self.data.dtype)
        _copy_rows(self, rows, others, made)
        return made

    def replaced_at(self, ids: np.ndarray, others: CSRRows) -> CSRRows:  # (M,) distinct; M rows
        """Copy the array with rows of another one in place of some."""
        rows = np.full(self.num_rows, -1)
        rows[ids] = np.arange(len(ids))
        return self.replaced(rows, others)

    def only(self, kept: np.ndarray) -> CSRRows:  # (N,) bool
        """Copy the array without the entries of some rows."""
        return self.replaced(np.where(kept, -1, 0), CSRRows.empty(1, self.data.dtype))

    def in_columns(self, columns: np.ndarray) -> CSRRows:  # (Z,) uint32
        """Move each entry to another column of its row; those that meet in one are added up."""
        moved = CSRRows(self.indptr, columns.astype(np.uint32), self.data.copy())
        lengths = np.empty(self.num_rows, np.int64)
        _sort_and_add(moved, lengths)
        made = CSRRows.room_for(lengths, self.data.dtype)
        _copy_rows(moved, np.arange(self.num_rows), moved, made)
        return made

    def with_rows(self, ids: np.ndarray, rows: CSRRows) -> CSRRows:  # (M,) distinct; M rows of the same pattern
        """Copy the array with other entries in some of its rows."""
        replaced = self.with_data(self.data.copy())
        _put(replaced, ids, rows)
        return replaced


def slices(num_rows: int, num_classes: int) -> Iterator[slice]:
    """Cut (N, K) into slices of rows of which one with all its zeros takes little memory."""
    step = max(_AT_A_TIME // max(num_classes, 1), 1)
    for first in range(0, num_rows, step):
        yield slice(first, min(first + step, num_rows))


def starts(counts: np.ndarray) -> np.ndarray:  # (n,)
    """Return the offset at which each of n consecutive parts begins, and the end of the last: (n + 1,) int64."""
    return np.concatenate([[0], np.cumsum(counts)])


@kernel(parallel=True)
def largest(rows: CSRRows) -> tuple[np.ndarray, np.ndarray]:  # float32
    """Find the largest entry of each row, (N,) float32, and its column, (N,) int32: the first of equal ones.

    0 and column -1 where no entry is above 0.
    """
    indptr, indices, data = rows
    entries, columns = np.empty(indptr.shape[0] - 1, np.float32), np.empty(indptr.shape[0] - 1, np.int32)
    for i in nb.prange(indptr.shape[0] - 1):
        most, column = np.float32(0), np.int32(-1)
        for z in range(indptr[i], indptr[i + 1]):
            if data[z] > most:
                most, column = data[z], np.int32(indices[z])
        entries[i], columns[i] = most, column
    return entries, columns


@kernel(parallel=True)
def _count(array: np.ndarray, counts: np.ndarray) -> None:
    for i in nb.prange(array.shape[0]):
        n = 0
        for k in range(array.shape[1]):
            n += array[i, k] != 0
        counts[i] = n


@kernel(parallel=True)
def _fill(array: np.ndarray, rows: CSRRows) -> None:
    indptr, indices, data = rows
    for i in nb.prange(array.shape[0]):
        z = indptr[i]
        if z < indptr[i + 1]:
            for k in range(array.shape[1]):
                if array[i, k] != 0:
                    indices[z], data[z] = k, array[i, k]
                    z += 1


@kernel(parallel=True)
def _write(rows: CSRRows, out: np.ndarray) -> None:
    indptr, indices, data = rows
    for i in nb.prange(out.shape[0]):
        for z in range(indptr[i], indptr[i + 1]):
            out[i, indices[z]] = data[z]


@kernel(parallel=True)
def _normalise(rows: CSRRows) -> None:
    indptr, _, data = rows
    for i in nb.prange(indptr.shape[0] - 1):
        total = np.float32(0.0)
        for z in range(indptr[i], indptr[i + 1]):
            total += data[z]
        if total > 0:
            for z in range(indptr[i], indptr[i + 1]):
                data[z] /= total


@kernel(parallel=True)
def _copy_rows(rows: CSRRows, which: np.ndarray, others: CSRRows, made: CSRRows) -> None:
    """Copy into each row, as far as it reaches, the one of some others that `which` says, or at -1 its own."""
    indptr, indices, data = rows
    other_indptr, other_indices, other_data = others
    made_indptr, made_indices, made_data = made
    last = which.shape[0] - 1
    for i in nb.prange(which.shape[0]):
        # Others are anywhere in memory: they are asked for before they are needed.
        prefetch(other_indptr, max(which[min(i + 2 * AHEAD, last)], 0))
        begin = other_indptr[max(which[min(i + AHEAD, last)], 0)]
        prefetch(other_indices, begin)
        prefetch(other_data, begin)
        first = indptr[i] if which[i] < 0 else other_indptr[which[i]]
        for j in range(made_indptr[i + 1] - made_indptr[i]):
            z = made_indptr[i] + j
            if which[i] < 0:
                made_indices[z], made_data[z] = indices[first + j], data[first + j]
            else:
                made_indices[z], made_data[z] = other_indices[first + j], other_data[first + j]


@kernel(parallel=True)
def _sort_and_add(rows: CSRRows, lengths: np.ndarray) -> None:
    """Sort each row by column, add up what has the same, and tell how many entries are left at its beginning."""
    indptr, indices, data = rows
    for i in nb.prange(indptr.shape[0] - 1):
        first, left = indptr[i], indptr[i]
        for z in range(first, indptr[i + 1]):
            column, entry, place = indices[z], data[z], left
            while place > first and indices[place - 1] > column:
                place -= 1
            if place > first and indices[place - 1] == column:
                data[place - 1] += entry
                continue
            for y in range(left, place, -1):
                indices[y], data[y] = indices[y - 1], data[y - 1]
            indices[place], data[place] = column, entry
            left += 1
        lengths[i] = left - first


@kernel(parallel=True)
def _put(rows: CSRRows, ids: np.ndarray, others: CSRRows) -> None:
    indptr, _, data = rows
    other_indptr, _, other_data = others
    for m in nb.prange(ids.shape[0]):
        first = indptr[ids[m]]
        for j in range(other_indptr[m + 1] - other_indptr[m]):
            data[first + j] = other_data[other_indptr[m] + j]


@kernel(parallel=True)
def _count_united(one: CSRRows, other: CSRRows, counts: np.ndarray) -> None:
    indptr, indices, _ = one
    other_indptr, other_indices, _ = other
    for i in nb.prange(counts.shape[0]):
        a, b, n = indptr[i], other_indptr[i], 0
        while a < indptr[i + 1] or b < other_indptr[i + 1]:
            first = indices[a] if a < indptr[i + 1] else _NONE
            second = other_indices[b] if b < other_indptr[i + 1] else _NONE
            a += first <= second
            b += second <= first
            n += 1
        counts[i] = n


@kernel(parallel=True)
def _unite(one: CSRRows, other: CSRRows, united: CSRRows, united_other: np.ndarray) -> None:
    indptr, indices, data = one
    other_indptr, other_indices, other_data = other
    united_indptr, united_indices, united_data = united
    for i in nb.prange(indptr.shape[0] - 1):
        a, b = indptr[i], other_indptr[i]
        for z in range(united_indptr[i], united_indptr[i + 1]):
            first = indices[a] if a < indptr[i + 1] else _NONE
            second = other_indices[b] if b < other_indptr[i + 1] else _NONE
            united_indices[z] = min(first, second)
            united_data[z] = data[a] if first <= second else 0
            united_other[z] = other_data[b] if second <= first else 0
            a += first <= second
            b += second <= first
