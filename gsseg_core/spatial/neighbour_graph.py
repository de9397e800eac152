"""The neighbour graph of a scene: the k nearest others of each Gaussian, weighted by distance and colour.

The weights know no unit of length: with h_i the distance from i to its k-th neighbour (Zelnik-Manor & Perona 2004,
local scaling) and c the colours, whose typical difference between neighbours s is the median over the scene,

    p_ij ~ exp(-|x_i - x_j|^2 / (h_i h_j)) exp(-|c_i - c_j|^2 / (2 s^2)),    sum_j p_ij = 1,

so a scene in millimetres, or one whose far half is sparser, is treated the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba as nb
import numpy as np

from gsseg_core.csr_rows import starts
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.scene_cache import PerScene
from gsseg_core.spatial.kd_tree import Tree, gap_to_point, leaf_range, scaled, tree_of
from gsseg_core.spatial.knn import CHUNK, TINY, nearest
from gsseg_core.spatial.leaf_candidates import DEPTH

NEIGHBOURS = 12
"""Neighbours of a Gaussian in its graph, unless others are asked for."""


@dataclass(frozen=True, eq=False)
class Graph:
    """Neighbours of each Gaussian and the weights of the edges to them, as CSR rows in the order of a k-d tree.

    Attributes
    ----------
    k : int
        Neighbours that were asked for.
    order : (N,) int32
        Which Gaussian each place stands for: what is near in the arrays is near in space.
    indptr : (N + 1,) int64
        Neighbours of place i are indices[indptr[i]:indptr[i + 1]].
    indices : (E,) int32
        Neighbours, as places.
    weights : (E,) float32
        p_ij, which sum to 1 over the neighbours of a Gaussian.
    """

    k: int
    order: np.ndarray
    indptr: np.ndarray
    indices: np.ndarray
    weights: np.ndarray

    @classmethod
    def build(
        cls,
        means: np.ndarray,  # (N, 3) float32, finite
        colors: np.ndarray,  # (N, 3) float32
        k: int = NEIGHBOURS,
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
        contrast, weights = np.empty(len(near), np.float32), np.empty(len(near), np.float32)
        _compare(ordered, start, near, contrast)
        # Painted scenes have areas of one colour; where there is only one, it tells nothing.
        typical = float(np.median(contrast)) or float(contrast.mean()) or 1.0
        _weigh(tree.points, radii, contrast, typical, start, near, weights)
        return cls(k, tree.order, start, near, weights)


_KNOWN: PerScene[Graph] = PerScene()


def graph_of(scene: GaussianScene, k: int = NEIGHBOURS) -> Graph:
    """Neighbour graph of a scene, built once and kept with it."""

    def build() -> Graph:
        return Graph.build(scene.means, scene.colors(), k, tree_of(scene) if len(scene) else None)

    return _KNOWN.of(scene, build, lambda known: known.k == k)


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
    start: np.ndarray,  # (n + 1,) where the list of each point goes
    counts: np.ndarray,  # (n,) out: how many there are, though its list may hold fewer
    near: np.ndarray,  # (E,) out
) -> None:
    """List the others within the radius of points."""
    leaves, n = boxes.shape[0] // 2, points.shape[1]
    for chunk in nb.prange((wanted.shape[0] + CHUNK - 1) // CHUNK):
        nodes = np.empty(DEPTH, np.int64)
        for own in wanted[chunk * CHUNK : (chunk + 1) * CHUNK]:
            x, y, z, radius = points[0, own], points[1, own], points[2, own], radii[own]
            found, first, capacity = 0, start[own], start[own + 1] - start[own]
            nodes[0], waiting = 1, 1
            while waiting:
                waiting -= 1
                node = nodes[waiting]
                if gap_to_point(boxes, node, x, y, z) > radius:
                    continue
                if node < leaves:
                    nodes[waiting], nodes[waiting + 1] = 2 * node, 2 * node + 1
                    waiting += 2
                    continue
                begin, end = leaf_range(node - leaves, leaves, n)
                for i in range(begin, end):
                    dx, dy, dz = points[0, i] - x, points[1, i] - y, points[2, i] - z
                    if i != own and found < most and dx * dx + dy * dy + dz * dz <= radius:
                        if found < capacity:
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
    weights: np.ndarray,  # (E,) out
) -> None:
    for i in nb.prange(points.shape[1]):
        total = np.float32(0)
        for e in range(start[i], start[i + 1]):
            j = near[e]
            dx, dy, dz = points[0, i] - points[0, j], points[1, i] - points[1, j], points[2, i] - points[2, j]
            spacing = max(np.sqrt(radii[i]) * np.sqrt(radii[j]), TINY)
            apart = contrast[e] / np.float32(typical)
            # However different, a neighbour is better than none.
            weights[e] = max(np.exp(-(dx * dx + dy * dy + dz * dz) / spacing - apart * apart / 2), np.float32(1e-9))
            total += weights[e]
        for e in range(start[i], start[i + 1]):
            weights[e] /= total
