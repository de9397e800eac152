"""What EM does with the pairs of a view on the CPU; `em_gpu_kernels` has the same for a GPU."""

from __future__ import annotations

from typing import TypeVar

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

T = TypeVar("T")

__all__ = [
    "accumulate", "by_row", "confusion_counts", "edges_along", "leave_one_out_counts", "m_step_without_view",
    "pair_likelihood", "pairs_of", "put", "returned", "rows_like", "shares", "subtract_votes", "zeros",
]  # fmt: skip


def put(values: T, device: str) -> T:
    """Return an array, or rows, as they are: on the CPU, kernels work on them where they lie."""
    del device
    return values


def returned(array: np.ndarray) -> np.ndarray:
    """Return an array that kernels have worked on as it is."""
    return array


def shares(observation: Observation, likelihood: np.ndarray, rest: np.ndarray) -> VoteShares:
    """Share one vote per labelled pixel, as `Observation.shares` says."""
    return observation.shares(likelihood, rest)


def zeros(rows: CSRRows, kind: type[np.generic]) -> np.ndarray:
    """Make one zero for each entry of some rows."""
    return np.zeros(len(rows.data), kind)
