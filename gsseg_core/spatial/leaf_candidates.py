"""Leaf candidates: the leaves near the points of a leaf, whose points each of these looks at in one vector.

The points of a leaf have almost the same neighbours. So the tree is descended once for all of them, and each then looks
only at the boxes of the leaves that were found, and at the points of those that it reaches.
"""

from __future__ import annotations

from typing import NamedTuple

import numba as nb
import numpy as np

from gsseg_core.simd import squared_distances, store_row
from gsseg_core.spatial.kd_tree import LEAF, gap_to_box, leaf_of, leaf_range

DEPTH = 64  # nodes that can wait at once; a descent leaves at most one behind at each level
FAR = np.float32(np.inf)


class LeafCandidates(NamedTuple):
    """Leaves near the points of one leaf, and distances to their points: scratch of one thread, for at most n leaves.

    Attributes
    ----------
    nodes : (DEPTH,) int64
        Nodes still to be looked at.
    leaves : (n,) int64
        The leaves.
    corners : (6, n) float32
        Their boxes.
    gaps : (n,) float32
        Squared distances from a point to the boxes.
    reached : (n,) int32
        Which of the leaves the point reaches.
    near : (n, LEAF) float32
        Squared distances to the points of these.
    """

    nodes: np.ndarray
    leaves: np.ndarray
    corners: np.ndarray
    gaps: np.ndarray
    reached: np.ndarray
    near: np.ndarray


@nb.njit
def scratch_for(count: int) -> LeafCandidates:
    """Allocate the scratch of one thread for so many leaves."""
    return LeafCandidates(
        np.empty(DEPTH, np.int64),
        np.empty(count, np.int64),
        np.empty((6, count), np.float32),
        np.empty(count, np.float32),
        np.empty(count, np.int32),
        np.empty((count, LEAF), np.float32),
    )


@nb.njit
def end_of_group(places: np.ndarray, first: int, limit: int, leaves: int, n: int) -> int:
    """Where the points end that are in the same leaf as place `first`."""
    end = leaf_range(leaf_of(places[first], leaves, n), leaves, n)[1]
    last = first + 1
    while last < limit and places[last] < end:
        last += 1
    return last


@nb.njit
def find_leaves(
    boxes: np.ndarray,  # (2 L, 6)
    box: np.ndarray,  # (6,)
    reach: float,  # squared
    skip: np.ndarray,  # (2 L,) int32, or (0,): nodes to leave out are
    skipped: int,  # those with this number there
    candidates: LeafCandidates,
) -> tuple[LeafCandidates, int]:
    """Find the leaves at most so far from a box; returns them, in larger scratch if need be, and their number."""
    found = _descend(boxes, box, reach, skip, skipped, candidates.nodes, candidates.leaves)
    if found > candidates.leaves.shape[0]:
        candidates = scratch_for(2 * found)
        _descend(boxes, box, reach, skip, skipped, candidates.nodes, candidates.leaves)
    _copy_corners(boxes, candidates.leaves[:found], candidates.corners)
    return candidates, found


@nb.njit
def _descend(
    boxes: np.ndarray,
    box: np.ndarray,
    reach: float,
    skip: np.ndarray,
    skipped: int,
    nodes: np.ndarray,
    near: np.ndarray,
) -> int:
    """Find the leaves, and note as many as fit; returns how many there are."""
    leaves, found, waiting = boxes.shape[0] // 2, 0, 1
    nodes[0] = 1
    while waiting:
        waiting -= 1
        node = nodes[waiting]
        if gap_to_box(boxes, node, box) > reach or (skip.shape[0] > 0 and skip[node] == skipped):
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
def _copy_corners(boxes: np.ndarray, near: np.ndarray, corners: np.ndarray) -> None:
    for c in range(near.shape[0]):
        for d in range(6):
            corners[d, c] = boxes[boxes.shape[0] // 2 + near[c], d]


@nb.njit
def measure(
    blocks: np.ndarray,  # (L, 3, LEAF)
    x: float,
    y: float,
    z: float,
    reach: float,  # squared
    found: int,
    candidates: LeafCandidates,
) -> int:
    """Measure how far the points of the leaves within reach are, into `candidates.near`; returns how many leaves."""
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
        store_row(candidates.near, h, squared_distances(blocks, 3 * candidates.leaves[reached[h]], x, y, z))
    return hits
