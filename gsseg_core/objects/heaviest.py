"""Which Gaussians make up most of a segment."""

from __future__ import annotations

import numpy as np

from gsseg_core.kernels.compiler import kernel
from gsseg_core.raster.cpu.depth_sort import sort_keys


def heaviest(start: np.ndarray, weights: np.ndarray, kept: float) -> tuple[np.ndarray, np.ndarray]:
    """Add up the weights of each segment, (L,) float64, and find the heaviest that make up a share of that, (P,) bool.

    The weights, (P,) float32 in px, are those of each segment from where its `start`, (L + 1,), says; of equal ones the
    first counts as the heavier.
    """
    # Ascending weights, the last of equal ones first, and all of that backwards.
    order, _ = sort_keys(np.ascontiguousarray(weights[::-1]).view(np.uint32))
    return _heaviest(len(order) - 1 - order[::-1], start, weights, kept)


@kernel
def _heaviest(
    order: np.ndarray,  # (P,) int32: of all weights, the heaviest first
    start: np.ndarray, weights: np.ndarray, kept: float,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Do what `heaviest` does; what is heavier adds up from segment to segment, as `np.cumsum` of all weights would."""
    segments, ranked = np.empty(len(weights), np.int32), np.empty(len(weights), np.int32)
    place, size, heavy = start[:-1].copy(), np.zeros(len(start) - 1), np.empty(len(weights), np.bool_)
    for s in range(len(size)):
        segments[start[s] : start[s + 1]] = s
    for i in order:
        s = segments[i]
        ranked[place[s]] = i
        place[s] += 1
        size[s] += weights[i]
    total = running = 0.0
    for s in range(len(size)):
        total += size[s]
        before = total - size[s]
        for n in range(start[s], start[s + 1]):
            i = ranked[n]
            running += weights[i]
            heavy[i] = (running - weights[i] - before < kept * size[s]) & (weights[i] > 0)
    return size, heavy
