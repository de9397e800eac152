"""Leaf candidates: the leaves near the points of a leaf, whose points each of these looks at in one vector.

The points of a leaf have almost the same neighbours. So the tree is descended once for all of them, and each then looks
only at the boxes of the leaves that were found, and at the points of those that it reaches.
"""

from __future__ import annotations

from typing import NamedTuple

import numba as nb
import numpy as np

from gsseg_core.simd import squared_distances, store_row
from gsseg_core.spatial.kd_tree import LEAF, Tree, gap, leaf_of, leaf_range

CHUNK = 256  # consecutive points of one thread
DEPTH = 64  # nodes that can wait at once; a descent leaves at most one behind at each level
FAR = np.float32(np.inf)
NO_SKIP = np.zeros(0, np.int32)


class LeafCandidates(NamedTuple):
    """At most n leaves near the points of one leaf, and distances to their points: scratch of one thread."""

    nodes: np.ndarray  # (DEPTH,) int64: nodes still to be looked at
    leaves: np.ndarray  # (n,) int64
    corners: np.ndarray  # (6, n) float32: boxes of the leaves
    gaps: np.ndarray  # (n,) float32: squared distances from a point to the boxes
    reached: np.ndarray  # (n,) int32: which of the leaves the point reaches
    near: np.ndarray  # (n, LEAF) float32: squared distances to the points of these


@nb.njit
def scratch_for(count: int) -> LeafCandidates:
    """Allocate the scratch of one thread for so many leaves."""
    return LeafCandidates(
        np.empty(DEPTH, np.int64), np.empty(count, np.int64), np.empty((6, count), np.float32),
        np.empty(count, np.float32), np.empty(count, np.int32), np.empty((count, LEAF), np.float32),
    )  # fmt: skip


@nb.njit
def end_of_group(tree: Tree, places: np.ndarray, first: int) -> int:
    """Where the points of a chunk of ascending places, (M,) int32, end that are in the same leaf as place `first`."""
    n, leaves = tree.points.shape[1], len(tree.blocks)
    end, limit = leaf_range(leaf_of(places[first], leaves, n), leaves, n)[1], (first // CHUNK + 1) * CHUNK
    last = first + 1
    while last < min(limit, len(places)) and places[last] < end:
        last += 1
    return last


@nb.njit
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


@nb.njit
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


@nb.njit
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
