"""Distances from points to their k nearest others, found once and only where asked for, and means over those.

What is kept is not who the neighbours are but how far the k-th one is: with it, all of them are found again in one
search, and a million points take 16 MB instead of 200. Background that is sure of itself is never asked for, and it is
more than half of most scenes.

Results are bit-identical whatever the order of the points and the number of threads: points tied for the last place
among the k nearest share it equally, and sums are taken over whole numbers, where order is no matter.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import numba as nb
import numpy as np

from gsseg_core.csr_rows import CSRRows, slices
from gsseg_core.kernels.compiler import kernel
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.scene_cache import PerScene
from gsseg_core.simd import at_most, first_bit, load_row
from gsseg_core.spatial import knn
from gsseg_core.spatial.kd_tree import LEAF, Tree, leaf_range, scaled, tree_of

CODE_UNIT = 2.0**-24  # codes are summed in steps of this, which is the precision of a float32 near 1

HALF = 3.0
"""Evidence in px with which a Gaussian has half of the weight in its neighbours' means that it could have at most."""

_LEAST_WEIGHT = np.float32(2.0**-10)  # of one with a code: where all have next to no evidence, something still counts


class Found(NamedTuple):
    """Mean distances of points to others of their class, and what they go by; all arrays are (N,), in tree order."""

    labels: np.ndarray  # int32, 0 of points that are in no class
    radii: np.ndarray  # float32: squared distance to the last of the k nearest of the class
    distances: np.ndarray  # float64: mean distance to these; both are NaN where there is none

    @classmethod
    def nothing(cls, count: int) -> Found:
        """Begin with points of which none is in a class."""
        return cls(np.zeros(count, np.int32), np.full(count, np.nan, np.float32), np.full(count, np.nan))


@dataclass(eq=False)
class Neighbours:
    """How far the k nearest others of points are."""

    k: int  # number of neighbours; N - 1 if there are not as many
    tree: Tree  # the points, all arrays here being in its order
    radii: np.ndarray  # (N,) float32: squared distance to the k-th nearest other, NaN where nobody has asked for it
    distances: np.ndarray  # (N,) float64: mean distance to the k nearest others, both in units of the scaled points
    by_class: Found | None = field(default=None, repr=False)  # what `class_distances` found last
    _looking: threading.Lock = field(default_factory=threading.Lock, repr=False)

    @classmethod
    def among(cls, means: np.ndarray, k: int, tree: Tree | None = None) -> Neighbours:
        """Begin with points, (N, 3) float32 with N > 1, of which none has been asked for.

        The tree, if one is at hand, is that of the scaled points.
        """
        tree, n = tree or Tree.build(scaled(means)), len(means)
        return cls(min(k, n - 1), tree, np.full(n, np.nan, np.float32), np.full(n, np.nan))

    def look_for(self, wanted: np.ndarray | None = None) -> Neighbours:
        """Find what is not known yet of all points, or of those wanted, (N,) bool by place; returns the same object."""
        with self._looking:
            missing = np.isnan(self.radii)
            places = np.flatnonzero(missing if wanted is None else missing & wanted).astype(np.int32)
            if len(places):
                self.radii[places], self.distances[places], _ = knn.nearest(self.tree, places, self.k, False)
        return self

    def mean_codes(
        self,
        codes: CSRRows,  # N rows of K classes, float32 in [0, 1]
        weights: np.ndarray,  # (N,) float32 in [0, 1], or bool
        num_classes: int,
        wanted: np.ndarray | None = None,  # (N,) bool; all by default
    ) -> CSRRows:
        """Weighted mean codes of the k nearest others, N rows; one without entries where none weighs anything.

        Rows that are not wanted have no entries either.
        """
        order = self.tree.order
        selected = np.ones(len(order), bool) if wanted is None else wanted[order]
        means_of, parts = self._prepared(codes, weights, selected), [CSRRows.empty(0)]
        # A block at a time is written out in full, so that of all the codes only what is not zero is ever in memory.
        asked = np.flatnonzero(selected).astype(np.int32)
        for some in slices(len(asked), num_classes):
            out = np.zeros((some.stop - some.start, num_classes), np.float32)
            means_of(asked[some], out)
            parts.append(CSRRows.from_dense(out))
        rows = np.full(len(order), -1)
        rows[order[asked]] = np.arange(len(asked))
        return CSRRows.empty(len(order)).replaced(rows, CSRRows.vstack(parts))

    def _prepared(
        self, codes: CSRRows, weights: np.ndarray, selected: np.ndarray
    ) -> Callable[[np.ndarray, np.ndarray], None]:
        """Bring codes and weights into the order of the tree; returns `average` but for its last two arguments."""
        order = self.tree.order
        # In the order of the tree, neighbours lie beside each other.
        ordered, weights = codes.take(order), weights[order]
        units = np.repeat(weights * np.float32(1 / CODE_UNIT), np.diff(ordered.indptr))
        np.multiply(units, ordered.data, where=units > 0, out=units)
        rows, counted = ordered.with_data(np.rint(units, out=units).astype(np.int32)), weights > 0
        self.look_for(selected)
        empty = nodes_without(counted, len(self.tree.blocks))
        below = np.nextafter(self.radii, np.float32(-np.inf))
        return partial(average, self.tree, rows, counted, empty, self.radii, below, self.k)


