"""Votes of one view, added to those of other views or taken back, exactly: in whole units."""

from __future__ import annotations

import numba as nb
import numpy as np

from gsseg_core.data.label_evidence import vote_units
from gsseg_core.simd import prefetch

AHEAD = 12
"""Gaussians between the one whose votes are added and the one whose row is fetched from memory."""


@nb.njit(parallel=True, nogil=True, cache=True)
def add_votes(
    total: np.ndarray,  # (N, K) int64, added to
    ids: np.ndarray,  # (M,) int32, distinct
    start: np.ndarray,  # (M + 1,)
    labels: np.ndarray,  # (P,) int32: label of each pair
    said_start: np.ndarray,  # (L + 1,) what a pixel of each label votes, as `CSRRows`
    said_classes: np.ndarray,
    said: np.ndarray,  # float64
    votes: np.ndarray,  # (P,) float32
    units: float,  # per vote; a power of 2
    sign: int,
) -> None:
    """Add a view's votes, or take them away, in whole units."""
    for m in nb.prange(ids.shape[0]):
        prefetch(total, ids[min(m + AHEAD, ids.shape[0] - 1)])
        row = total[ids[m]]
        for s in range(start[m], start[m + 1]):
            for j in range(said_start[labels[s]], said_start[labels[s] + 1]):
                row[said_classes[j]] += sign * vote_units(votes[s], said[j], units)
