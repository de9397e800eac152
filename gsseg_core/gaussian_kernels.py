"""What learners do Gaussian by Gaussian with the products of one view."""

from __future__ import annotations

import numba as nb
import numpy as np

BLOCKS = 16
"""Counts are summed in this many parts, then together, so that they do not depend on the number of threads."""

GAIN_UNIT = 2.0**-24
"""Gains are rounded to whole multiples of this, in px, once per view: their sum does not depend on which views are
added first, nor on where."""

_GAIN_UNIT = np.float32(GAIN_UNIT)

_MAX_GAIN = np.float32(2**27 - 8)
"""Most that one view can give a Gaussian, in px. More comes about only where a class is all but ruled out for it, and
then it is just lifted less in this step."""

# The spacing of float64 there is GAIN_UNIT: what is added to it is rounded to whole units, which are its last bits.
_ROUND = 1.5 * 2**28
_ROUND_BITS = np.float64(_ROUND).view(np.int64)


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
    ids: np.ndarray,  # (M,) int32, distinct
    likelihood: np.ndarray,  # (L, K) float32
    shares: np.ndarray,  # (M, L) float32
    gains: np.ndarray,  # (N, K) int64, in units of GAIN_UNIT, added to
) -> None:
    """Add shares @ likelihood to the gains of the visible Gaussians.

    Most Gaussians are seen under one label or two, so most of the products are skipped.
    """
    many, classes = likelihood.shape
    for block in nb.prange(BLOCKS):
        row, rounded = np.empty(classes, np.float32), np.empty(classes)
        bits = rounded.view(np.int64)
        for m in range(ids.shape[0] * block // BLOCKS, ids.shape[0] * (block + 1) // BLOCKS):
            gain = gains[ids[m]]
            row[:] = 0.0
            seen = False
            for y in range(many):
                share = shares[m, y]
                if share > 0:
                    seen = True
                    for k in range(classes):
                        row[k] += share * likelihood[y, k]
            if seen:
                for k in range(classes):
                    rounded[k] = (row[k] if row[k] < _MAX_GAIN else _MAX_GAIN) + _ROUND
                for k in range(classes):
                    gain[k] += bits[k] - _ROUND_BITS


@nb.njit(parallel=True, nogil=True, cache=True)
def improve(
    codes: np.ndarray,  # (N, K) float32, changed in place
    gains: np.ndarray,  # (N, K) int64, in units of GAIN_UNIT
    prior: np.ndarray,  # (N, K) float32, px
) -> None:
    """Set the codes to normalise(codes * gains + prior); rows of zeros stay zero."""
    for i in nb.prange(codes.shape[0]):
        code, total = codes[i], np.float32(0.0)
        for k in range(codes.shape[1]):
            code[k] = code[k] * (np.float32(gains[i, k]) * _GAIN_UNIT) + prior[i, k]
            total += code[k]
        if total > 0:
            for k in range(codes.shape[1]):
                code[k] /= total


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
