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
from gsseg_core.kernels.compiler import kernel
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.scene_cache import PerScene
from gsseg_core.spatial.kd_tree import Tree, scaled, tree_of
from gsseg_core.spatial.knn import nearest

NEIGHBOURS = 12  # neighbours of a Gaussian in its graph, unless others are asked for


@dataclass(frozen=True, eq=False)
class Graph:
    """Neighbours of each Gaussian and the weights of the edges to them, as CSR rows in the order of a k-d tree."""

    k: int  # neighbours that were asked for
    order: np.ndarray  # (N,) int32: which Gaussian each place stands for
    indptr: np.ndarray  # (N + 1,) int64: neighbours of place i are indices[indptr[i]:indptr[i + 1]]
    indices: np.ndarray  # (E,) int32: neighbours, as places
    weights: np.ndarray  # (E,) float32: p_ij, which sum to 1 over the neighbours of a Gaussian

    @classmethod
    def build(cls, means: np.ndarray, colors: np.ndarray, k: int = NEIGHBOURS, tree: Tree | None = None) -> Graph:
        """Link points, (N, 3) float32 as their colours are, with their k nearest others, or with all there are.

        The tree, if one is at hand, is that of the scaled points.
        """
        if len(means) < 2:
            return cls(k, np.arange(len(means), dtype=np.int32), np.zeros(len(means) + 1, np.int64),
                       np.empty(0, np.int32), np.empty(0, np.float32))  # fmt: skip
        tree, num = tree or Tree.build(scaled(means)), min(k, len(means) - 1)
        # A thousand points in one place are all tied: without a limit, each would have a thousand neighbours.
        radii, _, lists = nearest(tree, np.arange(len(means), dtype=np.int32), num, True)
        indptr, indices = starts(lists.counts), lists.joined()
        del lists
        contrast = _compare(np.ascontiguousarray(colors[tree.order], np.float32), indptr, indices)
        # Painted scenes have areas of one colour; where there is only one, it tells nothing.
        typical = float(np.median(contrast)) or float(contrast.mean()) or 1.0
        weights = _weigh(tree.points, radii, contrast, np.float32(typical), indptr, indices)
        return cls(k, tree.order, indptr, indices, weights)


_KNOWN: PerScene[Graph] = PerScene()


def graph_of(scene: GaussianScene, k: int = NEIGHBOURS) -> Graph:
    """Neighbour graph of a scene, built once and kept with it."""

    def build() -> Graph:
        tree = tree_of(scene) if len(scene) else None
        return Graph.build(scene.means, scene.colors(), k, tree)

    return _KNOWN.of(scene, build, lambda known: known.k == k)


@kernel(parallel=True)
def _compare(colors: np.ndarray, indptr: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """Difference of the colours (n, 3) of neighbours, (E,) float32."""
    contrast = np.empty(len(indices), np.float32)
    for i in nb.prange(len(colors)):
        for e in range(indptr[i], indptr[i + 1]):
            j = indices[e]
            r, g, b = colors[i, 0] - colors[j, 0], colors[i, 1] - colors[j, 1], colors[i, 2] - colors[j, 2]
            contrast[e] = np.sqrt(r * r + g * g + b * b)
    return contrast


@kernel(parallel=True)
def _weigh(
    points: np.ndarray, radii: np.ndarray,  # (3, n), (n,) squared distance to the k-th neighbour
    contrast: np.ndarray, typical: np.float32,  # (E,) difference of the colours; a typical one
    indptr: np.ndarray, indices: np.ndarray,  # (n + 1,), (E,)
) -> np.ndarray:  # fmt: skip
    """Weights p_ij of the edges, (E,) float32."""
    weights = np.empty(len(indices), np.float32)
    for i in nb.prange(len(radii)):
        total = np.float32(0)
        for e in range(indptr[i], indptr[i + 1]):
            j = indices[e]
            dx, dy, dz = points[0, i] - points[0, j], points[1, i] - points[1, j], points[2, i] - points[2, j]
            spacing = max(np.sqrt(radii[i]) * np.sqrt(radii[j]), np.finfo(np.float32).tiny)
            apart = contrast[e] / typical
            exponent = -(dx * dx + dy * dy + dz * dz) / spacing - apart * apart / 2
            weights[e] = max(np.exp(exponent), np.float32(1e-9))  # however different, it is better than none
            total += weights[e]
        for e in range(indptr[i], indptr[i + 1]):
            weights[e] /= total
    return weights
