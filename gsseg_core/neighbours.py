"""Distances from every point to its k nearest others, found once per scene, and means over those.

A k-d tree whose queries follow each other in space. Two neighbouring queries have almost the same answer, and by the
triangle inequality the radius of one bounds the radius of the next, so that few points are looked at. What is kept is
not who the neighbours are but how far the k-th one is: with it, all of them are found again by one descent of the tree,
and a million points take 16 MB instead of 200.

Results are bit-identical whatever the order of the points and the number of threads: points tied for the last place
among the k nearest share it equally, and sums are taken over whole numbers, where order is no matter.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numba as nb
import numpy as np

from gsseg_core.rows import Rows
from gsseg_core.scene import GaussianScene

LEAF = 16
"""Most points in a leaf of the tree."""

FIXED = float(1 << 40)
"""Distances are summed in steps of 1 / FIXED. None exceeds 4, so that 2^20 of them fit into int64."""

CODE_UNIT = 2.0**-24
"""Codes are summed in steps of this, which is the precision of a float32 near 1."""

SUBTREE = 8  # levels of a subtree that one thread builds alone: about 4000 points
BLOCK = 1 << 16  # points whose mean codes are written out at once
CHUNK = 256  # consecutive queries of one thread, each bounded by the one before
SLACK = np.float32(1.00001)  # covers float32 rounding in a bound
TINY = np.float32(1e-30)


@dataclass(frozen=True, eq=False)
class Neighbours:
    """How far the k nearest others of every point are.

    Attributes
    ----------
    k : int
        Number of neighbours; N - 1 if there are not as many.
    tree : Tree
        The points, all arrays here being in its order.
    radii : (N,) float32
        Squared distance to the k-th nearest other, in units of the scaled points.
    distances : (N,) float64
        Mean distance to the k nearest others, in the same units.
    """

    k: int
    tree: Tree
    radii: np.ndarray
    distances: np.ndarray

    @classmethod
    def find(
        cls,
        means: np.ndarray,  # (N, 3) float32, finite
        k: int,
    ) -> Neighbours:
        """Find them, for N > 1."""
        tree, k = Tree.build(scaled(means)), min(k, len(means) - 1)
        radii, distances = nearest(tree.points, tree.boxes, np.arange(len(means), dtype=np.int32), k)
        return cls(k, tree, radii, distances)

    def mean_codes(
        self,
        codes: Rows,  # N rows of K classes, float32 in [0, 1]
        counted: np.ndarray,  # (N,) bool
        num_classes: int,
        wanted: np.ndarray | None = None,  # (N,) bool
    ) -> Rows:
        """Mean code of those of the k nearest others that are counted, for all points or for those wanted.

        Returns
        -------
        Rows
            N rows; one without entries where there is no such neighbour, or the point is not wanted.
        """
        order, tree = self.tree.order, self.tree
        of_points = codes.places(order)
        values = codes.values[of_points.values]
        values[np.repeat(~counted[order], np.diff(of_points.start))] = 0.0
        units = np.rint(values * np.float32(1 / CODE_UNIT)).astype(np.int32)
        asked = np.arange(len(order)) if wanted is None else np.flatnonzero(wanted[order])
        # A block at a time is written out in full, so that of all the codes only what is not zero is ever in memory.
        parts = []
        for first in range(0, max(len(asked), 1), BLOCK):
            places = asked[first : first + BLOCK].astype(np.int32)
            out = np.zeros((len(places), num_classes), np.float32)
            average(
                tree.points, tree.boxes, of_points.start, of_points.classes, units, counted[order], places,
                self.radii, self.k, out,
            )  # fmt: skip
            parts.append(Rows.of(out))
        return Rows.joined(parts).moved(order[asked], len(order))

    def mean_distances(
        self,
        labels: np.ndarray,  # (N,) int
    ) -> np.ndarray:
        """Mean distance to the k nearest others if all of these have the point's own positive label, else NaN: (N,)."""
        order, tree = self.tree.order, self.tree
        out = np.full(len(order), np.nan)
        out[order] = pure_distances(tree.points, tree.boxes, labels[order].astype(np.int32), self.radii, self.distances)
        return out


_KNOWN: WeakKeyDictionary[GaussianScene, Neighbours] = WeakKeyDictionary()
_FINDING = threading.Lock()


