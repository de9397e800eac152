"""Time loading, sub-setting and saving of a million Gaussians of SH degree 3, a 236 MB PLY.

Usage: python benchmarks/bench_load.py
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from machine import processor, timed

from gsseg_core.scene.gaussian_scene import GaussianScene

COUNT, RUNS = 1_000_000, 5


def main() -> None:
    argparse.ArgumentParser(description=__doc__).parse_args()
    rng = np.random.default_rng(0)
    sh = rng.normal(size=(COUNT, 16, 3)).astype(np.float32)
    means, scales = rng.normal(size=(COUNT, 3)), rng.uniform(0.01, 0.1, (COUNT, 3))
    scene = GaussianScene.from_arrays(means, rng.normal(size=(COUNT, 4)), scales, rng.uniform(0.1, 0.9, COUNT), sh)
    print(f"{processor()}; seconds, median of {RUNS}")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.ply"
        report("save", lambda: scene.save(path))
        report("load", lambda: GaussianScene.load(path))
    report("subset of half", lambda: scene.subset(np.arange(0, COUNT, 2)))


def report(name: str, job: Callable[[], object]) -> None:
    print(f"{name:<16}{statistics.median(timed(job, RUNS)):.2f}")


if __name__ == "__main__":
    main()
