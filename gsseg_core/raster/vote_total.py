"""The votes of all views: of many classes, neighbours in space have votes for a few, and only those are kept.

A *page* has the votes for one class of `PAGE` Gaussians that follow each other in a `RowOrder`: along a space-filling
curve, so that these are neighbours, and most pages would hold nothing: there are none of those. Larger pages would have
more zeros, and smaller ones need a larger table of their numbers.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numba as nb
import numpy as np

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.label_evidence import vote_units
from gsseg_core.kernels.compiler import called_by_kernels, kernel
from gsseg_core.simd import AHEAD, prefetch
from gsseg_core.spatial.row_order import RowOrder

_BITS = 5
PAGE = 1 << _BITS  # Gaussians of a page
_NONE = -1  # in place of the number of a page: there is none


class PairVotes(NamedTuple):
    """What one view votes, pair by pair, in parts of which no two have a Gaussian in common."""

    gaussians: np.ndarray  # (P,) int32: of each (Gaussian, label) pair
    labels: np.ndarray  # (P,) int32
    weights: np.ndarray  # (P,) float32, px
    parts: np.ndarray  # (parts, 2) int64: the first pair of each, and the one after its last; others are no votes


class VoteTotal:
    """Votes of N Gaussians for K classes, in whole `VOTE_UNIT`s, int64: what is added can be taken back exactly.

    Pages hold the Gaussians in an `order`, by default their own. Nothing but memory and time depends on it.
    """

    def __init__(self, num_gaussians: int, num_classes: int, order: RowOrder | None = None) -> None:
        self.shape = num_gaussians, num_classes  # N and K
        self.order = order or RowOrder.own(num_gaussians)
        # Page of a class and a block; with rows to spare for classes that are still to come.
        self._table = np.full((num_classes, -(-num_gaussians // PAGE)), _NONE, np.int32)
        self._pages, self._count = np.zeros((0, PAGE), np.int64), 0  # pages, and how many of them are in use

    @classmethod
    def from_rows(cls, rows: CSRRows, num_classes: int, order: RowOrder | None = None) -> VoteTotal:
        """Make it of the votes that are not zero."""
        total = cls(rows.num_rows, num_classes, order)
        total.add_rows(rows)
        return total

    @property
    def nbytes(self) -> int:
        """Bytes that it takes, besides the order."""
        return self._table.nbytes + self._pages.nbytes

    def most_classes(self, nbytes: int) -> int:
        """How many classes there can be, with the votes that there are, in so many bytes; K at least."""
        return max(self.shape[1], (nbytes - self._pages.nbytes) // (4 * self._table.shape[1]))

    def add(self, cast: PairVotes, label_votes: CSRRows, sign: int = 1) -> None:
        """Add the votes of a view, or take them back with the `sign` -1.

        A pixel of each label votes as the rows `label_votes` say, float64. Where there is too little memory, or Ctrl-C
        ends it, nothing has changed.
        """
        added = np.full(1, False)
        with self._pages_whole():
            self._make_room(_number_pairs(self._table, self.order.places, cast, label_votes, self._count))
            places, cells = self.order.places, self._pages.reshape(-1)
            try:
                add_pairs(self._table, places, cells, cast, label_votes, sign, added)
            except BaseException:  # Ctrl-C is heard when the kernel has ended.
                if added[0]:
                    add_pairs(self._table, places, cells, cast, label_votes, -sign, added)
                raise

    def add_rows(self, rows: CSRRows, first: int = 0) -> None:
        """Add votes in units, int64, to those of consecutive Gaussians from the `first` on."""
        with self._pages_whole():
            self._make_room(_number_rows(self._table, self.order.places, rows, first, self._count))
        _add_rows(self._table, self.order.places, self._pages.reshape(-1), rows, first)

    def rows(self) -> CSRRows:
        """Return the votes that are not zero."""
        counts, table = np.zeros(self.shape[0], np.int64), self._table[: self.shape[1]]
        _count(table, self.order.order, self._pages, counts)
        rows = CSRRows.room_for(counts, np.int64)
        _fill(table, self.order.order, self._pages, rows)
        return rows

    def dense(self) -> np.ndarray:
        """Write all votes out, (N, K)."""
        return self.rows().dense(self.shape[1])

    def copy(self) -> VoteTotal:
        """Return another one like it."""
        other = VoteTotal(*self.shape, self.order)
        other._table[:], other._count = self._table[: self.shape[1]], self._count
        other._pages = self._pages[: self._count].copy()
        return other

    def resize(self, num_classes: int) -> None:
        """Have this many classes; votes for others are gone."""
        table, pages, count = self._table, self._pages, self._count
        if num_classes > len(table):
            table = np.full((max(num_classes, len(table) * 5 // 4), table.shape[1]), _NONE, np.int32)
            table[: len(self._table)] = self._table
        if np.any(table[num_classes:] != _NONE):
            table = table[:num_classes].copy()
            kept = table != _NONE
            pages, count = pages[table[kept]], int(np.count_nonzero(kept))
            table[kept] = np.arange(count)
        # At last: out of memory before, nothing has changed.
        self._table, self._pages, self._count, self.shape = table, pages, count, (self.shape[0], num_classes)

    @contextmanager
    def _pages_whole(self) -> Iterator[None]:
        """Have the table name no page that there is no room for, however the body ends."""
        try:
            yield
        except BaseException:
            for pages in self._table:
                pages[pages >= self._count] = _NONE
            raise

    def _make_room(self, count: int) -> None:
        """Make room for so many pages, as the table has now."""
        if count > len(self._pages):
            pages = np.zeros((max(count, len(self._pages) * 5 // 4), PAGE), np.int64)
            pages[: self._count] = self._pages[: self._count]
            self._pages = pages
        self._count = count


@called_by_kernels
def _cell(table: np.ndarray, place: int, k: int) -> np.int64:
    """Where the votes of the Gaussian at a place for a class are, among those of all pages."""
    return (np.int64(table[k, place >> _BITS]) << _BITS) | (place & (PAGE - 1))


@called_by_kernels
def _next_cell(
    table: np.ndarray, places: np.ndarray, cast: PairVotes, label_votes: CSRRows, s: int, last: int
) -> np.int64:
    """Cell that a pair after pair s will need, of the first class: most labels are of one; ask for the next's place."""
    gaussians, labels = cast.gaussians, cast.labels
    prefetch(places, gaussians[min(s + 2 * AHEAD, last)])
    later = min(s + AHEAD, last)
    first = label_votes.indptr[labels[later]]
    column = label_votes.indices[first] if first < len(label_votes.indices) else 0
    return _cell(table, places[gaussians[later]], column)


