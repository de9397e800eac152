"""Mean distances from points to their k nearest others of the same class, as labels change from one time to the next.

What was found is kept with the labels that it was found for. A distance depends on the points of its class that are no
farther than the k-th of them; where none of these has come or gone, it still holds. So after a few labels have changed
only those are found anew that lie near them, and results are the same bits as of all.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from gsseg_core.kernels.compiler import called_by_kernels, kernel
from gsseg_core.simd import at_most, load_row
from gsseg_core.spatial import knn
from gsseg_core.spatial.kd_tree import LEAF, MIXED, Tree, leaf_range, values_of_nodes
from gsseg_core.spatial.neighbourhood import Found, Neighbours
from gsseg_core.spatial.row_order import rows_by_label

NOBODY = np.int32(MIXED + 1)  # the label of no point


def class_distances(neighbours: Neighbours, labels: np.ndarray) -> np.ndarray:  # (N,) int
    """Mean distance to the k nearest others of the same class, or to all if there are not as many: (N,) float64.

    It is in units of the scaled points; NaN where the label is not above 0, and where a class has a single member.
    """
    tree, k = neighbours.tree, neighbours.k
    of_point = np.maximum(labels[tree.order], 0).astype(np.int32)
    before = neighbours.by_class or Found.nothing(len(of_point))
    radii, found = before.radii.copy(), before.distances.copy()
    wanted = _to_be_found(tree, of_point, before, k)
    neighbours.look_for(wanted)
    radii[of_point == 0], found[of_point == 0] = np.nan, np.nan
    # Where all neighbours are of a point's own class, these are what is looked for.
    leaves = len(tree.blocks)
    of_node = values_of_nodes(of_point, leaves)
    of_leaf = np.where(of_node[leaves:] == MIXED, NOBODY, of_node[leaves:])
    met = _meet(tree, wanted, neighbours.radii, of_node, of_leaf, of_point, of_point, None)
    found[wanted] = np.where(met, np.nan, neighbours.distances)[wanted]
    radii[wanted] = neighbours.radii[wanted]
    for label, members in rows_by_label(of_point).items():
        mixed = np.flatnonzero(wanted[members] & np.isnan(found[members])).astype(np.int32)
        # Where other classes are among the neighbours, more of its own are looked for, farther away.
        if label and len(members) > 1 and len(mixed):
            places, nearest = members[mixed], min(k, len(members) - 1)
            radii[places], found[places] = knn.nearest(tree.part(members), mixed, nearest, False)[:2]
    neighbours.by_class = Found(of_point, radii, found)
    out = np.empty(len(labels))
    out[tree.order] = found
    return out


def _to_be_found(tree: Tree, labels: np.ndarray, before: Found, k: int) -> np.ndarray:
    """Mark the distances that may have changed, (n,) bool."""
    moved = labels != before.labels
    wanted = moved & (labels > 0)
    if not moved.any():
        return wanted
    count = int(max(labels.max(), before.labels.max())) + 1
    members, members_before = (np.bincount(of, minlength=count) for of in (labels, before.labels))
    few = (np.minimum(members - 1, k) != np.minimum(members_before - 1, k))[labels] & (labels > 0)
    wanted |= few
    leaves, asked = len(tree.blocks), (labels > 0) & ~wanted
    # Nodes in which none has moved have nothing to say.
    of_node, still = values_of_nodes(moved, leaves), np.zeros(leaves, np.int32)
    return wanted | _meet(tree, asked, before.radii, of_node, still, labels, before.labels, moved)


@kernel(parallel=True)
def _meet(
    tree: Tree, asked: np.ndarray, radii: np.ndarray,  # (n,) bool; (n,) float32, squared
    of_node: np.ndarray, skipped: np.ndarray,  # (2 L,), (L,) int32: nodes with this number need no look from a leaf
    labels: np.ndarray, before: np.ndarray,  # (n,) int32, now and before
    moved: np.ndarray | None,  # (n,) bool
) -> np.ndarray:  # fmt: skip
    """Tell which of the points asked for meet within their radius one that has moved into their class or out of it.

    Where nothing is said of moves, these are the points that meet one of another class. Returns (n,) bool.
    """
    leaves, n = len(tree.blocks), len(labels)
    met = np.zeros(n, np.bool_)
    for chunk in nb.prange((leaves + LEAF - 1) // LEAF):
        candidates = knn.scratch_for(128)
        for leaf in range(chunk * LEAF, min((chunk + 1) * LEAF, leaves)):
            first, last = leaf_range(leaf, leaves, n)
            widest = np.float32(-1)
            for q in range(first, last):
                if asked[q] and radii[q] > widest:
                    widest = radii[q]
            if widest < 0:
                continue
            box = tree.boxes[leaves + leaf]
            candidates, found = knn.find_leaves(tree.boxes, box, widest, of_node, skipped[leaf], candidates)
            for q in range(first, last if found > 0 else first):
                if asked[q]:
                    reached = knn.measure(tree, q, radii[q], found, candidates)
                    met[q] = _is_met(labels, before, moved, labels[q], radii[q], reached, leaves, candidates)
    return met


@called_by_kernels
def _is_met(
    labels: np.ndarray, before: np.ndarray, moved: np.ndarray | None, label: int, radius: float, reached: int,
    leaves: int, candidates: knn.LeafCandidates,
) -> bool:  # fmt: skip
    """Whether such a point, as `_meet` says, is among those that were measured and are within the radius."""
    for h in range(reached):
        first, last = leaf_range(candidates.leaves[candidates.reached[h]], leaves, labels.shape[0])
        within = at_most(load_row(candidates.near, h), radius)
        for i in range(last - first):
            if (within >> i) & 1:
                p = first + i
                if moved is None:
                    if labels[p] != label:
                        return True
                elif moved[p] and (labels[p] == label or before[p] == label):
                    return True
    return False
