"""EM kernels for the (Gaussian, label) pairs of one view, on the CPU; `em_gpu_kernels` has the same for a GPU.

The class probabilities `codes` are `CSRRows` of float32: N rows with Z entries in total. Each entry has a `gradient`,
(Z,) int64 in units of `GRADIENT_UNIT`, and a `prior`, (Z,) float32 in px. The `likelihood` of each label given the
class is (L, K) float32. `shares`, (P,) float32, are how the pairs share one vote per labelled pixel.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeVar

import numba as nb
import numpy as np
from llvmlite import ir
from numba.core import types

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.label_evidence import UNITS, LabelEvidence, vote_units
from gsseg_core.kernels.compiler import called_by_kernels, kernel
from gsseg_core.learn.em.scene_edges import scene_edges as scene_edges
from gsseg_core.learn.vote_resolution import resolve_row
from gsseg_core.raster.observation import Observation, ViewPairs, VoteShares
from gsseg_core.simd import intrinsic

T = TypeVar("T")

BLOCKS = 16  # counts are summed in this fixed number of parts, so that results do not depend on the number of threads
_AT_ONCE = 1 << 23  # entries of such parts to hold in memory at a time; at least one part is held

GRADIENT_UNIT = 2.0**-24
"""Unit of gradients, in px: integer sums depend neither on the order of views nor on where these are added."""

_GRADIENT_UNIT = np.float32(GRADIENT_UNIT)

MAX_TERM = 2.0**27 - 8
"""Most that one pair can add to a gradient, in px. Larger terms occur only if a class has almost no probability; the
limit then slows its rise in this step."""

# Near this value, float64 numbers are GRADIENT_UNIT apart: a sum with it is rounded to whole units, in its last bits.
_ROUND = 1.5 * 2.0**28
_ROUND_BITS = int(np.float64(_ROUND).view(np.int64))


def pairs_of(observation: Observation) -> ViewPairs:
    """Return the pairs of an observation."""
    return ViewPairs(observation.ids, observation.start, observation.labels)


def by_row(pairs: ViewPairs) -> ViewPairs:
    """Replace Gaussian ids by positions among the view's Gaussians, to index arrays that only have rows for these."""
    return pairs._replace(ids=np.arange(len(pairs.ids), dtype=np.int32))


def rows_like(rows: CSRRows, ids: np.ndarray) -> CSRRows:  # (M,)
    """Allocate M rows as long as those of `ids`, without initialising them."""
    return CSRRows.room_for(np.diff(rows.indptr)[ids], rows.data.dtype)


def put(values: T, device: str) -> T:
    """Return an array, or rows, unchanged: CPU kernels use them in place."""
    del device
    return values


def returned(array: np.ndarray) -> np.ndarray:
    """Return an array that kernels have changed; on the CPU nothing has to be copied back."""
    return array


def zeros(rows: CSRRows, kind: type[np.generic]) -> np.ndarray:
    """Return one zero for each entry of some rows."""
    return np.zeros(len(rows.data), kind)


def shares(observation: Observation, codes: CSRRows, pairs: ViewPairs, likelihood: np.ndarray) -> VoteShares:
    """Share one vote per labelled pixel among its pairs by class probabilities, as in `Observation.shares`."""
    return observation.shares(pair_likelihood(codes, pairs, likelihood), likelihood[:, 0])


@intrinsic
def rounded_to_units(_: Any, __: Any) -> Any:
    """Round px, float32 of at least 0, to int64 in units of GRADIENT_UNIT, with vector (SIMD) instructions only."""

    def write(_: Any, llvm: Any, __: Any, arguments: Sequence[Any]) -> Any:
        most, double, bits = ir.Constant(ir.FloatType(), MAX_TERM), ir.DoubleType(), ir.IntType(64)
        pixels = llvm.select(llvm.fcmp_ordered("<", arguments[0], most), arguments[0], most)
        shifted = llvm.fadd(llvm.fpext(pixels, double), ir.Constant(double, _ROUND))
        return llvm.sub(llvm.bitcast(shifted, bits), ir.Constant(bits, _ROUND_BITS))

    return types.int64(types.float32), write


