"""A balanced k-d tree without pointers, in whose order what is near in space is near in memory."""

from __future__ import annotations

from typing import NamedTuple

import numba as nb
import numpy as np

from gsseg_core.kernels.compiler import called_by_kernels, kernel
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.scene_cache import PerScene

LEAF = 16  # most points in a leaf of the tree
MIXED = np.int32(-(2**31))  # stands for the value of a node whose points have several
SUBTREE = 8  # levels of a subtree that one thread builds alone: about 4000 points


class Tree(NamedTuple):
    """A balanced k-d tree without pointers: node i has the children 2i and 2i + 1, and the root is 1.

    With L leaves, a power of two, leaf i is node L + i and holds points i * n // L to (i + 1) * n // L.
    """

    points: np.ndarray  # (3, n) float32, in tree order: what is near in the array is near in space
    order: np.ndarray  # (n,) int32: which of the points that went in each one is
    boxes: np.ndarray  # (2 L, 6) float32: lowest and highest corner of each node's points
    blocks: np.ndarray  # (L, 3, LEAF) float32: the points leaf by leaf; those that a leaf lacks are infinitely far away

    @classmethod
    def build(cls, points: np.ndarray) -> Tree:
        """Halve points, (n, 3) float32 with n > 0, along their widest axis, again and again."""
        depth, points, order = _depth(len(points)), points.copy(), np.arange(len(points), dtype=np.int32)
        if depth > SUBTREE:
            _grow(points, order, depth)
        else:  # waking other threads would take longer than the work
            _grow_subtree(points, order, depth, 0, 0)
        points = np.ascontiguousarray(points.T)
        return cls(points, order, *_leaves(points, 1 << depth))

    def part(self, places: np.ndarray) -> Tree:
        """Make a tree of the points at some places, (m,) ascending with m > 0, in the order that they have here."""
        points = np.ascontiguousarray(self.points[:, places])
        return Tree(points, self.order[places], *_leaves(points, 1 << _depth(len(places))))


def scaled(means: np.ndarray) -> np.ndarray:
    """Scale (N, 3) float32 into [-1, 1] by a power of two: nothing is rounded, and no distance can overflow."""
    points = np.asarray(means, np.float32)
    largest = max(points.max(initial=0), -points.min(initial=0))
    return np.ldexp(points, -np.frexp(largest)[1])


_KNOWN: PerScene[Tree] = PerScene()


def tree_of(scene: GaussianScene) -> Tree:
    """Build the tree of a scene's centres, scaled, once: it is kept with it. There must be one."""
    return _KNOWN.of(scene, lambda: Tree.build(scaled(scene.means)))


