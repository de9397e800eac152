"""Kernels of moves: which object explains each segment best by what the other views say, all views at once.

The weights of n segments on I Gaussians come as `indptr`, `segments` and `weights`, by Gaussian and then by segment;
segments are numbered view after view. So what a view says of a Gaussian is a run of the entries there.
"""

from __future__ import annotations

from typing import NamedTuple

import numba as nb
import numpy as np

from gsseg_core.kernels.compiler import called_by_kernels, kernel

_BLOCKS = 64  # of Gaussians, each the work of one thread


class ByView(NamedTuple):
    """The weights once more, view after view, and in each by Gaussian and then by segment: so they are read in turn."""

    starts: np.ndarray  # (V + 1,) int64: where the segments of each view begin
    firsts: np.ndarray  # (V + 1,) int64: where the Gaussians of each view begin
    gaussians: np.ndarray  # (M,) int32: those that each view sees, view after view, ascending in each
    indptr: np.ndarray  # (M + 1,) int64: where the entries of each begin
    segments: np.ndarray  # (Z,) int32
    weights: np.ndarray  # (Z,) float32


@kernel
def by_view(
    indptr: np.ndarray, segments: np.ndarray, weights: np.ndarray,
    starts: np.ndarray, firsts: np.ndarray, gaussians: np.ndarray,
) -> ByView:  # fmt: skip
    """Order the entries by view."""
    begin, place, n = np.empty(len(gaussians) + 1, np.int64), indptr[:-1].copy(), 0
    own, own_weights = np.empty(len(segments), np.int32), np.empty(len(segments), np.float32)
    for v in range(len(starts) - 1):
        for t in range(firsts[v], firsts[v + 1]):
            i = gaussians[t]
            z, begin[t] = place[i], n
            while z < indptr[i + 1] and segments[z] < starts[v + 1]:
                own[n], own_weights[n] = segments[z], weights[z]
                z, n = z + 1, n + 1
            place[i] = z
    begin[-1] = n
    return ByView(starts, firsts, gaussians, begin, own, own_weights)


@kernel(parallel=True)
def add_objects(
    indptr: np.ndarray, segments: np.ndarray, weights: np.ndarray, objects: np.ndarray, num_objects: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # (n,) int64
    """Add up the segments of each object on each Gaussian: rows of I Gaussians, objects int32 and weights float64."""
    num = len(indptr) - 1
    counts = np.zeros(num + 1, np.int64)
    for block in nb.prange(_BLOCKS):
        last = np.full(num_objects, -1)
        for i in range(num * block // _BLOCKS, num * (block + 1) // _BLOCKS):
            for z in range(indptr[i], indptr[i + 1]):
                k = objects[segments[z]]
                counts[i + 1] += last[k] != i
                last[k] = i
    begin = np.cumsum(counts)
    present, total = np.empty(begin[-1], np.int32), np.zeros(begin[-1])
    for block in nb.prange(_BLOCKS):
        place = np.full(num_objects, -1)
        for i in range(num * block // _BLOCKS, num * (block + 1) // _BLOCKS):
            end = begin[i]
            for z in range(indptr[i], indptr[i + 1]):
                k = objects[segments[z]]
                if place[k] < begin[i]:
                    present[end], place[k] = k, end
                    end += 1
                total[place[k]] += weights[z]
    return begin, present, total


@kernel(parallel=True)
def explain_segments(
    views: ByView,
    begin: np.ndarray, present: np.ndarray, total: np.ndarray,
    objects: np.ndarray, num_objects: int,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Find for each segment the object of the largest IoU, 0 where there is none, and its weight on known Gaussians.

    The objects are those that `add_objects` made of the same segments; each view is left out of what is said of its own
    segments. Both are (n,), int64 and float64, in px; known are Gaussians of which other views say anything.
    """
    best, known = np.zeros(len(objects), np.int64), np.zeros(len(objects))
    for v in nb.prange(len(views.starts) - 1):
        first, last = views.starts[v], views.starts[v + 1]
        column, there = _columns(views.gaussians[views.firsts[v] : views.firsts[v + 1]], begin, present, num_objects)
        common = np.zeros((last - first, len(there)))
        _add_common(views, v, begin, present, total, objects, column, common, known)
        _choose(common, known[first:last], there, best[first:last])
    return best, known


@called_by_kernels
def _columns(
    gaussians: np.ndarray, begin: np.ndarray, present: np.ndarray, num_objects: int
) -> tuple[np.ndarray, np.ndarray]:
    """Give each object that is on some Gaussians a column, in their order: (K,), and the object of each, (U,)."""
    column = np.full(num_objects, -1)
    for i in gaussians:
        for z in range(begin[i], begin[i + 1]):
            column[present[z]] = 0
    there = np.flatnonzero(column == 0)
    for u in range(len(there)):
        column[there[u]] = u
    return column, there


@called_by_kernels
def _add_common(
    views: ByView, v: int, begin: np.ndarray, present: np.ndarray, total: np.ndarray,
    objects: np.ndarray, column: np.ndarray, common: np.ndarray, known: np.ndarray,
) -> None:  # fmt: skip
    """Share out the weight of each segment of a view on a Gaussian to the objects there, by what other views say."""
    share, at = np.empty(len(column)), np.empty(len(column), np.int64)  # of the objects on one Gaussian
    for t in range(views.firsts[v], views.firsts[v + 1]):
        own, end = views.indptr[t], views.indptr[t + 1]
        z0, many, every = begin[views.gaussians[t]], begin[views.gaussians[t] + 1] - begin[views.gaussians[t]], 0.0
        for k in range(many):
            share[k], at[k] = total[z0 + k], column[present[z0 + k]]
        for j in range(own, end):
            k, mine = 0, column[objects[views.segments[j]]]
            while at[k] != mine:
                k += 1
            share[k] -= views.weights[j]
        for k in range(many):
            # Where this view was the only one, rounding is left.
            share[k] = share[k] if share[k] >= 1e-6 else 0.0
            every += share[k]
        if every > 0:
            for k in range(many):
                share[k] /= every
            for j in range(own, end):
                a, weight = views.segments[j], views.weights[j]
                known[a] += weight
                row = common[a - views.starts[v]]
                for k in range(many):
                    row[at[k]] += weight * share[k]


@called_by_kernels
def _choose(common: np.ndarray, known: np.ndarray, there: np.ndarray, best: np.ndarray) -> None:
    """Find the object of the largest IoU with each segment of a view; of equal ones the first."""
    size = np.zeros(len(there))
    for a in range(len(known)):
        for u in range(len(there)):
            size[u] += common[a, u]
    for a in range(len(known)):
        most = 0.0
        for u in range(len(there)):
            union = known[a] + size[u] - common[a, u]
            if union > 0 and common[a, u] / union > most:
                most, best[a] = common[a, u] / union, there[u]


def call_all() -> None:
    """Call each kernel with arrays of the types that moves have for it, so that it is compiled."""
    indptr, none, bounds = np.zeros(2, np.int32), np.zeros(0, np.int32), np.zeros(2, np.int64)
    entries, objects = (indptr, none, np.zeros(0, np.float32)), np.zeros(0, np.int64)
    views = by_view(*entries, bounds, bounds, none)
    explain_segments(views, *add_objects(*entries, objects, 1), objects, 1)
