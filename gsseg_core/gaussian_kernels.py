"""What learners do Gaussian by Gaussian with the products of one view."""

from __future__ import annotations

import numba as nb
import numpy as np

BLOCKS = 16
"""Counts are summed in this many parts, then together, so that they do not depend on the number of threads."""


@nb.njit(parallel=True, nogil=True, cache=True, fastmath={"contract", "reassoc"})
def mix(
    codes: np.ndarray,  # (N, K) float32
    ids: np.ndarray,  # (M,) int32
    likelihood: np.ndarray,  # (L, K) float32
) -> np.ndarray:
    """Return what each visible Gaussian says of each label, codes[ids] @ likelihood.T: (M, L) float32."""
    out = np.empty((ids.shape[0], likelihood.shape[0]), np.float32)
    for m in nb.prange(ids.shape[0]):
        row = codes[ids[m]]
        for y in range(likelihood.shape[0]):
            total = np.float32(0.0)
            for k in range(row.shape[0]):
                total += row[k] * likelihood[y, k]
            out[m, y] = total
    return out


@nb.njit(parallel=True, nogil=True, cache=True, fastmath={"contract"})
def collect(
    codes: np.ndarray,  # (N, K) float32
    ids: np.ndarray,  # (M,) int32, distinct
    likelihood: np.ndarray,  # (L, K) float32
    shares: np.ndarray,  # (M, L) float32
    gains: np.ndarray,  # (N, K) float32, added to
) -> np.ndarray:
    """Add shares @ likelihood to the gains of the visible Gaussians; return codes[ids].T @ shares, (K, L) float64.

    Most Gaussians are seen under one label or two, so most of the products are skipped.
    """
    many, classes = likelihood.shape
    parts = np.zeros((BLOCKS, many, classes))
    for block in nb.prange(BLOCKS):
        part = parts[block]
        for m in range(ids.shape[0] * block // BLOCKS, ids.shape[0] * (block + 1) // BLOCKS):
            code, gain = codes[ids[m]], gains[ids[m]]
            for y in range(many):
                share = shares[m, y]
                if share > 0:
                    for k in range(classes):
                        gain[k] += share * likelihood[y, k]
                        part[y, k] += share * code[k]
    counts: np.ndarray = parts.sum(axis=0).T
    return counts


@nb.njit(parallel=True, nogil=True, cache=True, fastmath={"contract"})
def tally(
    codes: np.ndarray,  # (N, K) float32
    ids: np.ndarray,  # (M,) int32
    shares: np.ndarray,  # (M, L) float32
) -> np.ndarray:
    """Return codes[ids].T @ shares, (K, L) float64: how much of each class lies under each label."""
    many, classes = shares.shape[1], codes.shape[1]
    parts = np.zeros((BLOCKS, many, classes))
    for block in nb.prange(BLOCKS):
        part = parts[block]
        for m in range(ids.shape[0] * block // BLOCKS, ids.shape[0] * (block + 1) // BLOCKS):
            code = codes[ids[m]]
            for y in range(many):
                share = shares[m, y]
                if share > 0:
                    for k in range(classes):
                        part[y, k] += share * code[k]
    counts: np.ndarray = parts.sum(axis=0).T
    return counts


@nb.njit(parallel=True, nogil=True, cache=True)
def add_votes(
    total: np.ndarray,  # (N, K) int64, added to
    ids: np.ndarray,  # (M,) int32, distinct
    classes: np.ndarray,  # (L,) int32, distinct
    votes: np.ndarray,  # (M, L) float32
    units: float,  # per vote; a power of 2
    sign: int,
) -> None:
    """Add a view's votes, or take them away, in whole units."""
    for m in nb.prange(ids.shape[0]):
        row = total[ids[m]]
        for y in range(classes.shape[0]):
            row[classes[y]] += sign * np.int64(np.rint(np.float64(votes[m, y]) * units))