@kernel(parallel=True, fastmath={"contract", "reassoc"})
def pair_likelihood(codes: CSRRows, pairs: ViewPairs, likelihood: np.ndarray) -> np.ndarray:
    """Return the likelihood of the label of each (Gaussian, label) pair, codes[i] . likelihood[y]: (P,) float32."""
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
    """Add one view's term to the gradient: the sum over a Gaussian's pairs of share times likelihood of the label."""
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
    """M-step: set the codes to normalise(codes * gradient + prior), in place; rows for which this is zero stay.

    So a Gaussian without a prior that is seen only in skipped blocks keeps the probabilities from its votes.
    """
    indptr, _, data = codes
    for i in nb.prange(indptr.shape[0] - 1):
        total = np.float32(0.0)
        for z in range(indptr[i], indptr[i + 1]):
            total += data[z] * (np.float32(gradient[z]) * _GRADIENT_UNIT) + prior[z]
        if total > 0:
            for z in range(indptr[i], indptr[i + 1]):
                data[z] = (data[z] * (np.float32(gradient[z]) * _GRADIENT_UNIT) + prior[z]) / total


@kernel(parallel=True)
def predicted_gain(codes: CSRRows, gradient: np.ndarray, prior: np.ndarray) -> float:
    """Return the slope of J along the step of `m_step`, in nats, at least 0: an upper bound of the step's gain.

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
    """M-step of the M Gaussians that a view sees, with the gradient minus the term that `accumulate` added for it.

    Writes the classes and entries of `stepped`, M rows.
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
    """Sum codes[m] times share over the pairs, by class and label, (K, L) float64; row m belongs to `pairs.ids[m]`."""
    return _in_parts((num_classes, num_labels), partial(_count_confusions, codes, pairs, shares))


