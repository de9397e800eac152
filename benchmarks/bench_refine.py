"""Seconds that refinement takes on the real scene, and its neighbour search beside those of other libraries.

    python benchmarks/bench_refine.py

The scene is $GSSEG_DATA/replica_apartment/scene.ply (default ../shared/data beside the repository). Its labels are made
here: the nearest of 40 random Gaussians, 3 % of them at random, and about one code in eight is unsure.
"""

from __future__ import annotations

import importlib
import os
import statistics
from collections.abc import Callable
from typing import Any

import numba as nb
import numpy as np
from machine import parser_of, processor, timed
from scipy.spatial import cKDTree

from gsseg_core.csr_rows import CSRRows
from gsseg_core.refine.knn_filter import cluster, statistical_filter
from gsseg_core.refine.settings import RefineSettings
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.spatial.neighbourhood import Neighbours

REPEATS = 7
CLASSES = 40


def main() -> None:
    """Measure and print one table."""
    path = parser_of(__doc__).parse_args().data / "replica_apartment" / "scene.ply"
    if not path.is_file():
        print(f"skipped: no {path}; set GSSEG_DATA or --data to the folder that holds replica_apartment/")
        return
    means = GaussianScene.load(path).means
    labels, probabilities, observed = make_codes(means)
    k, beta = RefineSettings.k, RefineSettings.beta
    rows = CSRRows.from_dense(np.where(observed[:, None], probabilities, np.float32(0)))
    unsure = cluster(Neighbours.among(means, k), rows, CLASSES, beta)[1].mean()

    print(f"{processor()}, {nb.get_num_threads()} threads, load {load()} before, numba {nb.__version__}")
    print(f"{len(means)} Gaussians, {CLASSES} classes, {unsure:.1%} unsure or unobserved, k = {k}, {REPEATS} runs\n")
    steps = {
        "cluster": lambda: cluster(Neighbours.among(means, k), rows, CLASSES, beta),
        "filter": lambda: statistical_filter(Neighbours.among(means, k), labels, 1.0),
    }
    steps["cluster + filter"] = lambda: (steps["cluster"](), steps["filter"]())
    searches = {f"search: {name}": search for name, search in neighbour_searches(means, k).items()}
    print(f"{'':28} {'median ms':>10} {'best ms':>10}")
    for name, step in (steps | searches).items():
        seconds = timed(step, REPEATS)
        print(f"{name:28} {1e3 * statistics.median(seconds):10.0f} {1e3 * min(seconds):10.0f}")
    print(f"\nsearch: mean distance of every Gaussian to its {k} nearest others, tree included; load {load()} after")


def make_codes(means: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Labels (N,) int32, probabilities (N, 40) float32 and observed (N,) bool."""
    rng, n = np.random.default_rng(0), len(means)
    labels = cKDTree(rng.choice(means, CLASSES, replace=False)).query(means)[1].astype(np.int32)
    labels = np.where(rng.random(n) < 0.03, rng.integers(0, CLASSES, n, np.int32), labels)
    top = np.where(rng.random(n) < 0.1, rng.uniform(0.2, 0.65, n), rng.uniform(0.65, 1.0, n))
    probabilities = np.repeat((1 - top)[:, None] / (CLASSES - 1), CLASSES, axis=1).astype(np.float32)
    probabilities[np.arange(n), labels] = top
    return labels, probabilities, rng.random(n) < 0.98


def neighbour_searches(means: np.ndarray, k: int) -> dict[str, Callable[[], object]]:
    """Ours and those of the libraries at hand, each from positions to mean distances."""

    def ours() -> np.ndarray:
        return Neighbours.among(means, k).look_for().distances

    def scipy() -> np.ndarray:
        return cKDTree(means).query(means, k + 1, workers=-1)[0].sum(axis=1) / k

    searches: dict[str, Callable[[], object]] = {"ours": ours, "scipy cKDTree": scipy}
    if pykdtree := optional("pykdtree.kdtree"):
        searches["pykdtree"] = lambda: pykdtree.KDTree(means).query(means, k + 1)[0].sum(axis=1) / k
    if small_gicp := optional("small_gicp"):
        points, threads = means.astype(np.float64), nb.get_num_threads()

        def gicp() -> np.ndarray:
            tree = small_gicp.KdTree(points, num_threads=threads)
            return np.sqrt(tree.batch_knn_search(points, k + 1, num_threads=threads)[1]).sum(axis=1) / k

        searches["small_gicp"] = gicp
    return searches


def optional(name: str) -> Any:
    """Import a module, or None where it is not installed."""
    try:
        return importlib.import_module(name)
    except ImportError:
        return None


def load() -> str:
    """Mean number of runnable processes over the last minute: above 0 before means that the machine was shared."""
    return f"{os.getloadavg()[0]:.1f}"


if __name__ == "__main__":
    main()
