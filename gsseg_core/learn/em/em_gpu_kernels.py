"""EM kernels for the (Gaussian, label) pairs of one view, on a GPU: the functions of `em_kernels`.

Each Gaussian that the view sees has one thread. Sums over Gaussians are integers, so they do not depend on the order in
which threads add.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.label_evidence import UNITS, LabelEvidence
from gsseg_core.learn.em.em_kernels import GRADIENT_UNIT, MAX_TERM
from gsseg_core.learn.em.gpu_edges import scene_edges as scene_edges
from gsseg_core.raster.gpu.device import called_by_kernels, cuda, find_gpu, gpu_kernel, launch_each, on_device, to_cpu
from gsseg_core.raster.gpu.gpu_observation import GPUObservation, ShareTensors
from gsseg_core.raster.gpu.label_sharing import halves, joined
from gsseg_core.raster.gpu.tensors import PairTensors, RowTensors, starts
from gsseg_core.raster.observation import Observation

_CELLS = 1 << 20  # most cells of all count tables together, unless a single table is larger
_PX = 1 / GRADIENT_UNIT  # units per px, in counts and in gradients
_MOST = np.float32(MAX_TERM)
_NOTHING = np.float32(0)


def pairs_of(observation: Observation) -> PairTensors:
    """Return the pairs of an observation."""
    assert isinstance(observation, GPUObservation)
    return observation.pairs


def by_row(pairs: PairTensors) -> PairTensors:
    """Replace Gaussian ids by positions among the view's Gaussians, to index arrays that only have rows for these."""
    return pairs._replace(ids=torch.arange(len(pairs.ids), dtype=torch.int32, device=pairs.ids.device))


def put(values: np.ndarray | CSRRows, device: str) -> torch.Tensor | RowTensors:
    """Copy an array, or rows, to the GPU."""
    gpu = find_gpu(device)
    return RowTensors.of(values, gpu) if isinstance(values, CSRRows) else on_device(values, gpu)


def returned(array: torch.Tensor) -> np.ndarray:
    """Copy an array back from the GPU."""
    return to_cpu(array)


def zeros(rows: RowTensors, kind: type[np.generic]) -> torch.Tensor:
    """Return one zero for each entry of some rows, on the GPU."""
    return torch.zeros(len(rows.data), dtype=_KINDS[kind], device=rows.indptr.device)


_KINDS: dict[type[np.generic], torch.dtype] = {np.int64: torch.int64, np.float32: torch.float32}


def rows_like(rows: RowTensors, ids: torch.Tensor) -> RowTensors:  # (M,)
    """Allocate M rows as long as those of `ids`, without initialising them."""
    indptr = starts(rows.indptr.diff()[ids.long()])
    total = int(indptr[-1])
    return RowTensors(indptr, rows.indices.new_empty(total), rows.data.new_empty(total))


def shares(observation: Observation, codes: RowTensors, pairs: PairTensors, likelihood: np.ndarray) -> ShareTensors:
    """Share one vote per labelled pixel among its pairs by class probabilities, as in `Observation.shares`."""
    assert isinstance(observation, GPUObservation)
    return observation.shared(pair_likelihood(codes, pairs, likelihood), likelihood[:, 0])


def pair_likelihood(codes: RowTensors, pairs: PairTensors, likelihood: np.ndarray) -> torch.Tensor:
    """Return the likelihood of the label of each (Gaussian, label) pair, codes[i] . likelihood[y]: (P,) float32."""
    out = torch.empty(len(pairs.labels), device=codes.data.device)
    launch_each(_pair_likelihood, len(pairs.ids), *codes, *pairs, on_device(likelihood, out.device), out)
    return out


@gpu_kernel
def _pair_likelihood(
    indptr: np.ndarray, classes: np.ndarray, data: np.ndarray, ids: np.ndarray, start: np.ndarray, labels: np.ndarray,
    likelihood: np.ndarray, out: np.ndarray,  # (L, K); (P,) out
) -> None:  # fmt: skip
    m = cuda.grid(1)
    if m < ids.shape[0]:
        for s in range(start[m], start[m + 1]):
            total = _NOTHING
            for z in range(indptr[ids[m]], indptr[ids[m] + 1]):
                total += data[z] * likelihood[labels[s], classes[z]]
            out[s] = total


@called_by_kernels
def _units(pixels: Any) -> Any:
    """Round px to int64 in units of `GRADIENT_UNIT`."""
    return np.int64(np.float64(min(pixels, _MOST)) * _PX + 0.5)


