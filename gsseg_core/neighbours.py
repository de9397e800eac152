"""Distances from many points to their k nearest others, and means over those.

A k-d tree whose queries follow each other in space. Two neighbouring queries have almost the same answer, and by the
triangle inequality the radius of one bounds the radius of the next, so that few points are looked at.

Results are bit-identical whatever the order of the points and the number of threads: points tied for the last place
among the k nearest share it equally, and sums are taken over whole numbers (steps of 2^-40), where order is no matter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba as nb
import numpy as np

LEAF = 16
"""Most points in a leaf of the tree."""

FIXED = float(1 << 40)
"""Sums are in steps of 1 / FIXED. Nothing summed exceeds 4, so that 2^20 neighbours fit into int64."""

SUBTREE = 8  # levels of a subtree that one thread builds alone: about 4000 points
CHUNK = 256  # consecutive queries of one thread, each bounded by the one before
SLACK = np.float32(1.00001)  # covers float32 rounding in a bound
TINY = np.float32(1e-30)


def scaled(means: np.ndarray) -> np.ndarray:
    """Scale (N, 3) float32 into [-1, 1] by a power of two: nothing is rounded, and no distance can overflow."""
    points = np.asarray(means, np.float32)
    largest = max(points.max(initial=0), -points.min(initial=0))
    scaled: np.ndarray = np.ldexp(points, -np.frexp(largest)[1])
    return scaled


@dataclass(frozen=True)
class Tree:
    """A balanced k-d tree without pointers: node i has the children 2i and 2i + 1, and the root is 1.

    With L leaves, a power of two, leaf i is node L + i and holds points i * n // L to (i + 1) * n // L.

    Attributes
    ----------
    points : (3, n) float32
        In tree order: what is near in the array is near in space.
    order : (n,) int32
        Which of the points that went in each one is.
    boxes : (2 L, 6) float32
        Lowest and highest corner of each node's points.
    """

    points: np.ndarray
    order: np.ndarray
    boxes: np.ndarray

    @classmethod
    def build(cls, points: np.ndarray) -> Tree:
        """Build from (n, 3) float32, n > 0."""
        depth = ((len(points) - 1) // LEAF).bit_length()
        points, order = points.copy(), np.arange(len(points), dtype=np.int32)
        boxes = np.empty((2 << depth, 6), np.float32)
        if depth > SUBTREE:
            _grow(points, order, boxes, depth)
        else:  # waking other threads would take longer than the work
            _grow_subtree(points, order, boxes, depth, 0, 0)
        return cls(np.ascontiguousarray(points.T), order, boxes)


@nb.njit(parallel=True, nogil=True, cache=True)
def _grow(points: np.ndarray, order: np.ndarray, boxes: np.ndarray, depth: int) -> None:
    top = max(depth - SUBTREE, 0)
    for level in range(top):
        for j in nb.prange(1 << level):
            _split(points, order, boxes, depth, level, j)
    for j in nb.prange(1 << top):
        _grow_subtree(points, order, boxes, depth, top, j)


@nb.njit(nogil=True, cache=True)
def _grow_subtree(points: np.ndarray, order: np.ndarray, boxes: np.ndarray, depth: int, top: int, root: int) -> None:
    for level in range(top, depth + 1):
        for j in range(root << (level - top), (root + 1) << (level - top)):
            _split(points, order, boxes, depth, level, j)


@nb.njit
def _split(points: np.ndarray, order: np.ndarray, boxes: np.ndarray, depth: int, level: int, j: int) -> None:
    """Box node j of a level in, and unless it is a leaf bring the lower half along its widest axis to the front."""
    n = points.shape[0]
    node, first, last = (1 << level) + j, (j * n) >> level, ((j + 1) * n) >> level
    widest, axis = np.float32(-1), 0
    for d in range(3):
        low = high = points[first, d]
        for i in range(first + 1, last):
            low, high = min(low, points[i, d]), max(high, points[i, d])
        boxes[node, d], boxes[node, 3 + d] = low, high
        if high - low > widest:
            widest, axis = high - low, d
    if level < depth:
        _partition(points, order, first, last - 1, ((2 * j + 1) * n) >> (level + 1), axis)


@nb.njit
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


@nb.njit(parallel=True, nogil=True, cache=True)
def nearest(
    points: np.ndarray,  # (3, n)
    boxes: np.ndarray,  # (2 L, 6)
    queries: np.ndarray,  # (3, M)
    k: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Find the squared distance to the k-th nearest point, (M,) float32, and the sum of k distances, (M,) float64."""
    m = queries.shape[1]
    radii, sums = np.empty(m, np.float32), np.empty(m, np.float64)
    for chunk in nb.prange((m + CHUNK - 1) // CHUNK):
        near = np.empty(3 * k + LEAF, np.float32)
        nodes, gaps = np.empty(64, np.int64), np.empty(64, np.float32)
        bound = np.float32(np.inf)
        for q in range(chunk * CHUNK, min((chunk + 1) * CHUNK, m)):
            x, y, z = queries[0, q], queries[1, q], queries[2, q]
            if q > chunk * CHUNK:
                dx, dy, dz = queries[0, q - 1] - x, queries[1, q - 1] - y, queries[2, q - 1] - z
                reach = np.sqrt(dx * dx + dy * dy + dz * dz) + np.sqrt(radii[q - 1])
                bound = max(reach * reach * SLACK, TINY)
            found = _search(points, boxes, x, y, z, k, bound, near, nodes, gaps)
            radius = _smallest(near, found, k)
            total, inside = np.int64(0), np.int64(0)
            for i in range(found):
                if near[i] < radius:
                    total += np.int64(np.float64(np.sqrt(near[i])) * FIXED)
                    inside += 1
            total += (k - inside) * np.int64(np.float64(np.sqrt(radius)) * FIXED)
            radii[q], sums[q] = radius, total / FIXED
    return radii, sums


@nb.njit
def _search(
    points: np.ndarray,  # (3, n)
    boxes: np.ndarray,  # (2 L, 6)
    x: float,
    y: float,
    z: float,
    k: int,
    bound: float,  # above the k-th smallest squared distance
    near: np.ndarray,  # (3 k + LEAF,), filled
    nodes: np.ndarray,  # (64,), scratch
    gaps: np.ndarray,  # (64,), scratch
) -> int:
    """Collect squared distances to points, the k smallest among them, in no order; return their number."""
    leaves, n = boxes.shape[0] // 2, points.shape[1]
    found, waiting = 0, 1
    nodes[0], gaps[0] = 1, 0
    while waiting:
        waiting -= 1
        node, gap = nodes[waiting], gaps[waiting]
        while node < leaves and gap < bound:  # go down to the nearer child, the other one waits
            node, other = 2 * node, 2 * node + 1
            gap, other_gap = _gap(boxes, node, x, y, z), _gap(boxes, other, x, y, z)
            if other_gap < gap:
                node, gap, other, other_gap = other, other_gap, node, gap
            if other_gap < bound:
                nodes[waiting], gaps[waiting] = other, other_gap
                waiting += 1
        if gap >= bound:
            continue
        first, last = (node - leaves) * n // leaves, (node - leaves + 1) * n // leaves
        if found + last - first > near.shape[0]:
            bound = _smallest(near, found, k)
            kept = 0
            for i in range(found):
                distance = near[i]
                if distance < bound:
                    near[kept] = distance
                    kept += 1
            near[kept:k] = bound
            found = k
        for i in range(first, last):
            dx, dy, dz = points[0, i] - x, points[1, i] - y, points[2, i] - z
            distance = dx * dx + dy * dy + dz * dz
            near[found] = distance  # without a branch: what is not counted is overwritten
            found += distance < bound
    return found


@nb.njit(inline="always")
def _gap(boxes: np.ndarray, node: int, x: float, y: float, z: float) -> np.float32:
    """Squared distance to a box, in float32 never above that to a point inside it, since rounding is monotonic."""
    dx = max(max(boxes[node, 0] - x, x - boxes[node, 3]), np.float32(0))
    dy = max(max(boxes[node, 1] - y, y - boxes[node, 4]), np.float32(0))
    dz = max(max(boxes[node, 2] - z, z - boxes[node, 5]), np.float32(0))
    squared: np.float32 = dx * dx + dy * dy + dz * dz
    return squared


@nb.njit
def _smallest(values: np.ndarray, n: int, k: int) -> np.float32:
    """k-th smallest of the first n values, float32 and none negative.

    Such floats sort like their bits, so this bisects the bits: counting what is at most the middle takes a few vector
    instructions, has no branch to mispredict and moves nothing.
    """
    bits = values.view(np.int32)
    low, high = np.int32(0), np.int32(0)
    for i in range(n):
        high = max(high, bits[i])
    while low < high:
        middle = low + ((high - low) >> np.int32(1))
        count = np.int32(0)
        for i in range(n):
            count += np.int32(bits[i] <= middle)
        if count >= k:
            high = middle
        else:
            low = middle + np.int32(1)
    smallest: np.float32 = np.float32(0)
    for i in range(n):
        if bits[i] == low:
            smallest = values[i]
    return smallest


@nb.njit(parallel=True, nogil=True, cache=True)
def average(
    points: np.ndarray,  # (3, n)
    boxes: np.ndarray,  # (2 L, 6)
    ids: np.ndarray,  # (n,), row of each point's code
    codes: np.ndarray,  # (N, K)
    queries: np.ndarray,  # (3, M)
    radii: np.ndarray,  # (M,), squared distance to the k-th nearest
    k: int,
    into: np.ndarray,  # (M,), row of each query's result
    out: np.ndarray,  # (N, K), written
) -> None:
    """Mean code of the k nearest points; those exactly at the radius share the places that are left."""
    leaves, n = boxes.shape[0] // 2, points.shape[1]
    m, num_classes = queries.shape[1], codes.shape[1]
    for chunk in nb.prange((m + CHUNK - 1) // CHUNK):
        sums = np.empty((2, num_classes), np.int64)  # inside the radius, and on it
        counts = np.empty(2, np.int64)
        nodes = np.empty(64, np.int64)
        for q in range(chunk * CHUNK, min((chunk + 1) * CHUNK, m)):
            x, y, z, radius = queries[0, q], queries[1, q], queries[2, q], radii[q]
            sums[:], counts[:] = 0, 0
            nodes[0], waiting = 1, 1
            while waiting:
                waiting -= 1
                node = nodes[waiting]
                if _gap(boxes, node, x, y, z) > radius:
                    continue
                if node < leaves:
                    nodes[waiting], nodes[waiting + 1] = 2 * node, 2 * node + 1
                    waiting += 2
                    continue
                for i in range((node - leaves) * n // leaves, (node - leaves + 1) * n // leaves):
                    dx, dy, dz = points[0, i] - x, points[1, i] - y, points[2, i] - z
                    distance = dx * dx + dy * dy + dz * dz
                    if distance <= radius:
                        tied, row = np.int64(distance == radius), ids[i]
                        counts[tied] += 1
                        for c in range(num_classes):
                            sums[tied, c] += np.int64(np.float64(codes[row, c]) * FIXED)
            share = (k - counts[0]) / counts[1]
            for c in range(num_classes):
                out[into[q], c] = (sums[0, c] + share * sums[1, c]) / (k * FIXED)
