"""The votes of all views: of many classes, neighbours in space have votes for a few, and only those are kept.

A *page* has the votes for one class of `PAGE` Gaussians that follow each other in a `RowOrder`: along a space-filling
curve, so that these are neighbours, and most pages would hold nothing: there are none of those. Larger pages would have
more zeros, and smaller ones need a larger table of their numbers.
"""

from __future__ import annotations

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
_NONE, _WANTED = -1, -2  # in place of the number of a page: there is none; one is to be made


class PairVotes(NamedTuple):
    """What one view votes, pair by pair, in parts of which no two have a Gaussian in common."""

    gaussians: np.ndarray  # (P,) int32: of each (Gaussian, label) pair
    labels: np.ndarray  # (P,) int32
    weights: np.ndarray  # (P,) float32, px
    parts: np.ndarray  # (parts, 2) int64: the first pair of each, and the one after its last; others are no votes


class VoteTotal:
    """Votes of N Gaussians for K classes, in whole units, int64: what is added can be taken back exactly.

    Pages hold the Gaussians in an `order`, by default their own. Nothing but memory and time depends on it.
    """

    def __init__(self, num_gaussians: int, num_classes: int, order: RowOrder | None = None) -> None:
        self._num_gaussians = num_gaussians
        self.order = order or RowOrder.own(num_gaussians)
        self._table = np.full((-(-num_gaussians // PAGE), num_classes), _NONE, np.int32)  # page of a block and class
        self._pages, self._count = np.zeros((0, PAGE), np.int64), 0  # pages, and how many of them are in use

    @classmethod
    def from_rows(cls, rows: CSRRows, num_classes: int, order: RowOrder | None = None) -> VoteTotal:
        """Make it of the votes that are not zero."""
        total = cls(rows.num_rows, num_classes, order)
        total.add_rows(rows)
        return total

    @property
    def shape(self) -> tuple[int, int]:
        """N and K."""
        return self._num_gaussians, self._table.shape[1]

    @property
    def nbytes(self) -> int:
        """Bytes that it takes, besides the order."""
        return self._table.nbytes + self._pages.nbytes

    def most_classes(self, nbytes: int) -> int:
        """How many classes there can be, with the votes that there are, in so many bytes; K at least."""
        return max(self.shape[1], (nbytes - self._pages.nbytes) // (4 * len(self._table)))

    def add(self, cast: PairVotes, label_votes: CSRRows, units: float, sign: int = 1) -> None:
        """Add the votes of a view, or take them back: `units` per px of weight, a power of 2, `sign` 1 or -1.

        A pixel of each label votes as the rows `label_votes` say, float64. Where there is too little memory, nothing
        has changed.
        """
        self._make_pages(_mark_pairs(self._table, self.order.places, cast, label_votes))
        add_pairs(self._table, self.order.places, self._pages.reshape(-1), cast, label_votes, units, sign)

    def add_rows(self, rows: CSRRows, first: int = 0) -> None:
        """Add votes in units, int64, to those of consecutive Gaussians from the `first` on."""
        self._make_pages(_mark_rows(self._table, self.order.places, rows, first))
        _add_rows(self._table, self.order.places, self._pages.reshape(-1), rows, first)

    def rows(self) -> CSRRows:
        """Return the votes that are not zero."""
        counts = np.zeros(self._num_gaussians, np.int64)
        _count(self._table, self.order.order, self._pages, counts)
        rows = CSRRows.room_for(counts, np.int64)
        _fill(self._table, self.order.order, self._pages, rows)
        return rows

    def dense(self) -> np.ndarray:
        """Write all votes out, (N, K)."""
        return self.rows().dense(self.shape[1])

    def copy(self) -> VoteTotal:
        """Return another one like it."""
        other = VoteTotal(*self.shape, self.order)
        other._table[:], other._pages, other._count = self._table, self._pages[: self._count].copy(), self._count
        return other

    def resize(self, num_classes: int) -> None:
        """Have this many classes; votes for others are gone."""
        added = max(num_classes - self._table.shape[1], 0)
        table = np.pad(self._table[:, :num_classes], ((0, 0), (0, added)), constant_values=_NONE)
        if np.any(self._table[:, num_classes:] != _NONE):
            kept = table != _NONE
            self._pages, self._count = self._pages[table[kept]], int(np.count_nonzero(kept))
            table[kept] = np.arange(self._count)
        self._table = table

    def _make_pages(self, marked: np.ndarray) -> None:  # (blocks,) bool: those where pages are wanted
        """Make the pages that the table wants; without memory for them, it wants none."""
        blocks = np.flatnonzero(marked)
        among, classes = np.nonzero(self._table[blocks] == _WANTED)
        cells = blocks[among], classes
        try:
            self._make_room(self._count + len(classes))
        except BaseException:
            self._table[cells] = _NONE
            raise
        self._table[cells] = np.arange(self._count, self._count + len(classes))
        self._count += len(classes)

    def _make_room(self, count: int) -> None:
        if count > len(self._pages):
            pages = np.zeros((max(count, len(self._pages) * 5 // 4), PAGE), np.int64)
            pages[: self._count] = self._pages[: self._count]
            self._pages = pages


@called_by_kernels
def _cell(table: np.ndarray, place: int, k: int) -> np.int64:
    """Where the votes of the Gaussian at a place for a class are, among those of all pages."""
    return (np.int64(table[place >> _BITS, k]) << _BITS) | (place & (PAGE - 1))


@called_by_kernels
def _want(table: np.ndarray, block: int, k: int) -> bool:
    """Want the page of a block and a class, if there is none; threads that do so at once write the same."""
    if table[block, k] != _NONE:
        return False
    table[block, k] = _WANTED
    return True


@kernel(parallel=True)
def _mark_pairs(table: np.ndarray, places: np.ndarray, cast: PairVotes, label_votes: CSRRows) -> np.ndarray:
    gaussians, labels, _, parts = cast
    marked = np.zeros(table.shape[0], np.bool_)
    for part in nb.prange(parts.shape[0]):
        for s in range(parts[part, 0], parts[part, 1]):
            block = places[gaussians[s]] >> _BITS
            for z in range(label_votes.indptr[labels[s]], label_votes.indptr[labels[s] + 1]):
                if _want(table, block, label_votes.indices[z]):
                    marked[block] = True
    return marked


@kernel(parallel=True)
def add_pairs(
    table: np.ndarray, places: np.ndarray,  # (blocks, K) with a page wherever one is needed; (N,) int32
    cells: np.ndarray,  # (pages * PAGE,)
    cast: PairVotes, label_votes: CSRRows, units: float, sign: int,
) -> None:  # fmt: skip
    """Add a view's votes to the cells of pages, or take them away; see `VoteTotal.add`."""
    gaussians, labels, weights, parts = cast
    for part in nb.prange(parts.shape[0]):
        for s in range(parts[part, 0], parts[part, 1]):
            # What is asked for in time is the cell of the first class; most labels are of one.
            later = min(s + AHEAD, parts[part, 1] - 1)
            first = label_votes.indptr[labels[later]]
            column = label_votes.indices[first] if first < len(label_votes.indices) else 0
            prefetch(cells, _cell(table, places[gaussians[later]], column))
            for z in range(label_votes.indptr[labels[s]], label_votes.indptr[labels[s] + 1]):
                added = sign * vote_units(weights[s], label_votes.data[z], units)
                cells[_cell(table, places[gaussians[s]], label_votes.indices[z])] += added


@kernel(parallel=True)
def _mark_rows(table: np.ndarray, places: np.ndarray, rows: CSRRows, first: int) -> np.ndarray:
    indptr, classes, _ = rows
    marked = np.zeros(table.shape[0], np.bool_)
    for i in nb.prange(indptr.shape[0] - 1):
        block = places[first + i] >> _BITS
        for z in range(indptr[i], indptr[i + 1]):
            if _want(table, block, classes[z]):
                marked[block] = True
    return marked


@kernel(parallel=True)
def _add_rows(table: np.ndarray, places: np.ndarray, cells: np.ndarray, rows: CSRRows, first: int) -> None:
    indptr, classes, votes = rows
    for i in nb.prange(indptr.shape[0] - 1):
        for z in range(indptr[i], indptr[i + 1]):
            cells[_cell(table, places[first + i], classes[z])] += votes[z]


@kernel(parallel=True)
def _count(table: np.ndarray, order: np.ndarray, pages: np.ndarray, counts: np.ndarray) -> None:
    for block in nb.prange(table.shape[0]):
        first = block * PAGE
        size = min(PAGE, counts.shape[0] - first)
        for k in range(table.shape[1]):
            if table[block, k] >= 0:
                page = pages[table[block, k]]
                for i in range(size):
                    counts[order[first + i]] += page[i] != 0


@kernel(parallel=True)
def _fill(table: np.ndarray, order: np.ndarray, pages: np.ndarray, rows: CSRRows) -> None:
    indptr, classes, votes = rows
    for block in nb.prange(table.shape[0]):
        first = block * PAGE
        size = min(PAGE, indptr.shape[0] - 1 - first)
        nexts = indptr[order[first : first + size]]  # where the next entry of each row goes
        for k in range(table.shape[1]):
            if table[block, k] >= 0:
                page = pages[table[block, k]]
                for i in range(size):
                    if page[i] != 0:
                        classes[nexts[i]], votes[nexts[i]] = k, page[i]
                        nexts[i] += 1