def neighbour_weights(known: np.ndarray, evidence: np.ndarray) -> np.ndarray:  # (N,) bool, (N,) px
    """Weigh Gaussians that have a code by how well each was seen, for means over neighbours: (N,) float32 in [0, 1).

    It is the share of the code that its own evidence holds beside a spatial prior of `HALF` px: what is hardly seen is
    known by its neighbours alone, and has nothing to tell them.
    """
    evidence = evidence.astype(np.float32)
    return known * np.maximum(evidence / (evidence + np.float32(HALF)), _LEAST_WEIGHT)


_KNOWN: PerScene[Neighbours] = PerScene()


def neighbours_of(scene: GaussianScene, k: int) -> Neighbours | None:
    """Neighbours of a scene's Gaussians: what is found of them is kept with it. None if it has a single Gaussian."""
    if len(scene) < 2:
        return None
    k = min(k, len(scene) - 1)
    return _KNOWN.of(scene, lambda: Neighbours.among(scene.means, k, tree_of(scene)), lambda known: known.k == k)


def find_neighbours(scene: GaussianScene, k: int) -> None:
    """Find the neighbours of all Gaussians of a scene now, so that those who ask later have them."""
    if (neighbours := neighbours_of(scene, k)) is not None:
        neighbours.look_for()


@kernel(parallel=True)
def average(
    tree: Tree, codes: CSRRows, counted: np.ndarray,  # n rows, int32 in steps of CODE_UNIT; (n,) bool, by place
    empty: np.ndarray,  # (2 L,) int32: 1 for nodes of which no point counts
    radii: np.ndarray, below: np.ndarray,  # (n,): squared distance to the k-th nearest other; the next smaller float32
    k: int,
    places: np.ndarray, out: np.ndarray,  # (M,) int32, ascending; (M, K) float32
) -> None:  # fmt: skip
    """Write mean codes of the k nearest others that count; rows of places of which none does stay as they are.

    Those exactly at the radius share the places that are left.
    """
    m, leaves, n, num_classes = len(places), len(tree.blocks), len(tree.order), out.shape[1]
    skip = np.empty(0, np.int32)
    for chunk in nb.prange((m + knn.CHUNK - 1) // knn.CHUNK):
        sums = np.empty((2, num_classes), np.int64)  # inside the radius, and on it
        counts = np.empty(2, np.int64)  # the same
        box, candidates = np.empty(6, np.float32), knn.scratch_for(128)
        begin = chunk * knn.CHUNK
        while begin < min((chunk + 1) * knn.CHUNK, m):
            end = knn.end_of_group(tree, places, begin)
            knn.middle_of(tree.points, places, begin, end, box)
            reach = np.float32(0)
            for q in range(begin, end):
                reach = max(reach, radii[places[q]])
            # Most of those that no view saw are among their like, and none of these has to be looked at.
            candidates, found = knn.find_leaves(tree.boxes, box, reach, empty, np.int32(1), candidates)
            if found > 0:
                candidates, found = knn.find_leaves(tree.boxes, box, reach, skip, np.int32(0), candidates)
            for q in range(begin, end if found > 0 else begin):
                own = places[q]
                sums[:], counts[:] = 0, 0
                for h in range(knn.measure(tree, own, radii[own], found, candidates)):
                    start = leaf_range(candidates.leaves[candidates.reached[h]], leaves, n)[0]
                    others = ~(1 << (own - start)) if start <= own < start + LEAF else -1
                    near = load_row(candidates.near, h)
                    inside = at_most(near, below[own]) & others
                    tied = at_most(near, radii[own]) & others & ~inside
                    counts[0] += _add(codes, counted, start, inside, sums[0])
                    if tied:
                        counts[1] += _add(codes, counted, start, tied, sums[1])
                # The k-th nearest lies on the radius, so that there is always one.
                share, total = (k - counts[0]) / counts[1], 0.0
                for c in range(num_classes):
                    total += sums[0, c] + share * sums[1, c]
                if total > 0:
                    for c in range(num_classes):
                        out[q, c] = (sums[0, c] + share * sums[1, c]) / total
            begin = end


@nb.njit(inline="always")
def _add(codes: CSRRows, counted: np.ndarray, start: int, lanes: int, sums: np.ndarray) -> int:
    """Add up the codes of some points of a leaf, by the bits of their lanes, where they count; tell how many it is."""
    count = 0
    while lanes:
        place = start + first_bit(lanes)
        lanes &= lanes - 1
        count += 1
        if counted[place]:
            for e in range(codes.indptr[place], codes.indptr[place + 1]):
                sums[codes.indices[e]] += codes.data[e]
    return count


@kernel(parallel=True)
def nodes_without(counted: np.ndarray, leaves: int) -> np.ndarray:  # (n,) bool, by place
    """Mark the nodes of which no point counts, (2 L,) int32: 1 for these, 0 for others."""
    without = np.ones(2 * leaves, np.int32)
    for leaf in nb.prange(leaves):
        first, last = leaf_range(leaf, leaves, len(counted))
        for i in range(first, last):
            if counted[i]:
                without[leaves + leaf] = 0
    for node in range(leaves - 1, 0, -1):
        without[node] = without[2 * node] & without[2 * node + 1]
    return without