@kernel
def _number_pairs(
    table: np.ndarray, places: np.ndarray, cast: PairVotes, label_votes: CSRRows, count: int,  # pages that there are
) -> int:  # fmt: skip
    """Give pages to what a view votes for and has none; returns how many there are then.

    One thread does so, as no two may get the same number; it has hardly more to do than to look.
    """
    gaussians, labels, _, parts = cast
    for part in range(parts.shape[0]):
        for s in range(parts[part, 0], parts[part, 1]):
            prefetch(places, gaussians[min(s + AHEAD, parts[part, 1] - 1)])
            block = places[gaussians[s]] >> _BITS
            for z in range(label_votes.indptr[labels[s]], label_votes.indptr[labels[s] + 1]):
                if table[label_votes.indices[z], block] == _NONE:
                    table[label_votes.indices[z], block] = count
                    count += 1
    return count


@kernel(parallel=True)
def add_pairs(
    table: np.ndarray, places: np.ndarray,  # (K, blocks) with a page wherever one is needed; (N,) int32
    cells: np.ndarray,  # (pages * PAGE,)
    cast: PairVotes, label_votes: CSRRows, sign: int,
    added: np.ndarray,  # (1,) bool, out: true once they have been added
) -> None:  # fmt: skip
    """Add a view's votes to the cells of pages, or take them away; see `VoteTotal.add`."""
    gaussians, labels, weights, parts = cast
    for part in nb.prange(parts.shape[0]):
        for s in range(parts[part, 0], parts[part, 1]):
            prefetch(cells, _next_cell(table, places, cast, label_votes, s, parts[part, 1] - 1))
            for z in range(label_votes.indptr[labels[s]], label_votes.indptr[labels[s] + 1]):
                units = sign * vote_units(weights[s], label_votes.data[z])
                cells[_cell(table, places[gaussians[s]], label_votes.indices[z])] += units
    added[0] = True


@kernel
def _number_rows(table: np.ndarray, places: np.ndarray, rows: CSRRows, first: int, count: int) -> int:
    indptr, classes, _ = rows
    for i in range(indptr.shape[0] - 1):
        block = places[first + i] >> _BITS
        for z in range(indptr[i], indptr[i + 1]):
            if table[classes[z], block] == _NONE:
                table[classes[z], block] = count
                count += 1
    return count


@kernel(parallel=True)
def _add_rows(table: np.ndarray, places: np.ndarray, cells: np.ndarray, rows: CSRRows, first: int) -> None:
    indptr, classes, votes = rows
    for i in nb.prange(indptr.shape[0] - 1):
        for z in range(indptr[i], indptr[i + 1]):
            cells[_cell(table, places[first + i], classes[z])] += votes[z]


@kernel(parallel=True)
def _count(table: np.ndarray, order: np.ndarray, pages: np.ndarray, counts: np.ndarray) -> None:
    for block in nb.prange(table.shape[1]):
        first = block * PAGE
        size = min(PAGE, counts.shape[0] - first)
        for k in range(table.shape[0]):
            if table[k, block] >= 0:
                page = pages[table[k, block]]
                for i in range(size):
                    counts[order[first + i]] += page[i] != 0


@kernel(parallel=True)
def _fill(table: np.ndarray, order: np.ndarray, pages: np.ndarray, rows: CSRRows) -> None:
    indptr, classes, votes = rows
    for block in nb.prange(table.shape[1]):
        first = block * PAGE
        size = min(PAGE, indptr.shape[0] - 1 - first)
        nexts = indptr[order[first : first + size]]  # where the next entry of each row goes
        for k in range(table.shape[0]):
            if table[k, block] >= 0:
                page = pages[table[k, block]]
                for i in range(size):
                    if page[i] != 0:
                        classes[nexts[i]], votes[nexts[i]] = k, page[i]
                        nexts[i] += 1