def accumulate(gradient: RowTensors, pairs: PairTensors, likelihood: np.ndarray, shares: torch.Tensor) -> None:
    """Add one view's term to the gradient: the sum over a Gaussian's pairs of share times likelihood of the label."""
    launch_each(_accumulate, len(pairs.ids), *gradient, *pairs, on_device(likelihood, shares.device), shares)


@gpu_kernel
def _accumulate(
    indptr: np.ndarray, classes: np.ndarray, gradient: np.ndarray, ids: np.ndarray, start: np.ndarray,
    labels: np.ndarray, likelihood: np.ndarray, shares: np.ndarray,  # (L, K), (P,)
) -> None:  # fmt: skip
    m = cuda.grid(1)
    if m < ids.shape[0]:
        for z in range(indptr[ids[m]], indptr[ids[m] + 1]):
            total = gradient[z]
            for s in range(start[m], start[m + 1]):
                total += _units(shares[s] * likelihood[labels[s], classes[z]])
            gradient[z] = total


def m_step_without_view(
    codes: RowTensors, gradient: torch.Tensor, prior: torch.Tensor, pairs: PairTensors, likelihood: np.ndarray,
    shares: torch.Tensor, stepped: RowTensors,
) -> None:  # fmt: skip
    """M-step of the M Gaussians that a view sees, with the gradient minus the term that `accumulate` added for it."""
    of_labels = on_device(likelihood, shares.device)
    launch_each(_m_step_without_view, len(pairs.ids), *codes, gradient, prior, *pairs, of_labels, shares, *stepped)


@gpu_kernel
def _m_step_without_view(
    indptr: np.ndarray, classes: np.ndarray, data: np.ndarray, gradient: np.ndarray, prior: np.ndarray,
    ids: np.ndarray, start: np.ndarray, labels: np.ndarray, likelihood: np.ndarray, shares: np.ndarray,
    out_indptr: np.ndarray, out_classes: np.ndarray, out: np.ndarray,
) -> None:  # fmt: skip
    m = cuda.grid(1)
    if m >= ids.shape[0]:
        return
    first, total = indptr[ids[m]] - out_indptr[m], _NOTHING
    for z in range(out_indptr[m], out_indptr[m + 1]):
        remaining = gradient[first + z]
        for s in range(start[m], start[m + 1]):
            remaining -= _units(shares[s] * likelihood[labels[s], classes[first + z]])
        out_classes[z] = classes[first + z]
        out[z] = data[first + z] * np.float32(np.float64(remaining) / _PX) + prior[first + z]
        total += out[z]
    if total > 0:
        for z in range(out_indptr[m], out_indptr[m + 1]):
            out[z] /= total


def confusion_counts(
    codes: RowTensors, pairs: PairTensors, shares: torch.Tensor, num_classes: int, num_labels: int
) -> np.ndarray:
    """Sum codes[m] times share over the pairs, by class and label, (K, L) float64; row m belongs to `pairs.ids[m]`."""
    counts = _counters(num_classes, num_labels, shares.device)
    launch_each(_confusion_counts, len(pairs.ids), *codes, *pairs[1:], shares, counts)
    return _in_px(counts)


