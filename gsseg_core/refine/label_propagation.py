"""What no view, or hardly any, spoke for takes the codes of its neighbours, along a graph without a scale of its own.

Label propagation with evidence. With e_i the weight in px that labelled pixels gave to Gaussian i, q_i its learnt code,
and p_ij the share of neighbour j in what is near i (they sum to 1), the codes f minimise, each given its neighbours,

    e_i |f_i - q_i|^2 + strength sum_j p_ij |f_i - f_j|^2
    f_i = (e_i q_i + strength sum_j p_ij f_j) / (e_i + strength)

Where e_i is large, f_i is what was learnt; where it is zero, f_i is the mean of the neighbours: a harmonic function
(Zhu, Ghahramani & Lafferty 2003, who fix the labelled points; here evidence holds them as firmly as it is heavy). A
step computes all f_i from the f_j before it; rows stay on the simplex, and each step reaches one neighbour further.

The shares know no unit of length: with h_i the distance from i to its k-th neighbour (Zelnik-Manor & Perona 2004,
local scaling) and c the colours, whose typical difference between neighbours s is the median over the scene,

    p_ij ~ exp(-|x_i - x_j|^2 / (h_i h_j)) exp(-|c_i - c_j|^2 / (2 s^2))

so a scene in millimetres, or one whose far half is sparser, is treated the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba as nb
import numpy as np

from gsseg_core.csr_rows import starts
from gsseg_core.errors import SceneValueError, SettingsError
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.scene_cache import PerScene
from gsseg_core.spatial.kd_tree import Tree, scaled, tree_of
from gsseg_core.spatial.knn import CHUNK, nearest

BLOCK = 16
"""Classes that are propagated at once; bounds the memory at 8 N of these in bytes, besides the codes themselves."""

SETTLED = np.float32(3e-4)
"""A Gaussian is left alone while no probability around it changes by more than this in a step."""

SCARCE = 1 / 6
"""Share of Gaussians seen with less px than all neighbours count, from which on the graph is worth its time."""

NEVER = 2**31 - 1
_TINY = np.float32(1e-30)


@dataclass(frozen=True)
class GraphSettings:
    """How codes spread.

    Attributes
    ----------
    k : int
        Neighbours of a Gaussian; of those tied for the last place as many more count.
    strength : float
        Evidence in px that weighs as much as all neighbours together; 0 leaves all codes as they are.
    steps : int
        Steps at most, and so how many neighbours away a code can come from.

    Raises
    ------
    SettingsError
        A value outside its range.
    """

    k: int = 12
    strength: float = 1.0
    steps: int = 100

    def __post_init__(self) -> None:
        """Validate."""
        if self.k < 1 or self.steps < 0:
            raise SettingsError(f"graph: k is {self.k}, steps {self.steps}; expected at least 1 and 0")
        if not 0 <= self.strength < float("inf"):
            raise SettingsError(f"graph: strength is {self.strength} px; expected 0 or more, finite")


@dataclass(frozen=True, eq=False)
class Graph:
    """Who is near each Gaussian, and how much of what is near it each one makes up.

    Attributes
    ----------
    k : int
        Neighbours that were asked for.
    order : (N,) int32
        Which Gaussian each place stands for: what is near in the arrays is near in space.
    start : (N + 1,) int64
        Neighbours of place i are start[i] to start[i + 1].
    places : (E,) int32
        Neighbours, as places.
    shares : (E,) float32
        p_ij, which sum to 1 over the neighbours of a Gaussian.
    """

    k: int
    order: np.ndarray
    start: np.ndarray
    places: np.ndarray
    shares: np.ndarray

    @classmethod
    def build(
        cls,
        means: np.ndarray,  # (N, 3) float32, finite
        colors: np.ndarray,  # (N, 3) float32
        k: int = GraphSettings.k,
        tree: Tree | None = None,
    ) -> Graph:
        """Link every point with its k nearest others, or with all there are; `tree` is that of the scaled points."""
        if len(means) < 2:
            return cls(k, np.arange(len(means), dtype=np.int32), np.zeros(len(means) + 1, np.int64),
                       np.empty(0, np.int32), np.empty(0, np.float32))  # fmt: skip
        tree = tree or Tree.build(scaled(means))
        places = np.arange(len(means), dtype=np.int32)
        radii, _ = nearest(tree.points, tree.boxes, tree.blocks, places, min(k, len(means) - 1))
        start, near = _near(tree, radii, k)
        ordered = np.ascontiguousarray(colors[tree.order], np.float32)
        contrast, shares = np.empty(len(near), np.float32), np.empty(len(near), np.float32)
        _compare(ordered, start, near, contrast)
        # Painted scenes have areas of one colour; where there is only one, it tells nothing.
        typical = float(np.median(contrast)) or float(contrast.mean()) or 1.0
        _weigh(tree.points, radii, contrast, typical, start, near, shares)
        return cls(k, tree.order, start, near, shares)


_KNOWN: PerScene[Graph] = PerScene()


def graph_of(scene: GaussianScene, k: int = GraphSettings.k) -> Graph:
    """Build the graph of a scene, once: it is kept with it."""

    def build() -> Graph:
        return Graph.build(scene.means, scene.colors(), k, tree_of(scene) if len(scene) else None)

    return _KNOWN.of(scene, build, lambda known: known.k == k)


def is_scarce(
    evidence: np.ndarray,  # (N,)
    settings: GraphSettings | None = None,
) -> bool:
    """Tell whether evidence is scarce in enough of a scene for the graph to matter.

    Of what is seen often it changes nothing, yet takes as long to build; docs/few_views.md has figures of both cases.
    """
    strength = (settings or GraphSettings()).strength
    return len(evidence) > 0 and float((evidence < strength).mean()) > SCARCE


def spread_if_scarce(
    scene: GaussianScene,
    codes: np.ndarray,  # (N, K)
    evidence: np.ndarray,  # (N,)
) -> np.ndarray:
    """Spread codes along the graph of a scene where evidence is scarce; else return the very same array.

    Parameters
    ----------
    scene : GaussianScene
        N Gaussians.
    codes, evidence
        As `propagate` takes them.
    """
    return propagate(graph_of(scene), codes, evidence) if is_scarce(evidence) else codes


def propagate(
    graph: Graph,
    codes: np.ndarray,  # (N, K)
    evidence: np.ndarray,  # (N,)
    settings: GraphSettings | None = None,
) -> np.ndarray:
    """Spread codes along the graph, held by their evidence.

    A Gaussian with evidence of more than a hundred times the strength keeps its code, bit for bit; one that no code
    reaches in all the steps stays a row of zeros.

    Parameters
    ----------
    graph : Graph
        Of N Gaussians.
    codes : (N, K) float32
        Rows on the simplex, or of zeros where nothing is known.
    evidence : (N,)
        Weight of the labelled pixels that each one's code stands on, in px; what it is where the code is zeros does not
        matter.
    settings : GraphSettings, optional
        Of these, k was used in building the graph and is not read.

    Returns
    -------
    ndarray (N, K) float32
        Does not depend on the number of threads.

    Raises
    ------
    SceneValueError
        The arrays are not of these shapes.

    Examples
    --------
    >>> import numpy as np
    >>> line = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0]], np.float32)
    >>> graph = Graph.build(line, np.zeros((3, 3)), k=2)
    >>> codes = np.array([[1, 0], [0, 0], [0, 1]], np.float32)
    >>> propagate(graph, codes, np.array([1e3, 0, 1e3])).tolist()
    [[1.0, 0.0], [0.5, 0.5], [0.0, 1.0]]
    """
    settings = settings or GraphSettings()
    codes = np.ascontiguousarray(codes, np.float32)
    if codes.ndim != 2 or len(codes) != len(graph.order) or evidence.shape != (len(codes),):
        raise SceneValueError(
            f"codes have shape {codes.shape}, evidence {evidence.shape}; expected ({len(graph.order)}, K) and "
            f"({len(graph.order)},), one row per Gaussian of the graph"
        )
    out = codes.copy()
    if settings.strength == 0 or settings.steps == 0:
        return out
    known: np.ndarray = codes[graph.order].max(axis=1, initial=0) > 0
    weight = np.where(known, evidence[graph.order] / settings.strength, 0).astype(np.float32)
    moving = np.flatnonzero(weight < 100).astype(np.int32)
    reached = _steps_to_reach(graph.start, graph.places, known, settings.steps)
    for first in range(0, codes.shape[1], BLOCK):
        learnt = np.ascontiguousarray(codes[graph.order, first : first + BLOCK])
        spread = _spread(graph, learnt, weight, moving, reached, settings.steps)
        out[graph.order, first : first + BLOCK] = spread
    # Classes settle apart from each other, so that the sum of a row is 1 only about as precisely as they do.
    ids = graph.order[moving]
    total = out[ids].sum(axis=1, keepdims=True)
    out[ids] = np.divide(out[ids], total, out=out[ids], where=total > 0)
    return out


def _spread(
    graph: Graph,
    learnt: np.ndarray,  # (N, C), by place
    weight: np.ndarray,  # (N,) evidence as a multiple of the strength
    moving: np.ndarray,  # (M,) places
    reached: np.ndarray,  # (N,) int32
    steps: int,
) -> np.ndarray:
    """Step until the codes of some classes settle."""
    old, new = learnt.copy(), learnt.copy()
    was, now = np.zeros((2, len(learnt)), np.uint8)
    last = int(reached[reached < NEVER].max(initial=0))  # until then zeros are where nothing has come yet
    for step in range(steps):
        _step(graph.start, graph.places, graph.shares, learnt, weight, moving, reached, step, was, now, old, new)
        old, new, was, now = new, old, now, was
        if step >= last and not was.any():
            break
    return old


@nb.njit(parallel=True, nogil=True, cache=True)
def _step(
    start: np.ndarray,  # (N + 1,)
    places: np.ndarray,  # (E,)
    shares: np.ndarray,  # (E,)
    learnt: np.ndarray,  # (N, C)
    weight: np.ndarray,  # (N,)
    moving: np.ndarray,  # (M,)
    reached: np.ndarray,  # (N,) int32: the step after which a code is known
    step: int,
    was: np.ndarray,  # (N,) uint8: what changed in the step before
    now: np.ndarray,  # (N,) uint8 out, at the places that move: what changes in this one
    old: np.ndarray,  # (N, C)
    new: np.ndarray,  # (N, C) out, at the places that move
) -> None:
    """Compute the codes that move, from those before, wherever something around them has changed."""
    many = learnt.shape[1]
    for chunk in nb.prange((moving.shape[0] + CHUNK - 1) // CHUNK):
        sums = np.empty(many, np.float32)
        for m in range(chunk * CHUNK, min((chunk + 1) * CHUNK, moving.shape[0])):
            i = moving[m]
            now[i] = 0
            if reached[i] > step + 1:
                continue
            awake = reached[i] == step + 1 or step == 0
            for e in range(start[i], start[i + 1]):
                awake |= was[places[e]] != 0
            if not awake:
                new[i] = old[i]
                continue
            mass = weight[i]
            for c in range(many):
                sums[c] = weight[i] * learnt[i, c]
            for e in range(start[i], start[i + 1]):
                j = places[e]
                if reached[j] <= step:
                    mass += shares[e]
                    for c in range(many):
                        sums[c] += shares[e] * old[j, c]
            change = np.float32(0)
            for c in range(many):
                value = sums[c] / mass
                change = max(change, abs(value - old[i, c]))
                new[i, c] = value
            now[i] = change > SETTLED


@nb.njit(nogil=True, cache=True)
def _steps_to_reach(start: np.ndarray, places: np.ndarray, known: np.ndarray, steps: int) -> np.ndarray:
    """Tell after how many steps the code of each place is known, (N,) int32, or NEVER."""
    n = known.shape[0]
    reached = np.full(n, np.int32(NEVER))
    for i in range(n):
        if known[i]:
            reached[i] = 0
    waiting = np.flatnonzero(~known)
    for step in range(1, steps + 1):
        left = 0
        for w in range(waiting.shape[0]):
            i = waiting[w]
            for e in range(start[i], start[i + 1]):
                if reached[places[e]] < step:
                    reached[i] = step
                    break
            if reached[i] > step:
                waiting[left] = i
                left += 1
        if left == waiting.shape[0]:
            break
        waiting = waiting[:left]
    return reached


def _near(
    tree: Tree,
    radii: np.ndarray,  # (n,) squared
    k: int,
) -> tuple[np.ndarray, np.ndarray]:
    """List the others within each point's radius: where each list begins, (n + 1,) int64, and places, (E,) int32."""
    n = len(radii)
    k = min(k, n - 1)
    # A thousand points in one place are all tied: without a limit, each would have a thousand neighbours.
    most, counts = 2 * k, np.empty(n, np.int64)
    near = np.empty(n * k, np.int32)
    _list_near(tree.points, tree.boxes, radii, most, np.arange(n, dtype=np.int32), np.arange(n + 1) * k, counts, near)
    start, tied = starts(counts), np.flatnonzero(counts > k).astype(np.int32)
    if len(tied):
        first, near = near.reshape(n, k), np.empty(start[-1], np.int32)
        _move(first, start, near)
        _list_near(tree.points, tree.boxes, radii, most, tied, start, counts, near)
    return start, near


