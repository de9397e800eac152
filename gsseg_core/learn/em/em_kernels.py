"""What learners do Gaussian by Gaussian with the products of one view."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numba as nb
import numpy as np
from llvmlite import ir
from numba.core import types

from gsseg_core.simd import intrinsic

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
    rows: np.ndarray,  # (N + 1,) codes, as `CSRRows`
    classes: np.ndarray,  # (Z,) uint32
    codes: np.ndarray,  # (Z,) float32
    order: np.ndarray,  # (M,) int32: in which to go through the Gaussians
    ids: np.ndarray,  # (M,) int32
    start: np.ndarray,  # (M + 1,)
    labels: np.ndarray,  # (P,) int32
    likelihood: np.ndarray,  # (L, K) float32
) -> np.ndarray:
    """Return what each Gaussian says of the labels under which it is seen, codes[i] . likelihood[y]: (P,) float32."""
    out = np.empty(labels.shape[0], np.float32)
    for i in nb.prange(order.shape[0]):
        m = order[i]
        mine = slice(rows[ids[m]], rows[ids[m] + 1])
        code, which = codes[mine], classes[mine]
        for s in range(start[m], start[m + 1]):
            told, total = likelihood[labels[s]], np.float32(0.0)
            for z in range(code.shape[0]):
                total += code[z] * told[which[z]]
            out[s] = total
    return out


@nb.njit(parallel=True, nogil=True, cache=True)
def collect(
    rows: np.ndarray,  # (N + 1,) gains, as `CSRRows`
    classes: np.ndarray,  # (Z,)
    gains: np.ndarray,  # (Z,) int64, in units of GAIN_UNIT, added to
    order: np.ndarray,  # (M,) int32: in which to go through the Gaussians
    ids: np.ndarray,  # (M,) int32, distinct
    start: np.ndarray,  # (M + 1,)
    labels: np.ndarray,  # (P,) int32
    likelihood: np.ndarray,  # (L, K) float32
    shares: np.ndarray,  # (P,) float32
) -> None:
    """Add to the gains of each Gaussian its shares times the likelihoods of their labels."""
    for i in nb.prange(order.shape[0]):
        m = order[i]
        mine = slice(rows[ids[m]], rows[ids[m] + 1])
        gain, which = gains[mine], classes[mine]
        for s in range(start[m], start[m + 1]):
            told, share = likelihood[labels[s]], shares[s]
            for z in range(gain.shape[0]):
                gain[z] += in_units(share * told[which[z]])


@nb.njit(parallel=True, nogil=True, cache=True)
def improve(
    rows: np.ndarray,  # (N + 1,) all three, as `CSRRows`
    codes: np.ndarray,  # (Z,) float32, changed in place
    gains: np.ndarray,  # (Z,) int64, in units of GAIN_UNIT
    prior: np.ndarray,  # (Z,) float32, px
) -> None:
    """Set the codes to normalise(codes * gains + prior); rows of zeros stay zero."""
    for i in nb.prange(rows.shape[0] - 1):
        total = np.float32(0.0)
        for z in range(rows[i], rows[i + 1]):
            codes[z] = codes[z] * (np.float32(gains[z]) * _GAIN_UNIT) + prior[z]
            total += codes[z]
        if total > 0:
            for z in range(rows[i], rows[i + 1]):
                codes[z] /= total


@nb.njit(parallel=True, nogil=True, cache=True)
def promised(
    rows: np.ndarray,  # (N + 1,) all three, as `CSRRows`
    codes: np.ndarray,  # (Z,) float32
    gains: np.ndarray,  # (Z,) int64, in units of GAIN_UNIT
    prior: np.ndarray,  # (Z,) float32, px
) -> float:
    """Return the slope of the objective along the step that `improve` takes, in nats, at least 0.

    With p = codes * gains + prior, the gradient of the objective is p / codes, and the step leads to p / sum(p).
    """
    blocks = np.zeros(BLOCKS)
    for block in nb.prange(BLOCKS):
        for i in range(block * (rows.shape[0] - 1) // BLOCKS, (block + 1) * (rows.shape[0] - 1) // BLOCKS):
            total, there = 0.0, 0.0
            for z in range(rows[i], rows[i + 1]):
                if codes[z] > 0:
                    p = np.float64(codes[z]) * gains[z] * GAIN_UNIT + prior[z]
                    total += p
                    there += p * p / codes[z]
            if total > 0:
                blocks[block] += there / total - total
    return float(blocks.sum())


@nb.njit(parallel=True, nogil=True, cache=True)
def improve_without(
    rows: np.ndarray,  # (N + 1,) all three that follow, as `CSRRows`
    classes: np.ndarray,  # (Z,)
    codes: np.ndarray,  # (Z,) float32
    gains: np.ndarray,  # (Z,) int64, in units of GAIN_UNIT
    prior: np.ndarray,  # (Z,) float32, px
    order: np.ndarray,  # (M,) int32: in which to go through the Gaussians
    ids: np.ndarray,  # (M,) int32
    start: np.ndarray,  # (M + 1,)
    labels: np.ndarray,  # (P,) int32
    likelihood: np.ndarray,  # (L, K) float32
    shares: np.ndarray,  # (P,) float32
    out_rows: np.ndarray,  # (M + 1,) the result, as `CSRRows` in that order
    out_classes: np.ndarray,  # (Z',) out
    out: np.ndarray,  # (Z',) float32 out
) -> None:
    """Improve the codes of the Gaussians that a view sees by the gains less what `collect` added for this view."""
    for i in nb.prange(order.shape[0]):
        m = order[i]
        first, total = rows[ids[m]], np.float32(0.0)
        for j in range(out_rows[i + 1] - out_rows[i]):
            z, k = out_rows[i] + j, classes[first + j]
            others = gains[first + j]
            for s in range(start[m], start[m + 1]):
                others -= in_units(shares[s] * likelihood[labels[s], k])
            out_classes[z] = k
            out[z] = codes[first + j] * (np.float32(others) * _GAIN_UNIT) + prior[first + j]
            total += out[z]
        if total > 0:
            for z in range(out_rows[i], out_rows[i + 1]):
                out[z] /= total


@nb.njit(parallel=True, nogil=True, cache=True)
def tally(
    rows: np.ndarray,  # (M + 1,) codes, as `CSRRows`
    classes: np.ndarray,  # (Z,)
    codes: np.ndarray,  # (Z,) float32
    order: np.ndarray,  # (M,) int32: whose rows these are
    start: np.ndarray,  # (M + 1,)
    labels: np.ndarray,  # (P,) int32
    shares: np.ndarray,  # (P,) float32
    num_classes: int,
    num_labels: int,
) -> np.ndarray:
    """Return the sum over the sightings of codes[i] times share, by label, (K, L) float64: what lies under each."""
    many = order.shape[0]
    parts = np.zeros((BLOCKS, num_classes, num_labels))
    for block in nb.prange(BLOCKS):
        part = parts[block]
        for i in range(many * block // BLOCKS, many * (block + 1) // BLOCKS):
            m = order[i]
            for s in range(start[m], start[m + 1]):
                for z in range(rows[i], rows[i + 1]):
                    part[classes[z], labels[s]] += shares[s] * codes[z]
    counts: np.ndarray = parts.sum(axis=0)
    return counts


@nb.njit(parallel=True, nogil=True, cache=True)
def share_votes(
    votes: np.ndarray,  # (N, K) int64
    possible: np.ndarray,  # (K,) bool: ids that are classes
    codes: np.ndarray,  # (N, K) float32 out
) -> int:
    """Divide the votes for classes by their sum; rows of zeros stay zero.

    Votes below 0 are against a class. Where there are such, and none for any, the one class that has none at all is
    what is left. Where several have none, the row is left zero; returns how many rows these are.
    """
    unsure = 0
    for i in nb.prange(votes.shape[0]):
        total, against, free, left = np.int64(0), False, 0, -1
        for k in range(votes.shape[1]):
            total += max(votes[i, k], 0)
            against |= votes[i, k] < 0
            if votes[i, k] == 0 and possible[k]:
                free, left = free + 1, k
        for k in range(votes.shape[1]):
            codes[i, k] = max(votes[i, k], 0) / total if total > 0 else 0.0
        if total == 0 and against:
            if free == 1:
                codes[i, left] = 1.0
            else:
                unsure += 1
    return unsure


@nb.njit(nogil=True, cache=True)
def take_row(
    classes: np.ndarray,  # (n,) of one Gaussian
    total: np.ndarray,  # (n,) int64, taken from
    labels: np.ndarray,  # (s,) label of each of its sightings
    said_start: np.ndarray,  # (L + 1,) what a pixel of each label votes, as `CSRRows`
    said_classes: np.ndarray,
    said: np.ndarray,  # float64
    votes: np.ndarray,  # (s,) float32
    units: float,  # per vote; a power of 2
) -> None:
    """Take what a view has voted for one Gaussian away from the votes of all, rounded as when it was added."""
    for s in range(labels.shape[0]):
        for j in range(said_start[labels[s]], said_start[labels[s] + 1]):
            for z in range(classes.shape[0]):
                if classes[z] == said_classes[j]:
                    total[z] -= np.int64(np.rint(np.float64(votes[s]) * said[j] * units))


@nb.njit(parallel=True, nogil=True, cache=True)
def take_votes(
    first: np.ndarray,  # (M,) where the row of each Gaussian begins
    last: np.ndarray,  # (M,) one past its end
    classes: np.ndarray,  # (Z,)
    total: np.ndarray,  # (Z,) int64, taken from
    order: np.ndarray,  # (M,) int32: whose rows these are
    start: np.ndarray,  # (M + 1,)
    labels: np.ndarray,  # (P,) int32: label of each sighting
    said_start: np.ndarray,  # (L + 1,) what a pixel of each label votes, as `CSRRows`
    said_classes: np.ndarray,
    said: np.ndarray,  # float64
    votes: np.ndarray,  # (P,) float32
    units: float,  # per vote; a power of 2
) -> None:
    """Take a view's votes away from those of all, row by row."""
    for i in nb.prange(order.shape[0]):
        row, seen = slice(first[i], last[i]), slice(start[order[i]], start[order[i] + 1])
        take_row(classes[row], total[row], labels[seen], said_start, said_classes, said, votes[seen], units)
