"""Label propagation: Gaussians that hardly any view saw take the codes of their neighbours in space and colour.

Let e_i be the evidence of Gaussian i (the weight, in px, of the labelled pixels that saw it), q_i its learnt code, and
p_ij the weight of neighbour j in the graph (`gsseg_core.spatial.neighbour_graph`; sum_j p_ij = 1). Each code f_i
minimises the first expression given its neighbours; the second line is the solution:

    e_i |f_i - q_i|^2 + strength sum_j p_ij |f_i - f_j|^2
    f_i = (e_i q_i + strength sum_j p_ij f_j) / (e_i + strength)

For large e_i, f_i is the learnt code. For e_i = 0, f_i is the mean of the neighbours: a harmonic function (Zhu,
Ghahramani & Lafferty 2003, who fix the labelled points; here each is held in proportion to its evidence). A step
computes all f_i from the previous f_j. Rows keep the sum 1, and each step reaches one neighbour further.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba as nb
import numpy as np

from gsseg_core.errors import SceneValueError, SettingsError
from gsseg_core.kernels.compiler import kernel
from gsseg_core.simd import LANES, add_scaled, differ, divided, empty_rows, load_row, prefetch, store_row, zero_row
from gsseg_core.spatial.knn import CHUNK
from gsseg_core.spatial.neighbour_graph import NEIGHBOURS, Graph

SETTLED = np.float32(1e-3)  # a Gaussian is skipped while no neighbour's probability changes by more than this in a step

UNKNOWN_SHARE = 1 / 100
"""Share of each view's labelled pixels that all other views leave unknown; propagation is worth its time above it.

docs/few_views.md has the gain above and below this share.
"""

NEVER = 2**31 - 1  # number of steps for a place that no code reaches
_AHEAD = 8  # how many places ahead of the current one are prefetched from memory


@dataclass(frozen=True)
class GraphSettings:
    """Settings of label propagation; a value outside its range raises `SettingsError`."""

    k: int = NEIGHBOURS  # number of neighbours of a Gaussian; up to k more if several tie for the last place
    strength: float = 1.0  # evidence, in px, that has the weight of all neighbours together; 0 changes no code
    steps: int = 100  # at most; also the largest number of neighbours over which a code spreads

    def __post_init__(self) -> None:
        """Validate."""
        if not all(isinstance(n, int | np.integer) for n in (self.k, self.steps)) or self.k < 1 or self.steps < 0:
            raise SettingsError(f"graph: k is {self.k}, steps {self.steps}; expected whole numbers, at least 1 and 0")
        if not 0 <= self.strength < float("inf"):
            raise SettingsError(f"graph: strength is {self.strength} px; expected 0 or more, finite")


def propagate(
    graph: Graph,  # of N Gaussians
    codes: np.ndarray,  # (N, K) float32, rows sum to 1, or are zero if nothing is known
    evidence: np.ndarray,  # (N,) px of labelled pixels from which each code was learnt; ignored for zero codes
    settings: GraphSettings | None = None,  # without effect: k, which the graph already has
) -> np.ndarray:
    """Spread codes along the graph against their evidence: (N, K) float32, the same for any number of threads.

    A Gaussian whose evidence is at least a hundred times the strength keeps its code, bit for bit. A Gaussian that no
    code reaches within the steps keeps a row of zeros. Arrays of other shapes raise `SceneValueError`.

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
    known = np.asarray(codes.any(axis=1))[graph.order]
    weight = np.where(known, evidence[graph.order] / settings.strength, 0).astype(np.float32)
    moving = weight < 100
    readers = _readers(graph.indptr, graph.indices, moving)
    reached = _steps_to_reach(graph.indptr, graph.indices, known, settings.steps)
    total, learnt = np.zeros(len(codes), np.float32), empty_rows(len(codes))
    for first in range(0, codes.shape[1], LANES):
        _gather(codes, graph.order, first, learnt)
        spread = _spread(graph, readers, learnt, weight, moving & (reached <= 1), reached, settings.steps)
        _scatter(spread, graph.order, first, out, total)
    # Each block of classes converges separately, so rows only sum to 1 within the precision of convergence.
    _scale(out, graph.order, np.where(moving & (total > 0), total, np.float32(1)))
    return out


@kernel(parallel=True)
def _gather(codes: np.ndarray, order: np.ndarray, first: int, some: np.ndarray) -> None:  # (N, K), (N,); (N, 16) out
    """Copy sixteen columns of the codes, in the order of places; missing columns are zero."""
    count, last = min(codes.shape[1] - first, LANES), len(order) - 1
    for i in nb.prange(order.shape[0]):
        prefetch(codes, order[min(i + 2 * _AHEAD, last)])
        for c in range(LANES):
            some[i, c] = codes[order[i], first + c] if c < count else np.float32(0)


@kernel(parallel=True)
def _scatter(some: np.ndarray, order: np.ndarray, first: int, out: np.ndarray, total: np.ndarray) -> None:
    """Write sixteen columns back into all codes (N, K), and add them to the row sum of each place, (N,)."""
    count = min(out.shape[1] - first, LANES)
    for i in nb.prange(order.shape[0]):
        for c in range(count):
            out[order[i], first + c] = some[i, c]
            total[i] += some[i, c]