def _in_parts(shape: tuple[int, int], count: Callable[[int, np.ndarray], None]) -> np.ndarray:
    """Sum the tables of all blocks; `count` gets the first of some blocks, and fills their tables, which are zeros."""
    total = np.zeros(shape)
    parts = np.zeros((min(max(_AT_ONCE // max(total.size, 1), 1), BLOCKS), *shape))
    for first in range(0, BLOCKS, len(parts)):
        some = parts[: BLOCKS - first]
        count(first, some)
        _move_into(total, some)
    return total


@kernel(parallel=True)
def _move_into(total: np.ndarray, parts: np.ndarray) -> None:
    """Add tables to a total one after the other and reset them to zero; most entries are zero and are skipped."""
    for k in nb.prange(total.shape[0]):
        for place in range(parts.shape[0]):
            for y in range(total.shape[1]):
                if parts[place, k, y] != 0:
                    total[k, y] += parts[place, k, y]
                    parts[place, k, y] = 0


@kernel(parallel=True)
def _count_confusions(codes: CSRRows, pairs: ViewPairs, shares: np.ndarray, begin: int, parts: np.ndarray) -> None:
    indptr, classes, data = codes
    ids, start, labels = pairs
    for place in nb.prange(parts.shape[0]):
        part, block = parts[place], begin + place
        for m in range(ids.shape[0] * block // BLOCKS, ids.shape[0] * (block + 1) // BLOCKS):
            for s in range(start[m], start[m + 1]):
                for z in range(indptr[m], indptr[m + 1]):
                    part[classes[z], labels[s]] += shares[s] * data[z]


def leave_one_out_counts(
    votes: CSRRows,  # int64, of all views including this one
    observation: Observation,
    possible: np.ndarray,  # (K,) bool: ids that are classes
    evidence: LabelEvidence,  # with which the view voted
    power: float = 1.0,
    most: float = np.inf,
) -> np.ndarray:
    """Count the pixels of each class under each label of a view, by the votes of all other views: (K, L) float64.

    Probabilities are raised to `power` and normalised before they are counted; a power above 1 favours majorities. A
    Gaussian counts for at most `most` times the pixels that the other views saw of it.
    """
    pairs, own, class_ids = pairs_of(observation), observation.votes(), np.flatnonzero(possible)
    count = partial(_count, votes, pairs, own, evidence.votes, class_ids, power, most)
    return _in_parts((len(possible), evidence.votes.num_rows), count)


def subtract_votes(total: CSRRows, observation: Observation, label_votes: CSRRows) -> None:
    """Subtract one view's votes, by `LabelEvidence.votes`, from those of all views, N rows of int64, in place."""
    _subtract_votes(total, pairs_of(observation), observation.votes(), label_votes)


@kernel(parallel=True)
def _subtract_votes(total: CSRRows, pairs: ViewPairs, own: np.ndarray, label_votes: CSRRows) -> None:
    indptr, classes, data = total
    ids, start, labels = pairs
    for m in nb.prange(ids.shape[0]):
        _subtract_row(
            classes, data, indptr[ids[m]], indptr[ids[m] + 1], labels, own, start[m], start[m + 1], label_votes
        )


@called_by_kernels
def _subtract_row(
    classes: np.ndarray, total: np.ndarray, first: int, last: int,  # the Gaussian's row is first to last
    labels: np.ndarray, own: np.ndarray, begin: int, end: int,  # its pairs are begin to end
    label_votes: CSRRows,
) -> None:  # fmt: skip
    """Subtract one view's votes from the row of one Gaussian, with the rounding with which they were added."""
    indptr, vote_classes, votes = label_votes
    for s in range(begin, end):
        for j in range(indptr[labels[s]], indptr[labels[s] + 1]):
            for z in range(first, last):
                if classes[z] == vote_classes[j]:
                    total[z] -= vote_units(own[s], votes[j])


@called_by_kernels
def _raised(x: np.float32, power: float) -> np.float32:
    """Return x ** power in float32; integer powers are computed by products."""
    result, factor, left = np.float32(1), x, int(power)
    if power != left:
        return np.float32(x**power)
    while left:
        if left & 1:
            result *= factor
        factor, left = factor * factor, left >> 1
    return result


@kernel(parallel=True)
def _count(
    votes: CSRRows, pairs: ViewPairs, own: np.ndarray, label_votes: CSRRows, class_ids: np.ndarray,
    power: float, most: float, begin: int, parts: np.ndarray,
) -> None:  # fmt: skip
    """Count as `leave_one_out_counts` does, row by row, so that the votes of the other views are never stored.

    `parts`, (B, K, L) float64, are the counts of B blocks from block `begin` on; they must be zeros at first. The
    result is the sum over all blocks. `class_ids` are ascending; other arrays are those of `_subtract_votes`.
    """
    indptr, classes, data = votes
    ids, start, labels = pairs
    num_classes = parts.shape[1]
    for place in nb.prange(parts.shape[0]):
        part, block = parts[place], begin + place
        which, remaining = np.empty(num_classes + 1, np.uint32), np.empty(num_classes + 1, np.int64)
        kept_which, kept_votes = np.empty_like(which), np.empty_like(remaining)
        codes = np.empty(num_classes + 1, np.float32)
        for m in range(ids.shape[0] * block // BLOCKS, ids.shape[0] * (block + 1) // BLOCKS):
            first, count = indptr[ids[m]], indptr[ids[m] + 1] - indptr[ids[m]]
            for z in range(count):
                which[z], remaining[z] = classes[first + z], data[first + z]
            _subtract_row(which, remaining, 0, count, labels, own, start[m], start[m + 1], label_votes)
            least = np.int64(0)
            for z in range(count):
                least = min(least, remaining[z])
            if least < 0:
                count = resolve_row(which[:count], remaining[:count], class_ids, kept_which, kept_votes)
                which[:count], remaining[:count] = kept_which[:count], kept_votes[:count]
            total, largest = np.int64(0), np.int64(0)
            for z in range(count):
                total += remaining[z]
                largest = max(largest, remaining[z])
            if total == 0:
                continue
            raised, pixels = np.float32(0), np.float64(0)
            for z in range(count):  # Relative to the largest, so that powers do not all underflow to 0.
                codes[z] = _raised(np.float32(remaining[z]) / np.float32(largest), power)
                raised += codes[z]
            for s in range(start[m], start[m + 1]):
                pixels += own[s]
            share = np.float32(min(1.0, most * total / max(pixels * UNITS, 1.0))) / raised
            for s in range(start[m], start[m + 1]):
                for z in range(count):
                    part[which[z], labels[s]] += own[s] * share * codes[z]
