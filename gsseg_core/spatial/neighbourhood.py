"""Distances from points to their k nearest others, found once and only where asked for, and means over those.

What is kept is not who the neighbours are but how far the k-th one is: with it, all of them are found again in one
search, and a million points take 12 MB instead of 200. Background that is sure of itself is never asked for, and it is
more than half of most scenes.

Results are bit-identical whatever the order of the points and the number of threads: points tied for the last place
among the k nearest share it equally, and sums are taken over whole numbers, where order is no matter.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from typing import NamedTuple

import numba as nb
import numpy as np

from gsseg_core.csr_rows import CSRRows, slices, starts
from gsseg_core.kernels.compiler import called_by_kernels, kernel
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.scene_cache import PerScene
from gsseg_core.simd import at_most, count_bits, load_row
from gsseg_core.spatial import knn
from gsseg_core.spatial.kd_tree import LEAF, Tree, leaf_range, scaled, tree_of, values_of_nodes
from gsseg_core.spatial.leaf_codes import LeafCodes, add_leaf, none_of, take_first

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
        order, leaf_codes = self.tree.order, LeafCodes.build(self.tree, codes, weights, num_classes)
        counted = values_of_nodes((weights > 0)[order], len(self.tree.blocks))
        selected = np.ones(len(order), bool) if wanted is None else wanted[order]
        self.look_for(selected)
        below = np.nextafter(self.radii, np.float32(-np.inf))
        asked, parts = np.flatnonzero(selected).astype(np.int32), []
        for some in slices(len(asked), num_classes):  # of which each has room for rows that are written out in full
            columns, entries = average(
                self.tree, leaf_codes, counted, self.radii, below, self.k, asked[some], num_classes
            )
            parts.append(CSRRows(starts(columns.counts), columns.joined(), entries.joined()))
        means = CSRRows.vstack([CSRRows.empty(0), *parts])
        del parts, leaf_codes
        return CSRRows.empty(len(order)).replaced_at(order[asked], means)


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
    tree: Tree, codes: LeafCodes,
    counted: np.ndarray,  # (2 L,) of `values_of_nodes`: 0 for nodes of which no point counts
    radii: np.ndarray, below: np.ndarray,  # (n,): squared distance to the k-th nearest other; the next smaller float32
    k: int,
    places: np.ndarray, num_classes: int,  # (M,) int32, ascending
) -> tuple[knn.Lists, knn.Lists]:  # fmt: skip
    """List mean codes of the k nearest others that count: classes, ascending, and float32 above 0; none if none does.

    Those exactly at the radius share the places that are left.
    """
    m, leaves, n = len(places), len(tree.blocks), len(tree.order)
    skip, counts = np.empty(0, np.int32), np.zeros(m, np.int64)
    # Of what has room for rows of all classes, only what is written is ever in memory.
    columns, entries = np.empty(m * num_classes, np.uint32), np.empty(m * num_classes, np.float32)
    for chunk in nb.prange((m + knn.CHUNK - 1) // knn.CHUNK):
        sums, occurring, masses = np.zeros((num_classes, 2), np.int64), none_of(num_classes), np.empty(num_classes)
        box, candidates = np.empty(6, np.float32), knn.scratch_for(128)
        begin, last = chunk * knn.CHUNK, chunk * knn.CHUNK * num_classes
        while begin < min((chunk + 1) * knn.CHUNK, m):
            end = knn.end_of_group(tree, places, begin)
            knn.middle_of(tree.points, places, begin, end, box)
            reach = np.float32(0)
            for q in range(begin, end):
                reach = max(reach, radii[places[q]])
            # Most of those that no view saw are among their like, and none of these has to be looked at.
            candidates, found = knn.find_leaves(tree.boxes, box, reach, counted, np.int32(0), candidates)
            if found > 0:
                candidates, found = knn.find_leaves(tree.boxes, box, reach, skip, np.int32(0), candidates)
            for q in range(begin, end if found > 0 else begin):
                own = places[q]
                closer = ties = 0
                for h in range(knn.measure(tree, own, radii[own], found, candidates)):
                    leaf = candidates.leaves[candidates.reached[h]]
                    start = leaf_range(leaf, leaves, n)[0]
                    others = ~(1 << (own - start)) if start <= own < start + LEAF else -1
                    near = load_row(candidates.near, h)
                    inside = at_most(near, below[own]) & others
                    tied = at_most(near, radii[own]) & others & ~inside
                    if inside:
                        add_leaf(codes, leaf, inside, 0, sums, occurring)
                        closer += count_bits(inside)
                    if tied:
                        add_leaf(codes, leaf, tied, 1, sums, occurring)
                        ties += count_bits(tied)
                # The k-th nearest lies on the radius, so that there is always one.
                counts[q] = _list_means(sums, occurring, masses, (k - closer) / ties, columns[last:], entries[last:])
                last += counts[q]
            begin = end
    return knn.Lists(counts, columns), knn.Lists(counts, entries)


@called_by_kernels
def _list_means(
    sums: np.ndarray, occurring: np.ndarray, masses: np.ndarray,  # scratch; (K,) float64
    share: float, columns: np.ndarray, entries: np.ndarray,
) -> int:  # fmt: skip
    """List sums by their total where they are not zero, those on the radius counting a share; returns how many it is.

    Scratch is all zeros then.
    """
    count, total = 0, 0.0
    for word in range(len(occurring)):
        while occurring[word]:
            c = take_first(occurring, word)
            mass = sums[c, 0] + share * sums[c, 1]
            sums[c] = 0
            if mass > 0:
                columns[count], masses[count] = c, mass
                total += mass
                count += 1
    for j in range(count):
        entries[j] = masses[j] / total
    return count
