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
from gsseg_core.spatial.kd_tree import LEAF, Tree, leaf_range
from gsseg_core.spatial.neighbourhood import Found, Neighbours, nodes_without
from gsseg_core.spatial.row_order import rows_by_label

MIXED = np.int32(-(2**31))  # stands for the label of a node whose points have several
NOBODY = MIXED + 1  # the label of no point


def class_distances(neighbours: Neighbours, labels: np.ndarray, num_classes: int) -> np.ndarray:  # (N,) int
    """Mean distance to the k nearest others of the same class, or to all if there are not as many: (N,) float64.

    It is in units of the scaled points; NaN where the label is not in 1 to `num_classes` - 1, and where a class has a
    single member.
    """
    tree, k = neighbours.tree, neighbours.k
    of_point = labels[tree.order].astype(np.int32)
    of_point[(of_point >= num_classes) | (of_point < 0)] = 0
    before = neighbours.by_class or Found.nothing(len(of_point))
    radii, found = before.radii.copy(), before.distances.copy()
    wanted = _to_be_found(tree, of_point, before, k)
    neighbours.look_for(wanted)
    radii[of_point == 0], found[of_point == 0] = np.nan, np.nan
    pure = pure_distances(tree, of_point, wanted, neighbours.radii, neighbours.distances)
    found[wanted], radii[wanted] = pure[wanted], neighbours.radii[wanted]
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
    still = nodes_without(moved, len(tree.blocks))
    _want_those_near(tree, moved, still, labels, before.labels, before.radii, wanted)
    return wanted


@kernel(parallel=True)
def _want_those_near(
    tree: Tree, moved: np.ndarray, still: np.ndarray,  # (n,) bool, (2 L,) int32: 1 for nodes without any that moved
    labels: np.ndarray, before: np.ndarray, radii: np.ndarray,  # (n,) now; before; squared
    wanted: np.ndarray,  # (n,) bool, grows
) -> None:  # fmt: skip
    """Add the points of which one within the radius has come to their class, or left it."""
    leaves, n = len(tree.blocks), len(labels)
    for chunk in nb.prange((leaves + LEAF - 1) // LEAF):
        candidates = knn.scratch_for(128)
        for leaf in range(chunk * LEAF, min((chunk + 1) * LEAF, leaves)):
            first, last = leaf_range(leaf, leaves, n)
            widest = np.float32(-1)
            for q in range(first, last):
                if labels[q] > 0 and not wanted[q] and radii[q] > widest:
                    widest = radii[q]
            if widest < 0:
                continue
            box = tree.boxes[leaves + leaf]
            candidates, found = knn.find_leaves(tree.boxes, box, widest, still, np.int32(1), candidates)
            for q in range(first, last if found > 0 else first):
                if labels[q] > 0 and not wanted[q]:
                    reached = knn.measure(tree, q, radii[q], found, candidates)
                    wanted[q] = _is_near(moved, labels, before, labels[q], radii[q], reached, leaves, candidates)


@called_by_kernels
def _is_near(
    moved: np.ndarray, labels: np.ndarray, before: np.ndarray, label: int, radius: float, reached: int, leaves: int,
    candidates: knn.LeafCandidates,
) -> bool:  # fmt: skip
    """Whether a point that was measured and is within the radius has come to a class, or left it."""
    for h in range(reached):
        first, last = leaf_range(candidates.leaves[candidates.reached[h]], leaves, labels.shape[0])
        within = at_most(load_row(candidates.near, h), radius)
        for i in range(last - first):
            p = first + i
            if (within >> i) & 1 and moved[p] and (labels[p] == label or before[p] == label):
                return True
    return False


@kernel(parallel=True)
def pure_distances(
    tree: Tree, labels: np.ndarray, wanted: np.ndarray, radii: np.ndarray, distances: np.ndarray
) -> np.ndarray:
    """Distances of those points that are wanted, whose neighbours within the radius all have their label; else NaN.

    All arrays are (n,) in tree order, the labels of int32.
    """
    leaves, n = len(tree.blocks), len(labels)
    out, of_node = np.full(n, np.nan), _labels_of_nodes(labels, leaves)
    for chunk in nb.prange((leaves + LEAF - 1) // LEAF):
        candidates = knn.scratch_for(128)
        for leaf in range(chunk * LEAF, min((chunk + 1) * LEAF, leaves)):
            first, last = leaf_range(leaf, leaves, n)
            widest, label = np.float32(-1), of_node[leaves + leaf]
            for q in range(first, last):
                widest = max(widest, radii[q]) if wanted[q] else widest
            if widest < 0:
                continue
            # A node of the leaf's own label has nothing to say; a leaf of several labels has none.
            skipped = label if label != MIXED else NOBODY
            box = tree.boxes[leaves + leaf]
            candidates, found = knn.find_leaves(tree.boxes, box, widest, of_node, skipped, candidates)
            for q in range(first, last):
                if wanted[q]:
                    reached = knn.measure(tree, q, radii[q], found, candidates)
                    if _is_pure(labels, labels[q], radii[q], reached, leaves, candidates):
                        out[q] = distances[q]
    return out


@called_by_kernels
def _is_pure(
    labels: np.ndarray, label: int, radius: float, reached: int, leaves: int, candidates: knn.LeafCandidates
) -> bool:
    """Whether all points measured and within the radius have a label."""
    for h in range(reached):
        first, last = leaf_range(candidates.leaves[candidates.reached[h]], leaves, labels.shape[0])
        within = at_most(load_row(candidates.near, h), radius)
        for i in range(last - first):
            if (within >> i) & 1 and labels[first + i] != label:
                return False
    return True


@called_by_kernels
def _labels_of_nodes(labels: np.ndarray, leaves: int) -> np.ndarray:
    of_node = np.empty(2 * leaves, np.int32)
    for leaf in range(leaves):
        first, last = leaf_range(leaf, leaves, labels.shape[0])
        of_node[leaves + leaf] = labels[first] if (labels[first:last] == labels[first]).all() else MIXED
    for node in range(leaves - 1, 0, -1):
        of_node[node] = of_node[2 * node] if of_node[2 * node] == of_node[2 * node + 1] else MIXED
    return of_node