@kernel(parallel=True)
def _scale(codes: np.ndarray, order: np.ndarray, total: np.ndarray) -> None:
    """Divide the codes of each place, (N, K), by its row sum, (N,)."""
    for i in nb.prange(order.shape[0]):
        if total[i] != 1:
            for k in range(codes.shape[1]):
                codes[order[i], k] /= total[i]


def _spread(
    graph: Graph, readers: tuple[np.ndarray, np.ndarray], learnt: np.ndarray, weight: np.ndarray, awake: np.ndarray,
    reached: np.ndarray, steps: int,
) -> np.ndarray:  # fmt: skip
    """Iterate until the codes of some classes converge, starting from the `awake` places, (N,); `_step` has the shapes.

    `readers` is the result of `_readers`.
    """
    codes = empty_rows(len(learnt))
    codes[:] = learnt
    # Allocated once: allocation in each step took a third of the time.
    values, changed = empty_rows(len(learnt)), np.empty(len(learnt), bool)
    for step in range(steps):
        places = np.flatnonzero(awake).astype(np.int32)
        if len(places) == 0:
            break
        awake[:] = False
        _step(graph.indptr, graph.indices, graph.weights, learnt, weight, reached, step, places, codes, values, changed)
        _take(places, values, changed, *readers, codes, awake)
    return codes


@kernel(parallel=True)
def _step(
    indptr: np.ndarray, indices: np.ndarray, weights: np.ndarray, learnt: np.ndarray, weight: np.ndarray,
    reached: np.ndarray, step: int, places: np.ndarray, codes: np.ndarray,
    values: np.ndarray, changed: np.ndarray,  # (M, 16), (M,) out
) -> None:  # fmt: skip
    """Compute the codes of M places from those of their neighbours, and mark the ones that change.

    `learnt` and the current `codes` are by place, (N, 16). `weight`, (N,), is the evidence in multiples of the
    strength; `reached`, (N,) int32, is the step after which a code is known.
    """
    for chunk in nb.prange((places.shape[0] + CHUNK - 1) // CHUNK):
        last = min((chunk + 1) * CHUNK, places.shape[0])
        for m in range(chunk * CHUNK, last):
            later = places[min(m + _AHEAD, last - 1)]
            prefetch(learnt, later)
            for e in range(indptr[later], indptr[later + 1]):
                prefetch(codes, indices[e])
            i = places[m]
            mass = weight[i]
            total = add_scaled(zero_row(), load_row(learnt, i), weight[i])
            for e in range(indptr[i], indptr[i + 1]):
                # Codes that are not reached yet are zero, so they can be added without a branch.
                mass += weights[e] if reached[indices[e]] <= step else np.float32(0)
                total = add_scaled(total, load_row(codes, indices[e]), weights[e])
            # A code without evidence does not change until a neighbour is known.
            value = divided(total, mass) if mass > 0 else load_row(codes, i)
            store_row(values, m, value)
            changed[m] = differ(value, load_row(codes, i), SETTLED) != 0 or reached[i] == step + 1


@kernel(parallel=True)
def _take(
    places: np.ndarray, values: np.ndarray, changed: np.ndarray, indptr: np.ndarray, indices: np.ndarray,
    codes: np.ndarray, awake: np.ndarray,
) -> None:  # fmt: skip
    """Write the codes of some places, and wake the places that read a changed one."""
    last = places.shape[0] - 1
    for m in nb.prange(places.shape[0]):
        prefetch(indices, indptr[places[min(m + 2 * _AHEAD, last)]])
        store_row(codes, places[m], load_row(values, m))
        if changed[m]:
            for e in range(indptr[places[m]], indptr[places[m] + 1]):
                awake[indices[e]] = True


@kernel
def _steps_to_reach(indptr: np.ndarray, indices: np.ndarray, known: np.ndarray, steps: int) -> np.ndarray:
    """Count the steps after which the code of each place is known, (N,) int32; `NEVER` if it stays unknown."""
    reached = np.where(known, np.int32(0), np.int32(NEVER))
    waiting = np.flatnonzero(~known)
    for step in range(1, steps + 1):
        left = 0
        for w in range(waiting.shape[0]):
            i = waiting[w]
            for e in range(indptr[i], indptr[i + 1]):
                if reached[indices[e]] < step:
                    reached[i] = step
                    break
            if reached[i] > step:
                waiting[left] = i
                left += 1
        if left == waiting.shape[0]:
            break
        waiting = waiting[:left]
    return reached


@kernel
def _readers(indptr: np.ndarray, indices: np.ndarray, moving: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """List, for each place, the moving places that have it as a neighbour, as CSR rows."""
    ends = np.zeros(moving.shape[0] + 1, np.int64)
    for i in np.flatnonzero(moving):
        for e in range(indptr[i], indptr[i + 1]):
            ends[indices[e] + 1] += 1
    ends = np.cumsum(ends)
    readers, at = np.empty(ends[-1], np.int32), ends[:-1].copy()
    for i in np.flatnonzero(moving):
        for e in range(indptr[i], indptr[i + 1]):
            readers[at[indices[e]]] = i
            at[indices[e]] += 1
    return ends, readers
