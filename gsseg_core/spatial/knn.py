"""The k nearest others of points: how far the last of them is, and how far they are on average.

The points of a leaf have almost the same neighbours. So the tree is descended once for all of them, and each then looks
only at the boxes of the leaves that were found, the leaf candidates, and at the points of those that it reaches, in one
vector each.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba as nb
import numpy as np

from gsseg_core.kernels.compiler import called_by_kernels, kernel
from gsseg_core.simd import at_most, count_at_most, first_bit, load_row, squared_distances, store_row
from gsseg_core.spatial.kd_tree import LEAF, Tree, gap, leaf_of, leaf_range

CHUNK = 256  # consecutive points of one thread
DEPTH = 64  # nodes that can wait at once; a descent leaves at most one behind at each level
FAR = np.float32(np.inf)

DIGITS = 24  # distances are summed in steps of 2^-DIGITS of the k-th one, or finer: the precision of a float32
SLACK = np.float32(1.00001)  # covers float32 rounding in a bound
LEAST = np.finfo(np.float32).tiny  # a bound that even points in one place are below


class Lists(NamedTuple):
    """What is listed of M points, one point after the other: the places of their nearest others, say."""

    counts: np.ndarray  # (M,) int64: how many of each point are listed
    entries: np.ndarray  # (M capacity,): those of each chunk of points from CHUNK * capacity on

    def joined(self) -> np.ndarray:
        """Put the entries of all points together."""
        lengths = np.add.reduceat(self.counts, np.arange(0, len(self.counts), CHUNK)).tolist()
        first = CHUNK * (len(self.entries) // len(self.counts))
        return np.concatenate([self.entries[first * chunk :][:length] for chunk, length in enumerate(lengths)])


@kernel(parallel=True)
def nearest(tree: Tree, places: np.ndarray, k: int, listed: bool) -> tuple[np.ndarray, np.ndarray, Lists]:
    """Find the squared distance to the k-th nearest other point, (M,) float32, and the mean of the k, (M,) float64.

    They are those of the points at ascending places, (M,) int32. By the triangle inequality the radius of one point
    bounds those of all others in its leaf.

    With `listed`, the neighbours themselves are returned in place of the mean distances: k of each point, or up to 2 k
    where several are tied for the last place.
    """
    points, boxes = tree.points, tree.boxes
    m, n, leaves, capacity = places.shape[0], points.shape[1], boxes.shape[0] // 2, 2 * k if listed else 0
    radii, distances = np.empty(m, np.float32), np.empty(0 if listed else m, np.float64)
    bits, skip = radii.view(np.int32), np.empty(0, np.int32)
    counts = np.zeros(m if listed else 0, np.int64)
    others = np.empty(m * capacity, np.int32)  # of which what no list fills is not touched
    for chunk in nb.prange((m + CHUNK - 1) // CHUNK):
        gaps, close, candidates = np.empty(DEPTH, np.float32), np.empty(3 * k + 2 * LEAF, np.float32), scratch_for(128)
        box, bounds = np.empty(6, np.float32), np.empty((2, LEAF), np.float32)
        bound_bits = bounds.view(np.int32)
        before, first, end = -1, chunk * CHUNK, chunk * CHUNK * capacity
        while first < min((chunk + 1) * CHUNK, m):
            last = end_of_group(tree, places, first)
            middle = middle_of(points, places, first, last, box)
            own, bound = places[middle], FAR
            if before >= 0:
                bound = _farthest(points, places[before], own, radii[before])
            found = _search(points, boxes, own, k, bound, close, candidates.nodes, gaps)
            bits[middle] = _smallest_of(close, found, k)
            reach = _bound(points, places, first, last, middle, radii[middle], bounds)
            candidates, found = find_leaves(boxes, box, reach, skip, np.int32(0), candidates)
            near = candidates.near.reshape(-1)
            near_bits = near.view(np.int32)
            for q in range(first, last):
                own = places[q]
                rows = measure(tree, own, bounds[1, q - first], found, candidates)
                _leave_out(own, leaf_of(own, leaves, n), leaves, n, rows, candidates)
                bits[q] = _smallest(near_bits, rows, k, bound_bits[0, q - first], bound_bits[1, q - first])
                if listed:
                    counts[q] = _list(candidates, rows, radii[q], leaves, n, others[end : end + capacity])
                    end += counts[q]
                else:
                    distances[q] = _mean_root(near, LEAF * rows, k, radii[q])
            before, first = middle, last
    return radii, distances, Lists(counts, others)


@called_by_kernels
def _list(candidates: LeafCandidates, rows: int, radius: float, leaves: int, n: int, out: np.ndarray) -> int:
    """List places of what was measured and is within the radius, as many as there is room for; returns how many."""
    count = 0
    for h in range(rows):
        start = leaf_range(candidates.leaves[candidates.reached[h]], leaves, n)[0]
        within = at_most(load_row(candidates.near, h), radius)
        while within and count < len(out):
            out[count] = start + first_bit(within)
            within &= within - 1
            count += 1
    return count


@called_by_kernels
def _leave_out(own: int, leaf: int, leaves: int, n: int, rows: int, candidates: LeafCandidates) -> None:
    """Take a point out of what was measured from it."""
    for h in range(rows):
        if candidates.leaves[candidates.reached[h]] == leaf:
            candidates.near[h, own - leaf_range(leaf, leaves, n)[0]] = FAR


@called_by_kernels
def middle_of(points: np.ndarray, places: np.ndarray, first: int, last: int, box: np.ndarray) -> int:
    """Box some points in, and return which of them is nearest to its middle."""
    for d in range(3):
        low = high = points[d, places[first]]
        for q in range(first + 1, last):
            low, high = min(low, points[d, places[q]]), max(high, points[d, places[q]])
        box[d], box[3 + d] = low, high
    best, least = first, np.float32(np.inf)
    for q in range(first, last):
        squared = np.float32(0)
        for d in range(3):
            off = points[d, places[q]] - np.float32(0.5) * (box[d] + box[3 + d])
            squared += off * off
        if squared < least:
            best, least = q, squared
    return best


@nb.njit(inline="always")
def _distance(points: np.ndarray, i: int, j: int) -> np.float32:
    dx, dy, dz = points[0, i] - points[0, j], points[1, i] - points[1, j], points[2, i] - points[2, j]
    return np.sqrt(dx * dx + dy * dy + dz * dz)


@nb.njit(inline="always")
def _farthest(points: np.ndarray, known: int, own: int, radius: float) -> np.float32:
    """Bound above the squared radius of one point by that of another."""
    reach = _distance(points, known, own) + np.sqrt(radius)
    return max(reach * reach * SLACK, LEAST)


@called_by_kernels
def _bound(
    points: np.ndarray, places: np.ndarray, first: int, last: int, middle: int, radius: float, bounds: np.ndarray
) -> np.float32:
    """Bound the squared radii of a group, below and above, by that of one of its points; returns the largest."""
    reach, root = np.float32(0), np.sqrt(radius)
    for q in range(first, last):
        at_least = max(root - _distance(points, places[middle], places[q]), np.float32(0))
        bounds[0, q - first] = at_least * at_least / SLACK
        bounds[1, q - first] = _farthest(points, places[middle], places[q], radius)
        reach = max(reach, bounds[1, q - first])
    return reach


@called_by_kernels
def _mean_root(near: np.ndarray, found: int, k: int, radius: float) -> float:
    """Mean distance of the k nearest; those at the radius share the places that are left."""
    root = np.sqrt(radius)
    exponent = DIGITS - math.frexp(root)[1]
    scale = np.float32(2.0**exponent)
    total = np.int64(0)
    for c in range(found):
        total += np.int32(np.sqrt(min(near[c], radius)) * scale)
    return (total - (found - k) * np.int64(root * scale)) / 2.0**exponent / k


@called_by_kernels
def _search(
    points: np.ndarray, boxes: np.ndarray, own: int, k: int,  # (3, n), (2 L, 6)
    bound: float,  # above the k-th smallest squared distance
    near: np.ndarray,  # (at least 3 k + 2 LEAF,), filled
    nodes: np.ndarray, gaps: np.ndarray,  # (DEPTH,) each, scratch
) -> int:  # fmt: skip
    """Collect squared distances to other points, the k smallest among them, in no order; return their number."""
    x, y, z = points[0, own], points[1, own], points[2, own]
    point, leaves, n = (x, y, z, x, y, z), boxes.shape[0] // 2, points.shape[1]
    found, waiting = 0, 1
    nodes[0], gaps[0] = 1, 0
    while waiting:
        waiting -= 1
        node, away = nodes[waiting], gaps[waiting]
        while node < leaves and away < bound:  # go down to the nearer child, the other one waits
            node, other = 2 * node, 2 * node + 1
            away, other_away = gap(boxes, node, point), gap(boxes, other, point)
            if other_away < away:
                node, away, other, other_away = other, other_away, node, away
            if other_away < bound:
                nodes[waiting], gaps[waiting] = other, other_away
                waiting += 1
        if away >= bound:
            continue
        first, last = leaf_range(node - leaves, leaves, n)
        if found + last - first > near.shape[0] - LEAF:
            bound, found = _shorten(near, found, k), k
        for i in range(first, last):
            dx, dy, dz = points[0, i] - x, points[1, i] - y, points[2, i] - z
            distance = dx * dx + dy * dy + dz * dz
            near[found] = distance  # without a branch: what is not counted is overwritten
            found += (distance < bound) & (i != own)
    return found


@called_by_kernels
def _shorten(near: np.ndarray, found: int, k: int) -> np.float32:
    """Keep the k smallest, whichever of equal ones; returns the largest of them."""
    bits, limit, kept = near.view(np.int32), _smallest_of(near, found, k), 0
    for i in range(found):
        if bits[i] < limit:
            bits[kept] = bits[i]
            kept += 1
    bits[kept:k] = limit
    return near[k - 1]


@called_by_kernels
def _smallest_of(near: np.ndarray, found: int, k: int) -> np.int32:
    """Bits of the k-th smallest of some distances; the array has room for a row more."""
    bits, rows, largest = near.view(np.int32), (found + LEAF - 1) // LEAF, np.int32(0)
    for i in range(found):
        largest = max(largest, bits[i])
    near[found : LEAF * rows] = FAR
    return _smallest(bits, rows, k, np.int32(0), largest)


@called_by_kernels
def _smallest(bits: np.ndarray, rows: int, k: int, low: np.int32, high: np.int32) -> np.int32:
    """Bits of the k-th smallest of sixteen times so many float32, none negative, known to be between two others.

    Such floats sort like their bits, so this bisects the bits: counting what is at most the middle takes a few vector
    instructions, has no branch to mispredict and moves nothing. It ends as soon as k are on one side.
    """
    while low < high:
        middle = np.int32(low + ((high - low) >> np.int32(1)))
        count = 0
        for i in range(rows):
            count += count_at_most(bits, i, middle)
        if count >= k:
            high = middle
            if count == k:
                break
        else:
            low = np.int32(middle + 1)
    largest = np.int32(0)
    for i in range(LEAF * rows):
        largest = max(largest, bits[i] if bits[i] <= high else np.int32(0))
    return largest


class LeafCandidates(NamedTuple):
    """At most n leaves near the points of one leaf, and distances to their points: scratch of one thread."""

    nodes: np.ndarray  # (DEPTH,) int64: nodes still to be looked at
    leaves: np.ndarray  # (n,) int64
    corners: np.ndarray  # (6, n) float32: boxes of the leaves
    gaps: np.ndarray  # (n,) float32: squared distances from a point to the boxes
    reached: np.ndarray  # (n,) int32: which of the leaves the point reaches
    near: np.ndarray  # (n, LEAF) float32: squared distances to the points of these


@called_by_kernels
def scratch_for(count: int) -> LeafCandidates:
    """Allocate the scratch of one thread for so many leaves."""
    return LeafCandidates(
        np.empty(DEPTH, np.int64), np.empty(count, np.int64), np.empty((6, count), np.float32),
        np.empty(count, np.float32), np.empty(count, np.int32), np.empty((count, LEAF), np.float32),
    )  # fmt: skip


@called_by_kernels
def end_of_group(tree: Tree, places: np.ndarray, first: int) -> int:
    """Where the points of a chunk of ascending places, (M,) int32, end that are in the same leaf as place `first`."""
    n, leaves = tree.points.shape[1], len(tree.blocks)
    end, limit = leaf_range(leaf_of(places[first], leaves, n), leaves, n)[1], (first // CHUNK + 1) * CHUNK
    last = first + 1
    while last < min(limit, len(places)) and places[last] < end:
        last += 1
    return last


@called_by_kernels
def find_leaves(
    boxes: np.ndarray, box: np.ndarray, reach: float,  # (2 L, 6), (6,), squared
    skip: np.ndarray, skipped: int,  # (2 L,) int32, or none: nodes with this number there are left out
    candidates: LeafCandidates,
) -> tuple[LeafCandidates, int]:  # fmt: skip
    """Find the leaves at most so far from a box; returns them, in larger scratch if need be, and their number."""
    found = _descend(boxes, box, reach, skip, skipped, candidates)
    if found > len(candidates.leaves):
        candidates = scratch_for(2 * found)
        _descend(boxes, box, reach, skip, skipped, candidates)
    for c in range(found):
        for d in range(6):
            candidates.corners[d, c] = boxes[boxes.shape[0] // 2 + candidates.leaves[c], d]
    return candidates, found


@called_by_kernels
def _descend(
    boxes: np.ndarray, box: np.ndarray, reach: float, skip: np.ndarray, skipped: int, candidates: LeafCandidates
) -> int:
    """Find the leaves, and note as many as fit; returns how many there are."""
    nodes, near, leaves = candidates.nodes, candidates.leaves, boxes.shape[0] // 2
    found, waiting, nodes[0] = 0, 1, 1
    while waiting:
        waiting -= 1
        node = nodes[waiting]
        if gap(boxes, node, box) > reach or (skip.shape[0] > 0 and skip[node] == skipped):
            continue
        if node < leaves:
            nodes[waiting], nodes[waiting + 1] = 2 * node, 2 * node + 1
            waiting += 2
            continue
        if found < near.shape[0]:
            near[found] = node - leaves
        found += 1
    return found


@called_by_kernels
def measure(tree: Tree, own: int, reach: float, found: int, candidates: LeafCandidates) -> int:
    """Measure from a point to those of the leaves within reach, squared, into `near`; returns how many leaves."""
    x, y, z = tree.points[0, own], tree.points[1, own], tree.points[2, own]
    corners, gaps, reached = candidates.corners, candidates.gaps, candidates.reached
    for c in range(found):
        dx = max(max(corners[0, c] - x, x - corners[3, c]), np.float32(0))
        dy = max(max(corners[1, c] - y, y - corners[4, c]), np.float32(0))
        dz = max(max(corners[2, c] - z, z - corners[5, c]), np.float32(0))
        gaps[c] = dx * dx + dy * dy + dz * dz
    hits = 0
    for c in range(found):  # without a branch: what is not reached is overwritten
        reached[hits] = c
        hits += gaps[c] <= reach
    for h in range(hits):
        store_row(candidates.near, h, squared_distances(tree.blocks, 3 * candidates.leaves[reached[h]], x, y, z))
    return hits
