"""Kernels of EM and of votes, over the (Gaussian, label) pairs of one view."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numba as nb
import numpy as np
from llvmlite import ir
from numba.core import types

from gsseg_core.data.label_evidence import vote_units
from gsseg_core.simd import intrinsic

BLOCKS = 16  # counts are summed in this many parts, then together, so that they do not depend on the number of threads

GRADIENT_UNIT = 2.0**-24
"""Gradients are sums of whole multiples of this, in px, so they depend neither on the order of views nor on where."""

_GRADIENT_UNIT = np.float32(GRADIENT_UNIT)

_MAX_TERM = 2.0**27 - 8
"""Most that one pair can add to a gradient, in px. More occurs only where a class has next to no probability, which
then rises less in this step."""

# Float64 are GRADIENT_UNIT apart here: what is added to this is rounded to whole units, which are its last bits.
_ROUND = 1.5 * 2.0**28
_ROUND_BITS = int(np.float64(_ROUND).view(np.int64))


@intrinsic
def rounded_to_units(_: Any, __: Any) -> Any:
    """Round px, float32 of at least 0, to int64 in units of GRADIENT_UNIT, by instructions that vector units have."""

    def write(_: Any, llvm: Any, __: Any, arguments: Sequence[Any]) -> Any:
        most, double, bits = ir.Constant(ir.FloatType(), _MAX_TERM), ir.DoubleType(), ir.IntType(64)
        pixels = llvm.select(llvm.fcmp_ordered("<", arguments[0], most), arguments[0], most)
        shifted = llvm.fadd(llvm.fpext(pixels, double), ir.Constant(double, _ROUND))
        return llvm.sub(llvm.bitcast(shifted, bits), ir.Constant(bits, _ROUND_BITS))

    return types.int64(types.float32), write


@nb.njit(parallel=True, nogil=True, cache=True, fastmath={"contract", "reassoc"})
def pair_likelihood(
    indptr: np.ndarray, classes: np.ndarray, codes: np.ndarray,  # (N + 1,), (Z,) uint32, (Z,) float32, as `CSRRows`
    order: np.ndarray, ids: np.ndarray,  # (M,) int32: in which to go through the Gaussians; (M,) int32
    start: np.ndarray, labels: np.ndarray, likelihood: np.ndarray,  # (M + 1,), (P,) int32, (L, K) float32
) -> np.ndarray:  # fmt: skip
    """Likelihood of the label of each (Gaussian, label) pair, codes[i] . likelihood[y]: (P,) float32."""
    out = np.empty(labels.shape[0], np.float32)
    for i in nb.prange(order.shape[0]):
        m = order[i]
        row = slice(indptr[ids[m]], indptr[ids[m] + 1])
        code, which = codes[row], classes[row]
        for s in range(start[m], start[m + 1]):
            by_class, total = likelihood[labels[s]], np.float32(0.0)
            for z in range(code.shape[0]):
                total += code[z] * by_class[which[z]]
            out[s] = total
    return out


@nb.njit(parallel=True, nogil=True, cache=True)
def accumulate(
    indptr: np.ndarray, classes: np.ndarray,  # (N + 1,), (Z,), with the next as `CSRRows`
    gradient: np.ndarray,  # (Z,) int64, in units of GRADIENT_UNIT, added to
    order: np.ndarray, ids: np.ndarray,  # (M,) int32: in which to go through the Gaussians; (M,) int32, distinct
    start: np.ndarray, labels: np.ndarray,  # (M + 1,), (P,) int32
    likelihood: np.ndarray, shares: np.ndarray,  # (L, K) float32, (P,) float32
) -> None:  # fmt: skip
    """Add one view's term to the gradient: sum over a Gaussian's pairs of share times likelihood of the label."""
    for i in nb.prange(order.shape[0]):
        m = order[i]
        row = slice(indptr[ids[m]], indptr[ids[m] + 1])
        entries, which = gradient[row], classes[row]
        for s in range(start[m], start[m + 1]):
            by_class, share = likelihood[labels[s]], shares[s]
            for z in range(entries.shape[0]):
                entries[z] += rounded_to_units(share * by_class[which[z]])


@nb.njit(parallel=True, nogil=True, cache=True)
def m_step(
    indptr: np.ndarray, codes: np.ndarray,  # (N + 1,), (Z,) float32, changed in place
    gradient: np.ndarray, prior: np.ndarray,  # (Z,) int64, in units of GRADIENT_UNIT; (Z,) float32, px
) -> None:  # fmt: skip
    """M-step: set the codes to normalise(codes * gradient + prior), in place; rows of zeros stay zero."""
    for i in nb.prange(indptr.shape[0] - 1):
        total = np.float32(0.0)
        for z in range(indptr[i], indptr[i + 1]):
            codes[z] = codes[z] * (np.float32(gradient[z]) * _GRADIENT_UNIT) + prior[z]
            total += codes[z]
        if total > 0:
            for z in range(indptr[i], indptr[i + 1]):
                codes[z] /= total


@nb.njit(parallel=True, nogil=True, cache=True)
def predicted_gain(
    indptr: np.ndarray, codes: np.ndarray,  # (N + 1,), (Z,) float32
    gradient: np.ndarray, prior: np.ndarray,  # (Z,) int64, in units of GRADIENT_UNIT; (Z,) float32, px
) -> float:  # fmt: skip
    """Slope of J along the step that `m_step` takes, in nats, at least 0: an upper bound of what it gains.

    With p = codes * gradient + prior, the gradient of J is p / codes, and the step leads to p / sum(p).
    """
    blocks = np.zeros(BLOCKS)
    for block in nb.prange(BLOCKS):
        for i in range(block * (indptr.shape[0] - 1) // BLOCKS, (block + 1) * (indptr.shape[0] - 1) // BLOCKS):
            total, there = 0.0, 0.0
            for z in range(indptr[i], indptr[i + 1]):
                if codes[z] > 0:
                    p = np.float64(codes[z]) * gradient[z] * GRADIENT_UNIT + prior[z]
                    total += p
                    there += p * p / codes[z]
            if total > 0:
                blocks[block] += there / total - total
    return float(blocks.sum())


@nb.njit(parallel=True, nogil=True, cache=True)
def m_step_without_view(
    indptr: np.ndarray, classes: np.ndarray, codes: np.ndarray,  # (N + 1,), (Z,), (Z,) float32, as `CSRRows`
    gradient: np.ndarray, prior: np.ndarray,  # (Z,) int64, in units of GRADIENT_UNIT; (Z,) float32, px
    order: np.ndarray, ids: np.ndarray,  # (M,) int32: in which to go through the Gaussians; (M,) int32
    start: np.ndarray, labels: np.ndarray,  # (M + 1,), (P,) int32
    likelihood: np.ndarray, shares: np.ndarray,  # (L, K) float32, (P,) float32
    out_indptr: np.ndarray, out_classes: np.ndarray,  # (M + 1,); (Z',) out; with the next as `CSRRows`, in that order
    out: np.ndarray,  # (Z',) float32 out
) -> None:  # fmt: skip
    """M-step of the Gaussians that a view sees, with the gradient less what `accumulate` added for this view."""
    for i in nb.prange(order.shape[0]):
        m = order[i]
        first, total = indptr[ids[m]], np.float32(0.0)
        for j in range(out_indptr[i + 1] - out_indptr[i]):
            z, k = out_indptr[i] + j, classes[first + j]
            remaining = gradient[first + j]
            for s in range(start[m], start[m + 1]):
                remaining -= rounded_to_units(shares[s] * likelihood[labels[s], k])
            out_classes[z] = k
            out[z] = codes[first + j] * (np.float32(remaining) * _GRADIENT_UNIT) + prior[first + j]
            total += out[z]
        if total > 0:
            for z in range(out_indptr[i], out_indptr[i + 1]):
                out[z] /= total


@nb.njit(parallel=True, nogil=True, cache=True)
def confusion_counts(
    indptr: np.ndarray, classes: np.ndarray, codes: np.ndarray,  # (M + 1,), (Z,), (Z,) float32, as `CSRRows`
    order: np.ndarray, start: np.ndarray,  # (M,) int32: whose rows these are; (M + 1,)
    labels: np.ndarray, shares: np.ndarray,  # (P,) int32, (P,) float32
    num_classes: int, num_labels: int,
) -> np.ndarray:  # fmt: skip
    """Sum over the pairs of codes[i] times share, by class and label, (K, L) float64."""
    parts = np.zeros((BLOCKS, num_classes, num_labels))
    for block in nb.prange(BLOCKS):
        part = parts[block]
        for i in range(order.shape[0] * block // BLOCKS, order.shape[0] * (block + 1) // BLOCKS):
            m = order[i]
            for s in range(start[m], start[m + 1]):
                for z in range(indptr[i], indptr[i + 1]):
                    part[classes[z], labels[s]] += shares[s] * codes[z]
    counts: np.ndarray = parts.sum(axis=0)
    return counts


@nb.njit(parallel=True, nogil=True, cache=True)
def normalise_votes(
    votes: np.ndarray, possible: np.ndarray,  # (N, K) int64; (K,) bool: ids that are classes
    codes: np.ndarray,  # (N, K) float32 out
) -> int:  # fmt: skip
    """Divide the votes for classes by their sum; rows of zeros stay zero.

    Votes below 0 are against a class. Where there are only such, the one class without any is certain; where several
    have none, the row is left zero. Returns how many rows these are.
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
def subtract_row(
    classes: np.ndarray, total: np.ndarray,  # (n,) of one Gaussian; (n,) int64, taken from
    labels: np.ndarray,  # (s,) label of each of its pairs
    vote_indptr: np.ndarray, vote_classes: np.ndarray, vote: np.ndarray,  # votes of a pixel of each label: L `CSRRows`
    votes: np.ndarray, units: float,  # (s,) float32; per vote, a power of 2
) -> None:  # fmt: skip
    """Subtract one view's votes for one Gaussian, rounded as when they were added."""
    for s in range(labels.shape[0]):
        for j in range(vote_indptr[labels[s]], vote_indptr[labels[s] + 1]):
            for z in range(classes.shape[0]):
                if classes[z] == vote_classes[j]:
                    total[z] -= vote_units(votes[s], vote[j], units)


@nb.njit(parallel=True, nogil=True, cache=True)
def subtract_votes(
    first: np.ndarray, last: np.ndarray,  # (M,) where the row of each Gaussian begins; (M,) one past its end
    classes: np.ndarray, total: np.ndarray,  # (Z,), (Z,) int64, taken from
    order: np.ndarray, start: np.ndarray, labels: np.ndarray,  # (M,) int32: whose rows these are; (M + 1,), (P,) int32
    vote_indptr: np.ndarray, vote_classes: np.ndarray, vote: np.ndarray,  # as in `subtract_row`
    votes: np.ndarray, units: float,  # (P,) float32; per vote, a power of 2
) -> None:  # fmt: skip
    """Subtract one view's votes from those of all, row by row."""
    for i in nb.prange(order.shape[0]):
        row, seen = slice(first[i], last[i]), slice(start[order[i]], start[order[i] + 1])
        subtract_row(classes[row], total[row], labels[seen], vote_indptr, vote_classes, vote, votes[seen], units)