def _counters(num_classes: int, num_labels: int, device: torch.device) -> torch.Tensor:
    """Make C count tables, (C, K, L): most pairs add to the same few cells, where threads of one table would wait."""
    tables = max(min(_CELLS // max(num_classes * num_labels, 1), 64), 1)
    return torch.zeros((tables, num_classes, num_labels), dtype=torch.int64, device=device)


def _in_px(counts: torch.Tensor) -> np.ndarray:  # (C, K, L)
    return joined(halves(counts).sum(dim=0)) / _PX


@gpu_kernel
def _confusion_counts(
    indptr: np.ndarray, classes: np.ndarray, data: np.ndarray, start: np.ndarray, labels: np.ndarray,
    shares: np.ndarray, counts: np.ndarray,  # (P,); (C, K, L) int64 in and out
) -> None:  # fmt: skip
    m, table = cuda.grid(1), counts[cuda.blockIdx.x % counts.shape[0]]
    if m < indptr.shape[0] - 1:
        for s in range(start[m], start[m + 1]):
            for z in range(indptr[m], indptr[m + 1]):
                cuda.atomic.add(table, (classes[z], labels[s]), _units(shares[s] * data[z]))


def subtract_votes(total: RowTensors, observation: Observation, label_votes: CSRRows) -> None:
    """Subtract one view's votes, by `LabelEvidence.votes`, from those of all views, N rows of int64, in place."""
    assert isinstance(observation, GPUObservation)
    pairs, own = observation.pairs, observation.own_votes
    launch_each(_subtract_votes, len(pairs.ids), *total, *pairs, own, *RowTensors.of(label_votes, own.device))


@gpu_kernel
def _subtract_votes(
    indptr: np.ndarray, classes: np.ndarray, total: np.ndarray, ids: np.ndarray, start: np.ndarray, labels: np.ndarray,
    own: np.ndarray, vote_indptr: np.ndarray, vote_classes: np.ndarray, votes: np.ndarray,
) -> None:  # fmt: skip
    m = cuda.grid(1)
    if m < ids.shape[0]:
        for z in range(indptr[ids[m]], indptr[ids[m] + 1]):
            total[z] -= _own_votes(classes[z], m, start, labels, own, vote_indptr, vote_classes, votes)


@called_by_kernels(fastmath=False)
def _own_votes(
    k: int, m: int, start: np.ndarray, labels: np.ndarray, own: np.ndarray,  # class, and Gaussian of the view
    vote_indptr: np.ndarray, vote_classes: np.ndarray, votes: np.ndarray,
) -> Any:  # fmt: skip
    """Return the view's votes for a class, in units, with the rounding per pair with which they were added."""
    units = np.int64(0)
    for s in range(start[m], start[m + 1]):
        for j in range(vote_indptr[labels[s]], vote_indptr[labels[s] + 1]):
            if vote_classes[j] == k:
                units += np.int64(round(np.float64(own[s]) * votes[j] * UNITS))
    return units


def leave_one_out_counts(
    votes: RowTensors, observation: Observation, possible: np.ndarray, evidence: LabelEvidence, power: float = 1.0,
    most: float = np.inf,
) -> np.ndarray:  # fmt: skip
    """Count the pixels (K, L) of each class under each label of a view by the votes of all others, all at least 0."""
    assert isinstance(observation, GPUObservation)
    pairs, own = observation.pairs, observation.own_votes
    label_votes, rest = RowTensors.of(evidence.votes, own.device), rows_like(votes, pairs.ids)
    counts = _counters(len(possible), len(label_votes.indptr) - 1, own.device)
    launch_each(
        _leave_one_out, len(pairs.ids), *votes, *pairs, own, *label_votes, rest.indptr, rest.data, power,
        min(most, 1e30), counts,
    )  # fmt: skip
    return _in_px(counts)


@gpu_kernel
def _leave_one_out(
    indptr: np.ndarray, classes: np.ndarray, data: np.ndarray, ids: np.ndarray, start: np.ndarray, labels: np.ndarray,
    own: np.ndarray, vote_indptr: np.ndarray, vote_classes: np.ndarray, votes: np.ndarray,
    rest_indptr: np.ndarray, rest: np.ndarray, power: float, most: float,  # scratch, rows as long as those of `ids`
    counts: np.ndarray,  # (C, K, L) int64 in and out
) -> None:  # fmt: skip
    m, table = cuda.grid(1), counts[cuda.blockIdx.x % counts.shape[0]]
    if m >= ids.shape[0]:
        return
    first, total, largest = indptr[ids[m]] - rest_indptr[m], np.int64(0), np.int64(0)
    for z in range(rest_indptr[m], rest_indptr[m + 1]):
        k = classes[first + z]
        rest[z] = data[first + z] - _own_votes(k, m, start, labels, own, vote_indptr, vote_classes, votes)
        total += rest[z]
        largest = max(largest, rest[z])
    if total <= 0:
        return
    raised, pixels = 0.0, 0.0
    for z in range(rest_indptr[m], rest_indptr[m + 1]):
        raised += (np.float64(rest[z]) / np.float64(largest)) ** power
    for s in range(start[m], start[m + 1]):
        pixels += own[s]
    share = min(1.0, most * np.float64(total) / max(pixels * UNITS, 1.0)) / raised
    for z in range(rest_indptr[m], rest_indptr[m + 1]):
        code = share * (np.float64(rest[z]) / np.float64(largest)) ** power
        for s in range(start[m], start[m + 1]):
            cuda.atomic.add(table, (classes[first + z], labels[s]), np.int64(own[s] * code * _PX + 0.5))