def _depth(count: int) -> int:
    return ((count - 1) // LEAF).bit_length()


@kernel(parallel=True)
def _grow(points: np.ndarray, order: np.ndarray, depth: int) -> None:
    top = depth - SUBTREE
    for level in range(top):
        for j in nb.prange(1 << level):
            _split(points, order, level, j)
    for j in nb.prange(1 << top):
        _grow_subtree(points, order, depth, top, j)


@kernel
def _grow_subtree(points: np.ndarray, order: np.ndarray, depth: int, top: int, root: int) -> None:
    for level in range(top, depth):
        for j in range(root << (level - top), (root + 1) << (level - top)):
            _split(points, order, level, j)


@called_by_kernels
def _split(points: np.ndarray, order: np.ndarray, level: int, j: int) -> None:
    """Bring the lower half of node j of a level, along its widest axis, to the front."""
    n = points.shape[0]
    first, last = (j * n) >> level, ((j + 1) * n) >> level
    widest, axis = np.float32(-1), 0
    for d in range(3):
        low = high = points[first, d]
        for i in range(first + 1, last):
            low, high = min(low, points[i, d]), max(high, points[i, d])
        if high - low > widest:
            widest, axis = high - low, d
    _partition(points, order, first, last - 1, ((2 * j + 1) * n) >> (level + 1), axis)


@called_by_kernels
def _partition(points: np.ndarray, order: np.ndarray, low: int, high: int, middle: int, axis: int) -> None:
    """Quickselect of rows low to high (inclusive): those before `middle` get the smallest coordinates."""
    while low < high:
        a, b, c = points[low, axis], points[(low + high) // 2, axis], points[high, axis]
        pivot = max(min(a, b), min(max(a, b), c))
        i, j = low, high
        while i <= j:
            while points[i, axis] < pivot:
                i += 1
            while points[j, axis] > pivot:
                j -= 1
            if i <= j:
                for d in range(3):
                    points[i, d], points[j, d] = points[j, d], points[i, d]
                order[i], order[j] = order[j], order[i]
                i, j = i + 1, j - 1
        if middle <= j:
            high = j
        elif middle >= i:
            low = i
        else:
            return


@kernel(parallel=True)
def _leaves(points: np.ndarray, leaves: int) -> tuple[np.ndarray, np.ndarray]:
    """Make the boxes of all nodes, and the blocks of the leaves, of points (3, n) in tree order."""
    boxes, blocks = np.empty((2 * leaves, 6), np.float32), np.full((leaves, 3, LEAF), np.float32(np.inf))
    for leaf in nb.prange(leaves):
        first, last = leaf_range(leaf, leaves, points.shape[1])
        for d in range(3):
            low = high = points[d, first]
            for i in range(first, last):
                blocks[leaf, d, i - first] = points[d, i]
                low, high = min(low, points[d, i]), max(high, points[d, i])
            boxes[leaves + leaf, d], boxes[leaves + leaf, 3 + d] = low, high
    for node in range(leaves - 1, 0, -1):
        for d in range(3):
            boxes[node, d] = min(boxes[2 * node, d], boxes[2 * node + 1, d])
            boxes[node, 3 + d] = max(boxes[2 * node, 3 + d], boxes[2 * node + 1, 3 + d])
    return boxes, blocks


@kernel(parallel=True)
def values_of_nodes(values: np.ndarray, leaves: int) -> np.ndarray:  # (n,) bool or int32, in tree order
    """Value that all points of a node have, (2 L,) int32, or `MIXED`."""
    of_node = np.empty(2 * leaves, np.int32)
    for leaf in nb.prange(leaves):
        first, last = leaf_range(leaf, leaves, len(values))
        alike = True
        for i in range(first + 1, last):
            alike &= values[i] == values[first]
        of_node[leaves + leaf] = values[first] if alike else MIXED
    for node in range(leaves - 1, 0, -1):
        of_node[node] = of_node[2 * node] if of_node[2 * node] == of_node[2 * node + 1] else MIXED
    return of_node


@nb.njit(inline="always")
def leaf_range(leaf: int, leaves: int, n: int) -> tuple[int, int]:
    """First and last point of a leaf, the last one excluded."""
    return leaf * n // leaves, (leaf + 1) * n // leaves


@nb.njit(inline="always")
def leaf_of(place: int, leaves: int, n: int) -> int:
    """Which leaf holds a point."""
    leaf = int(np.int64(place) * leaves // n)  # of an int32 the product would not fit
    while (leaf + 1) * n // leaves <= place:
        leaf += 1
    return leaf


@nb.njit(inline="always")
def gap(boxes: np.ndarray, node: int, box: np.ndarray | tuple[float, ...]) -> np.float32:
    """Squared distance of a node's box to another, (6,): lowest and highest corner, or a point twice.

    In float32 it is never above that between a point in the one and a point in the other, as rounding is monotonic.
    """
    dx = max(max(boxes[node, 0] - box[3], box[0] - boxes[node, 3]), np.float32(0))
    dy = max(max(boxes[node, 1] - box[4], box[1] - boxes[node, 4]), np.float32(0))
    dz = max(max(boxes[node, 2] - box[5], box[2] - boxes[node, 5]), np.float32(0))
    return dx * dx + dy * dy + dz * dz
