"""Kernels of EM, over the (Gaussian, label) pairs of one view.

Class probabilities, `codes`, are N rows of Z entries in all, `CSRRows` of float32; each entry has a `gradient`, (Z,)
int64 in units of `GRADIENT_UNIT`, and a `prior`, (Z,) float32 in px. The `likelihood` of each label given the class is
(L, K) float32. `shares`, (P,) float32, are those of the pairs in one vote per labelled pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numba as nb
import numpy as np
from llvmlite import ir
from numba.core import types

from gsseg_core.csr_rows import CSRRows
from gsseg_core.kernels.compiler import kernel
from gsseg_core.raster.observation import Observation, ViewPairs
from gsseg_core.simd import intrinsic

BLOCKS = 16  # counts are summed in this many parts, then together, so that they do not depend on the number of threads

GRADIENT_UNIT = 2.0**-24
"""Gradients are sums of whole multiples of this, in px, so they depend neither on the order of views nor on where."""

_GRADIENT_UNIT = np.float32(GRADIENT_UNIT)

MAX_TERM = 2.0**27 - 8
"""Most that one pair can add to a gradient, in px. More occurs only where a class has next to no probability, which
then rises less in this step."""

# Float64 are GRADIENT_UNIT apart here: what is added to this is rounded to whole units, which are its last bits.
_ROUND = 1.5 * 2.0**28
_ROUND_BITS = int(np.float64(_ROUND).view(np.int64))


def pairs_of(observation: Observation) -> ViewPairs:
    """Take the pairs of an observation."""
    return ViewPairs(observation.ids, observation.start, observation.labels)


def by_row(pairs: ViewPairs) -> ViewPairs:
    """Replace ids in the scene by places among the Gaussians of the view: rows of arrays that hold these alone."""
    return pairs._replace(ids=np.arange(len(pairs.ids), dtype=np.int32))


def rows_like(rows: CSRRows, ids: np.ndarray) -> CSRRows:  # (M,)
    """Make M rows as long as those of `ids`, with nothing written into them."""
    return CSRRows.room_for(np.diff(rows.indptr)[ids], rows.data.dtype)


@intrinsic
def rounded_to_units(_: Any, __: Any) -> Any:
    """Round px, float32 of at least 0, to int64 in units of GRADIENT_UNIT, by instructions that vector units have."""

    def write(_: Any, llvm: Any, __: Any, arguments: Sequence[Any]) -> Any:
        most, double, bits = ir.Constant(ir.FloatType(), MAX_TERM), ir.DoubleType(), ir.IntType(64)
        pixels = llvm.select(llvm.fcmp_ordered("<", arguments[0], most), arguments[0], most)
        shifted = llvm.fadd(llvm.fpext(pixels, double), ir.Constant(double, _ROUND))
        return llvm.sub(llvm.bitcast(shifted, bits), ir.Constant(bits, _ROUND_BITS))

    return types.int64(types.float32), write


@kernel(parallel=True, fastmath={"contract", "reassoc"})
def pair_likelihood(codes: CSRRows, pairs: ViewPairs, likelihood: np.ndarray) -> np.ndarray:
    """Likelihood of the label of each (Gaussian, label) pair, codes[i] . likelihood[y]: (P,) float32."""
    indptr, classes, data = codes
    ids, start, labels = pairs
    out = np.empty(labels.shape[0], np.float32)
    for m in nb.prange(ids.shape[0]):
        row = slice(indptr[ids[m]], indptr[ids[m] + 1])
        code, which = data[row], classes[row]
        for s in range(start[m], start[m + 1]):
            by_class, total = likelihood[labels[s]], np.float32(0.0)
            for z in range(code.shape[0]):
                total += code[z] * by_class[which[z]]
            out[s] = total
    return out


@kernel(parallel=True)
def accumulate(gradient: CSRRows, pairs: ViewPairs, likelihood: np.ndarray, shares: np.ndarray) -> None:
    """Add one view's term to the gradient: sum over a Gaussian's pairs of share times likelihood of the label."""
    indptr, classes, data = gradient
    ids, start, labels = pairs
    for m in nb.prange(ids.shape[0]):
        row = slice(indptr[ids[m]], indptr[ids[m] + 1])
        entries, which = data[row], classes[row]
        for s in range(start[m], start[m + 1]):
            by_class, share = likelihood[labels[s]], shares[s]
            for z in range(entries.shape[0]):
                entries[z] += rounded_to_units(share * by_class[which[z]])


@kernel(parallel=True)
def m_step(codes: CSRRows, gradient: np.ndarray, prior: np.ndarray) -> None:
    """M-step: set the codes to normalise(codes * gradient + prior), in place; rows of zeros stay zero."""
    indptr, _, data = codes
    for i in nb.prange(indptr.shape[0] - 1):
        total = np.float32(0.0)
        for z in range(indptr[i], indptr[i + 1]):
            data[z] = data[z] * (np.float32(gradient[z]) * _GRADIENT_UNIT) + prior[z]
            total += data[z]
        if total > 0:
            for z in range(indptr[i], indptr[i + 1]):
                data[z] /= total


@kernel(parallel=True)
def predicted_gain(codes: CSRRows, gradient: np.ndarray, prior: np.ndarray) -> float:
    """Slope of J along the step that `m_step` takes, in nats, at least 0: an upper bound of what it gains.

    With p = codes * gradient + prior, the gradient of J is p / codes, and the step leads to p / sum(p).
    """
    indptr, _, data = codes
    blocks = np.zeros(BLOCKS)
    for block in nb.prange(BLOCKS):
        for i in range(block * (indptr.shape[0] - 1) // BLOCKS, (block + 1) * (indptr.shape[0] - 1) // BLOCKS):
            total, there = 0.0, 0.0
            for z in range(indptr[i], indptr[i + 1]):
                if data[z] > 0:
                    p = np.float64(data[z]) * gradient[z] * GRADIENT_UNIT + prior[z]
                    total += p
                    there += p * p / data[z]
            if total > 0:
                blocks[block] += there / total - total
    return float(blocks.sum())


@kernel(parallel=True)
def m_step_without_view(
    codes: CSRRows, gradient: np.ndarray, prior: np.ndarray, pairs: ViewPairs, likelihood: np.ndarray,
    shares: np.ndarray, stepped: CSRRows,
) -> None:  # fmt: skip
    """M-step of the M Gaussians that a view sees, with the gradient less what `accumulate` added for this view.

    Written are the classes and the entries of `stepped`, M rows.
    """
    indptr, classes, data = codes
    ids, start, labels = pairs
    out_indptr, out_classes, out = stepped
    for m in nb.prange(ids.shape[0]):
        first, total = indptr[ids[m]], np.float32(0.0)
        for j in range(out_indptr[m + 1] - out_indptr[m]):
            z, k = out_indptr[m] + j, classes[first + j]
            remaining = gradient[first + j]
            for s in range(start[m], start[m + 1]):
                remaining -= rounded_to_units(shares[s] * likelihood[labels[s], k])
            out_classes[z] = k
            out[z] = data[first + j] * (np.float32(remaining) * _GRADIENT_UNIT) + prior[first + j]
            total += out[z]
        if total > 0:
            for z in range(out_indptr[m], out_indptr[m + 1]):
                out[z] /= total


def confusion_counts(
    codes: CSRRows, pairs: ViewPairs, shares: np.ndarray, num_classes: int, num_labels: int
) -> np.ndarray:
    """Sum over the pairs of codes[m] times share, by class and label, (K, L) float64; row m is of `pairs.ids[m]`."""
    parts = np.zeros((BLOCKS, num_classes, num_labels))
    _count_confusions(codes, pairs, shares, parts)
    return np.asarray(parts.sum(axis=0))


@kernel(parallel=True)
def _count_confusions(codes: CSRRows, pairs: ViewPairs, shares: np.ndarray, parts: np.ndarray) -> None:
    indptr, classes, data = codes
    ids, start, labels = pairs
    for block in nb.prange(BLOCKS):
        part = parts[block]
        for m in range(ids.shape[0] * block // BLOCKS, ids.shape[0] * (block + 1) // BLOCKS):
            for s in range(start[m], start[m + 1]):
                for z in range(indptr[m], indptr[m + 1]):
                    part[classes[z], labels[s]] += shares[s] * data[z]
