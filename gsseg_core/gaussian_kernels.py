"""What learners do Gaussian by Gaussian with the products of one view."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numba as nb
import numpy as np
from llvmlite import ir
from numba.core import types

from gsseg_core.lanes import intrinsic

BLOCKS = 16
"""Counts are summed in this many parts, then together, so that they do not depend on the number of threads."""

GAIN_UNIT = 2.0**-24
"""Gains are sums of whole multiples of this, in px: they do not depend on which views are added first, nor on where."""

_GAIN_UNIT = np.float32(GAIN_UNIT)

_MAX_GAIN = 2.0**27 - 8
"""Most that one label of one view can give a Gaussian, in px. More comes about only where a class is all but ruled out
for it, and then it is just lifted less in this step."""

# Float64 are as far apart here as GAIN_UNIT: what is added to this is rounded to whole units, which are its last bits.
_ROUND = 1.5 * 2.0**28
_ROUND_BITS = int(np.float64(_ROUND).view(np.int64))


@intrinsic
def in_units(_: Any, __: Any) -> Any:
    """Round pixels, float32 of at least 0, to int64 in units of GAIN_UNIT, by instructions that vector units have."""

    def write(_: Any, llvm: Any, __: Any, arguments: Sequence[Any]) -> Any:
        most, double, bits = ir.Constant(ir.FloatType(), _MAX_GAIN), ir.DoubleType(), ir.IntType(64)
        pixels = llvm.select(llvm.fcmp_ordered("<", arguments[0], most), arguments[0], most)
        shifted = llvm.fadd(llvm.fpext(pixels, double), ir.Constant(double, _ROUND))
        return llvm.sub(llvm.bitcast(shifted, bits), ir.Constant(bits, _ROUND_BITS))

    return types.int64(types.float32), write


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
    for m in nb.prange(ids.shape[0]):
        gain = gains[ids[m]]
        for y in range(likelihood.shape[0]):
            share = shares[m, y]
            if share > 0:
                for k in range(likelihood.shape[1]):
                    gain[k] += in_units(share * likelihood[y, k])


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