def neighbours_of(scene: GaussianScene, k: int) -> Neighbours | None:
    """Find the neighbours of a scene's Gaussians, once: they are kept with it. None if it has a single Gaussian."""
    if len(scene) < 2:
        return None
    # Whoever asks while another thread looks waits for that one.
    with _FINDING:
        known = _KNOWN.get(scene)
        if known is None or known.k != min(k, len(scene) - 1):
            known = _KNOWN[scene] = Neighbours.find(scene.means, k)
        return known


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
    places: np.ndarray,  # (M,) int32, which points to look from
    k: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Find the squared distance to the k-th nearest other point, (M,) float32, and the mean of the k, (M,) float64."""
    m = places.shape[0]
    radii, distances = np.empty(m, np.float32), np.empty(m, np.float64)
    for chunk in nb.prange((m + CHUNK - 1) // CHUNK):
        near = np.empty(3 * k + LEAF, np.float32)
        nodes, gaps = np.empty(64, np.int64), np.empty(64, np.float32)
        bound = np.float32(np.inf)
        for q in range(chunk * CHUNK, min((chunk + 1) * CHUNK, m)):
            own = places[q]
            x, y, z = points[0, own], points[1, own], points[2, own]
            if q > chunk * CHUNK:
                last = places[q - 1]
                dx, dy, dz = points[0, last] - x, points[1, last] - y, points[2, last] - z
                reach = np.sqrt(dx * dx + dy * dy + dz * dz) + np.sqrt(radii[q - 1])
                bound = max(reach * reach * SLACK, TINY)
            found = _search(points, boxes, own, k, bound, near, nodes, gaps)
            radius = _smallest(near, found, k)
            total, inside = np.int64(0), np.int64(0)
            for i in range(found):
                if near[i] < radius:
                    total += np.int64(np.float64(np.sqrt(near[i])) * FIXED)
                    inside += 1
            total += (k - inside) * np.int64(np.float64(np.sqrt(radius)) * FIXED)
            radii[q], distances[q] = radius, total / FIXED / k
    return radii, distances


@nb.njit
def _search(
    points: np.ndarray,  # (3, n)
    boxes: np.ndarray,  # (2 L, 6)
    own: int,
    k: int,
    bound: float,  # above the k-th smallest squared distance
    near: np.ndarray,  # (3 k + LEAF,), filled
    nodes: np.ndarray,  # (64,), scratch
    gaps: np.ndarray,  # (64,), scratch
) -> int:
    """Collect squared distances to other points, the k smallest among them, in no order; return their number."""
    x, y, z = points[0, own], points[1, own], points[2, own]
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
            found += (distance < bound) & (i != own)
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
    rows: np.ndarray,  # (n + 1,) codes, as `Rows`
    classes: np.ndarray,  # (Z,)
    units: np.ndarray,  # (Z,) int32, in steps of CODE_UNIT
    counted: np.ndarray,  # (n,) bool
    places: np.ndarray,  # (M,) int32
    radii: np.ndarray,  # (n,), squared distance to the k-th nearest other
    k: int,
    out: np.ndarray,  # (M, K) in: zeros; out: mean codes, zeros where no neighbour counts
) -> None:
    """Mean code of the k nearest others that count; those exactly at the radius share the places that are left."""
    leaves, n = boxes.shape[0] // 2, points.shape[1]
    m, num_classes = places.shape[0], out.shape[1]
    for chunk in nb.prange((m + CHUNK - 1) // CHUNK):
        sums = np.empty((2, num_classes), np.int64)  # inside the radius, and on it
        counts = np.empty((2, 2), np.int64)  # the same, and of these the ones that count
        nodes = np.empty(64, np.int64)
        for q in range(chunk * CHUNK, min((chunk + 1) * CHUNK, m)):
            own = places[q]
            x, y, z, radius = points[0, own], points[1, own], points[2, own], radii[own]
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
                    if distance <= radius and i != own:
                        tied = np.int64(distance == radius)
                        counts[tied, 0] += 1
                        if counted[i]:
                            counts[tied, 1] += 1
                            for e in range(rows[i], rows[i + 1]):
                                sums[tied, classes[e]] += units[e]
            if counts[0, 1] + counts[1, 1] > 0:
                share = (k - counts[0, 0]) / counts[1, 0]
                total = (counts[0, 1] + share * counts[1, 1]) / CODE_UNIT
                for c in range(num_classes):
                    out[q, c] = (sums[0, c] + share * sums[1, c]) / total


@nb.njit(parallel=True, nogil=True, cache=True)
def pure_distances(
    points: np.ndarray,  # (3, n)
    boxes: np.ndarray,  # (2 L, 6)
    labels: np.ndarray,  # (n,) int32
    radii: np.ndarray,  # (n,)
    distances: np.ndarray,  # (n,)
) -> np.ndarray:
    """Distances of the points whose neighbours within the radius all have their own, positive, label; else NaN."""
    leaves, n = boxes.shape[0] // 2, points.shape[1]
    out = np.full(n, np.nan)
    for chunk in nb.prange((n + CHUNK - 1) // CHUNK):
        nodes = np.empty(64, np.int64)
        for q in range(chunk * CHUNK, min((chunk + 1) * CHUNK, n)):
            x, y, z, radius, label = points[0, q], points[1, q], points[2, q], radii[q], labels[q]
            pure = label > 0
            nodes[0], waiting = 1, 1
            while waiting and pure:
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
                    if labels[i] != label and dx * dx + dy * dy + dz * dz <= radius:
                        pure = False
                        break
            if pure:
                out[q] = distances[q]
    return out
