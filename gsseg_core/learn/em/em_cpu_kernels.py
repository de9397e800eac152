"""What EM does with the pairs of a view on the CPU; `em_gpu_kernels` has the same for a GPU."""

from __future__ import annotations

import numpy as np

from gsseg_core.csr_rows import CSRRows
from gsseg_core.learn.em.em_kernels import (
    accumulate,
    by_row,
    confusion_counts,
    m_step_without_view,
    pair_likelihood,
    pairs_of,
    rows_like,
)
from gsseg_core.learn.em.leave_one_out import leave_one_out_counts, subtract_votes
from gsseg_core.learn.em.scene_edges import edges_along
from gsseg_core.raster.observation import Observation, VoteShares

__all__ = [
    "accumulate", "by_row", "confusion_counts", "edges_along", "leave_one_out_counts", "m_step_without_view",
    "pair_likelihood", "pairs_of", "put", "put_rows", "returned", "rows_like", "shares", "subtract_votes", "zeros",
]  # fmt: skip


def put(array: np.ndarray, device: str) -> np.ndarray:
    """Put an array where the kernels work, which it is."""
    del device
    return array


def put_rows(rows: CSRRows, device: str) -> CSRRows:
    """Put rows there."""
    del device
    return rows


def shares(observation: Observation, likelihood: np.ndarray, rest: np.ndarray) -> VoteShares:
    """Share one vote per labelled pixel, as `Observation.shares` says."""
    return observation.shares(likelihood, rest)


def returned(array: np.ndarray) -> np.ndarray:
    """Return an array from there."""
    return array


def zeros(rows: CSRRows, kind: type[np.generic]) -> np.ndarray:
    """Make an array of zeros, of as many as rows have entries."""
    return np.zeros(len(rows.data), kind)