@nb.njit(parallel=True, nogil=True, cache=True)
def _move(
    lists: np.ndarray,  # (n, k)
    start: np.ndarray,  # (n + 1,)
    near: np.ndarray,  # (E,) out
) -> None:
    for i in nb.prange(lists.shape[0]):
        for j in range(lists.shape[1]):
            near[start[i] + j] = lists[i, j]


@nb.njit(parallel=True, nogil=True, cache=True)
def _compare(
    colors: np.ndarray,  # (n, 3)
    start: np.ndarray,  # (n + 1,)
    near: np.ndarray,  # (E,)
    contrast: np.ndarray,  # (E,) out
) -> None:
    for i in nb.prange(colors.shape[0]):
        for e in range(start[i], start[i + 1]):
            j = near[e]
            r, g, b = colors[i, 0] - colors[j, 0], colors[i, 1] - colors[j, 1], colors[i, 2] - colors[j, 2]
            contrast[e] = np.sqrt(r * r + g * g + b * b)


@nb.njit(parallel=True, nogil=True, cache=True)
def _list_near(
    points: np.ndarray,  # (3, n)
    boxes: np.ndarray,  # (2 L, 6)
    radii: np.ndarray,  # (n,) squared
    most: int,  # for one point
    wanted: np.ndarray,  # (M,) int32: of which points
    start: np.ndarray,  # (n + 1,) room for the list of each point
    counts: np.ndarray,  # (n,) out: how many there are, though there may be room for fewer
    near: np.ndarray,  # (E,) out
) -> None:
    """List the others within the radius of points."""
    leaves, n = boxes.shape[0] // 2, points.shape[1]
    for chunk in nb.prange((wanted.shape[0] + CHUNK - 1) // CHUNK):
        nodes = np.empty(64, np.int64)
        for own in wanted[chunk * CHUNK : (chunk + 1) * CHUNK]:
            x, y, z, radius = points[0, own], points[1, own], points[2, own], radii[own]
            found, first, room = 0, start[own], start[own + 1] - start[own]
            nodes[0], waiting = 1, 1
            while waiting:
                waiting -= 1
                node = nodes[waiting]
                dx = max(max(boxes[node, 0] - x, x - boxes[node, 3]), np.float32(0))
                dy = max(max(boxes[node, 1] - y, y - boxes[node, 4]), np.float32(0))
                dz = max(max(boxes[node, 2] - z, z - boxes[node, 5]), np.float32(0))
                if dx * dx + dy * dy + dz * dz > radius:
                    continue
                if node < leaves:
                    nodes[waiting], nodes[waiting + 1] = 2 * node, 2 * node + 1
                    waiting += 2
                    continue
                for i in range((node - leaves) * n // leaves, (node - leaves + 1) * n // leaves):
                    dx, dy, dz = points[0, i] - x, points[1, i] - y, points[2, i] - z
                    if i != own and found < most and dx * dx + dy * dy + dz * dz <= radius:
                        if found < room:
                            near[first + found] = i
                        found += 1
            counts[own] = found


@nb.njit(parallel=True, nogil=True, cache=True)
def _weigh(
    points: np.ndarray,  # (3, n)
    radii: np.ndarray,  # (n,) squared distance to the k-th neighbour
    contrast: np.ndarray,  # (E,) difference of the colours
    typical: float,  # of these
    start: np.ndarray,  # (n + 1,)
    near: np.ndarray,  # (E,)
    shares: np.ndarray,  # (E,) out
) -> None:
    for i in nb.prange(points.shape[1]):
        total = np.float32(0)
        for e in range(start[i], start[i + 1]):
            j = near[e]
            dx, dy, dz = points[0, i] - points[0, j], points[1, i] - points[1, j], points[2, i] - points[2, j]
            spacing = max(np.sqrt(radii[i]) * np.sqrt(radii[j]), _TINY)
            apart = contrast[e] / np.float32(typical)
            # However different, a neighbour is better than none.
            shares[e] = max(np.exp(-(dx * dx + dy * dy + dz * dz) / spacing - apart * apart / 2), np.float32(1e-9))
            total += shares[e]
        for e in range(start[i], start[i + 1]):
            shares[e] /= total
