"""Which Gaussians make up most of a segment."""

from __future__ import annotations

import numpy as np

from gsseg_core.kernels.compiler import kernel


@kernel
def heaviest(
    order: np.ndarray,  # (P,): the pairs of all L segments, heaviest first
    start: np.ndarray, weights: np.ndarray,  # (L + 1,) pairs of each segment; (P,) float32, in px
    kept: float,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Add up the weights of each segment, (L,) float64, and find the heaviest that make up a share of that, (P,) bool.

    The sum that tells what is heavier runs on from segment to segment, as `np.cumsum` over all pairs would.
    """
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
