"""Refinement of learnt probabilities: KNN clustering of unsure Gaussians, and a statistical filter per object.

Both steps are pure functions of positions and probabilities (or labels), take all classes at once, and say what they
changed. Both stand on the distances from many points to their k nearest others, so the search is the heart of this
module: a k-d tree whose queries follow each other in space. Two neighbouring queries have almost the same answer,
and by the triangle inequality the radius of one bounds the radius of the next, so that few points are looked at.

Results are bit-identical whatever the order of the Gaussians and the number of threads: points tied for the last place
among the k nearest share it equally, and sums are taken over whole numbers (steps of 2^-40), where order is no matter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba as nb
import numpy as np

from gsseg_core.errors import SettingsError

LEAF = 16
"""Most points in a leaf of the tree."""

FIXED = float(1 << 40)
"""Sums are in steps of 1 / FIXED. Nothing summed exceeds 4, so that 2^20 neighbours fit into int64."""

MAX_K = 1 << 20
SUBTREE = 8  # levels of a subtree that one thread builds alone: about 4000 points
CHUNK = 256  # consecutive queries of one thread, each bounded by the one before
SLACK = np.float32(1.00001)  # covers float32 rounding in a bound
TINY = np.float32(1e-30)


@dataclass(frozen=True)
class RefineSettings:
    """How to refine; the defaults are the paper's.

    Attributes
    ----------
    k : int
        Neighbours looked at by both steps, a number of Gaussians from 1 to 2^20.
    beta : float
        A Gaussian whose largest probability is below this one (0 to 1) takes the mean code of its neighbours.
    filter_sigmas : float
        A Gaussian is removed where its mean neighbour distance is more than this many standard deviations, 0 or more,
        above the mean of its class.
    cluster, filter : bool
        Whether to take each of the two steps.

    Raises
    ------
    SettingsError
        A value outside its range.
    """

    k: int = 50
    beta: float = 0.65
    filter_sigmas: float = 1.0
    cluster: bool = True
    filter: bool = True

    def __post_init__(self) -> None:
        """Validate."""
        if self.k != int(self.k) or not 1 <= self.k <= MAX_K:
            raise SettingsError(f"refinement: found k = {self.k}; expected a whole number from 1 to {MAX_K}")
        if not 0 <= self.beta <= 1:
            raise SettingsError(f"refinement: found beta = {self.beta}; expected a probability from 0 to 1")
        if not 0 <= self.filter_sigmas < np.inf:
            raise SettingsError(f"refinement: found filter_sigmas = {self.filter_sigmas}; expected 0 or more, finite")


@dataclass(frozen=True, eq=False)
class Clustered:
    """What `cluster` returns.

    Attributes
    ----------
    probabilities : (N, K) float32
        A new array; rows that did not change are those that went in.
    changed : (N,) bool
        Which Gaussians took the mean code of their neighbours.
    """

    probabilities: np.ndarray
    changed: np.ndarray


def cluster(
    means: np.ndarray,  # (N, 3)
    probabilities: np.ndarray,  # (N, K)
    observed: np.ndarray,  # (N,)
    k: int = RefineSettings.k,
    beta: float = RefineSettings.beta,
) -> Clustered:
    """Give every unsure and every unobserved Gaussian the mean code of its k nearest observed ones.

    Unsure are those whose largest probability is below `beta`. All neighbours' codes are those from before the step.
    Where the paper is silent: codes are averaged as probabilities, not as logits; an unsure Gaussian is its own nearest
    neighbour, as in a plain k-nearest query; neighbours may be unsure themselves, but never unobserved; Gaussians tied
    for the last place share its weight equally. If fewer than k are observed, all of them are the neighbours of each.

    Parameters
    ----------
    means : array (N, 3) of float32
        Finite positions, scene units.
    probabilities : array (N, K) of float32
        Rows on the simplex; those of unobserved Gaussians are not read.
    observed : array (N,) of bool
        Whether any view saw the Gaussian. Where none was seen at all, nothing changes.
    k : int
        Number of neighbours, at least 1.
    beta : float
        Threshold of the largest probability.

    Returns
    -------
    Clustered

    Examples
    --------
    >>> import numpy as np
    >>> means = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0]], np.float32)
    >>> codes = np.array([[0, 1], [0.5, 0.5], [0.25, 0.75]], np.float32)
    >>> cluster(means, codes, np.array([True, False, True]), k=2).probabilities.tolist()
    [[0.0, 1.0], [0.125, 0.875], [0.25, 0.75]]
    """
    codes = np.ascontiguousarray(probabilities, np.float32)
    neighbours = np.flatnonzero(observed)
    changed = ~observed | (codes.max(axis=1, initial=0) < beta)
    if not neighbours.size or not changed.any():
        return Clustered(codes.copy(), np.zeros(len(codes), bool))

    points, queries = _scaled(means), np.flatnonzero(changed)
    tree, asking = _Tree.build(points[neighbours]), _Tree.build(points[queries])  # the latter for its order alone
    k = min(k, neighbours.size)
    radii, _ = _nearest(tree.points, tree.boxes, asking.points, k)
    refined = codes.copy()
    into = queries[asking.order]
    _average(tree.points, tree.boxes, neighbours[tree.order], codes, asking.points, radii, k, into, refined)
    return Clustered(refined, changed)


def statistical_filter(
    means: np.ndarray,  # (N, 3)
    labels: np.ndarray,  # (N,)
    k: int = RefineSettings.k,
    sigmas: float = RefineSettings.filter_sigmas,
    num_classes: int | None = None,
) -> np.ndarray:
    """Find the Gaussians that lie too far from the rest of their own object.

    D is the mean distance from a Gaussian to its k nearest others of its class, and one is removed where
    D > mu + sigmas * sigma over the class. What the paper calls the variance sigma is taken as the standard deviation,
    since it is added to a distance. A class of k members or fewer uses all others; one of fewer than three is left
    alone. The limit has a slack of one millionth, the precision of D, so that objects of equal spacing stay whole.

    Parameters
    ----------
    means : array (N, 3) of float32
        Finite positions, scene units.
    labels : array (N,) of int
        Class of each Gaussian. The background, 0, is no object and is not filtered, nor are negative labels.
    k : int
        Number of neighbours, at least 1.
    sigmas : float
        Standard deviations above the mean at which to cut.
    num_classes : int, optional
        K; labels from there on are ignored. By default there are none.

    Returns
    -------
    ndarray (N,) bool
        Which Gaussians to remove.

    Examples
    --------
    >>> import numpy as np
    >>> means = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [99, 0, 0]], np.float32)
    >>> statistical_filter(means, np.array([1, 1, 1, 1, 1])).tolist()
    [False, False, False, False, True]
    """
    removed = np.zeros(len(labels), bool)
    limit = int(labels.max(initial=0)) + 1 if num_classes is None else num_classes
    points, by_class = _scaled(means), np.argsort(labels, kind="stable")
    bounds = np.searchsorted(labels, np.arange(1, limit + 1), sorter=by_class)
    for first, last in zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True):
        members = by_class[first:last]
        if members.size < 3:
            continue
        tree, others = _Tree.build(points[members]), min(k, members.size - 1)
        _, distances = _nearest(tree.points, tree.boxes, tree.points, others + 1)  # each finds itself, at distance 0
        distances /= others
        in_order = np.sort(distances)  # rounding in the mean must not depend on the order of the Gaussians
        cut = in_order.mean() + sigmas * in_order.std()
        removed[members[tree.order]] = distances > cut * (1 + 1e-6)
    return removed


def _scaled(means: np.ndarray) -> np.ndarray:
    """(N, 3) float32 within [-1, 1], by a power of two: without rounding, and no distance can overflow."""
    points = np.asarray(means, np.float32)
    largest = max(points.max(initial=0), -points.min(initial=0))
    scaled: np.ndarray = np.ldexp(points, -np.frexp(largest)[1])
    return scaled


@dataclass(frozen=True)
class _Tree:
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
    def build(cls, points: np.ndarray) -> _Tree:
        """Build from (n, 3) float32, n > 0."""
        depth = ((len(points) - 1) // LEAF).bit_length()
        points, order = points.copy(), np.arange(len(points), dtype=np.int32)
        boxes = np.empty((2 << depth, 6), np.float32)
        if depth > SUBTREE:
            _grow(points, order, boxes, depth)
        else:  # waking other threads would take longer than the work
            _grow_subtree(points, order, boxes, depth, 0, 0)
        return cls(np.ascontiguousarray(points.T), order, boxes)


@nb.njit(parallel=True, cache=True)
def _grow(points: np.ndarray, order: np.ndarray, boxes: np.ndarray, depth: int) -> None:
    top = max(depth - SUBTREE, 0)
    for level in range(top):
        for j in nb.prange(1 << level):
            _split(points, order, boxes, depth, level, j)
    for j in nb.prange(1 << top):
        _grow_subtree(points, order, boxes, depth, top, j)


@nb.njit(cache=True)
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


@nb.njit(parallel=True, cache=True)
def _nearest(
    points: np.ndarray,  # (3, n)
    boxes: np.ndarray,  # (2 L, 6)
    queries: np.ndarray,  # (3, M)
    k: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Squared distance to the k-th nearest point, (M,) float32, and sum of the k smallest distances, (M,) float64."""
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


@nb.njit(parallel=True, cache=True)
def _average(
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
