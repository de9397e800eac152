"""Temperature scaling: turns blended shares into probabilities that are right as often as they claim.

A view blends shares, not probabilities, for two reasons. A pixel at an edge that consists to 0.7 of Gaussians of one
object belongs to it in far more than seven of ten cases. And pixels of one view are not independent: if 0.7 of all
pixels of a Gaussian have one label, most views agree on it, and each view counts about once. A single number, the
temperature T, corrects both. It changes shares O[k] to

    P[k] = O[k]^(1/T) / sum_j O[j]^(1/T)

(temperature scaling of log O; Guo et al., On Calibration of Modern Neural Networks, ICML 2017). The order of classes
stays the same, and so do all labels. The temperature is fitted to masks that the codes were not learnt from
(`gsseg_core.learn.calibrate`). P is meant to be the probability of the true class, but a mask may be wrong. So
the fit maximises the log-likelihood

    sum_v sum_p log sum_k P_v[p, k] C_v[k, y_p]

with a confusion matrix C_v[true, seen] per view. It is learnt at every temperature that is tried, in `STEPS` steps of
expectation maximisation, with a prior of `RIGHT` times the pixels of each class for correct labels.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numba as nb
import numpy as np

from gsseg_core.csr_rows import CSRRows
from gsseg_core.errors import SettingsError
from gsseg_core.kernels.compiler import kernel
from gsseg_core.raster.view_renderer import PixelGrid

LOWEST, HIGHEST = 0.2, 5.0  # temperatures that are tried
VIEWS = 16  # most views to whose masks the temperature is fitted
PIXELS = 2048  # most pixels of each view to which the temperature is fitted, on a grid

STEPS = 5
RIGHT = 0.3
OUTLIERS = 1e-3  # share of pixels that carry any label of the view by chance
_PRECISION = 0.02  # of the logarithm of the temperature
_TINY = 1e-12  # lower limit of the likelihood of a label
_LEAST = np.finfo(np.float32).tiny  # lower limit of divisors, instead of 0
_SMALLEST = float(_LEAST)  # temperatures must be above this and below its reciprocal


def tempered(
    shares: np.ndarray,  # (..., K) float32, not negative; a row sums to at most 1, up to rounding
    temperature: float,  # above 0
) -> np.ndarray:
    """Raise shares to the power of 1 / temperature, and scale each row back to its sum: (..., K) float32.

    A temperature below 1 increases the largest entry, one above 1 the others. The order in a row stays, and zeros stay
    zeros. At 1 the same array is returned; else no entry is above 1. Applying a temperature and then its reciprocal
    restores the shares, up to rounding and underflow. Raises `SettingsError` for an invalid temperature.
    """
    if temperature == 1:
        return shares
    rows = CSRRows.from_dense(shares.reshape(-1, shares.shape[-1]).astype(np.float32, copy=False))
    return tempered_rows(rows, temperature).dense(shares.shape[-1]).reshape(shares.shape)


def tempered_rows(shares: CSRRows, temperature: float) -> CSRRows:
    """Apply `tempered` to sparse shares, float32, without memory or time for zeros."""
    if not _SMALLEST < temperature < 1 / _SMALLEST:
        raise SettingsError(f"temperature is {temperature}; expected a number above 0 that float32 can hold")
    return shares if temperature == 1 else shares.with_data(_powers(shares, np.float32(temperature)))


@kernel(parallel=True)
def _powers(rows: CSRRows, temperature: np.float32) -> np.ndarray:
    indptr, _, data = rows
    out = np.empty_like(data)
    for i in nb.prange(indptr.shape[0] - 1):
        known, peak, total = np.float32(0), np.float32(0), np.float32(0)
        for z in range(indptr[i], indptr[i + 1]):
            known += data[z]
            peak = max(peak, data[z])
        for z in range(indptr[i], indptr[i + 1]):
            # For a share of 0 this is exp(-inf), which is 0 at any temperature.
            out[z] = np.exp(np.log(data[z] / max(peak, _LEAST)) / temperature)
            total += out[z]
        for z in range(indptr[i], indptr[i + 1]):
            # Rounding could lift the only class of a row above the row's sum, and the sum above 1.
            out[z] = min(out[z] * (known / max(total, _LEAST)), min(known, np.float32(1)))
    return out


class Sample(NamedTuple):
    """Sampled pixels of one view: predicted probabilities, and labels of its mask."""

    shares: np.ndarray  # (P, C) float32: of the C classes that occur in the prediction or the mask; rows sum to 1
    seen: np.ndarray  # (P,) int64: label of each pixel, as its column in `shares`, ascending
    unknown: int  # number of labelled pixels that are left out because little of them is predicted


def grid_of(height: int, width: int) -> PixelGrid:
    """Choose the grid of pixels of a view to which the temperature is fitted."""
    step = max(1, int(np.ceil(np.sqrt(height * width / PIXELS))))
    while -(-height // step) * -(-width // step) > PIXELS:
        step += 1
    return PixelGrid(min(step, height, width) // 2, step)


def sample_grid(image: np.ndarray, labels: np.ndarray) -> Sample:
    """Return the pixels of a view with known label and prediction, both given at the pixels of `grid_of`.

    `image`, (R, C, K), is blended from codes that were learnt without the mask; `labels` are (R, C) int32, negative
    where unknown.
    """
    shares, seen = image.reshape(-1, image.shape[2]), labels.ravel()
    total, labelled = shares.sum(axis=1), seen >= 0
    known = np.flatnonzero(labelled & (total > 0.5))
    unknown = int(labelled.sum()) - len(known)
    known = known[np.argsort(seen[known], kind="stable")]
    seen, some = seen[known], shares.max(axis=0, initial=0) > 0
    some[seen] = True
    columns = np.flatnonzero(some)  # Copy only classes that the view shows, out of maybe thousands.
    shares = shares[known[:, None], columns] / total[known, None]
    occurs = shares.max(axis=0, initial=0) > 1e-6
    occurs[np.searchsorted(columns, seen)] = True
    columns = columns[occurs]
    return Sample(np.ascontiguousarray(shares[:, occurs]), np.searchsorted(columns, seen), unknown)


def fit_temperature(samples: Sequence[Sample]) -> float:
    """Fit the temperature that maximises the likelihood of held-out masks, each with its own confusion matrix.

    It is in [`LOWEST`, `HIGHEST`], and 1 if the samples have no pixels.
    """
    known = [_Cells.of(sample) for sample in samples if len(sample.seen)]
    if not known:
        return 1.0

    def loss(log_temperature: float) -> float:
        temperature = float(np.exp(log_temperature))
        return -sum(_log_likelihood(cells, temperature) for cells in known)

    return float(np.exp(golden_section(loss, float(np.log(LOWEST)), float(np.log(HIGHEST)), _PRECISION)))


def golden_section(f: Callable[[float], float], low: float, high: float, precision: float) -> float:
    """Minimise a function with a single minimum between two bounds by golden-section search.

    Loading SciPy's search would take longer than this search.
    """
    kept = (5**0.5 - 1) / 2
    left, right = high - kept * (high - low), low + kept * (high - low)
    at_left, at_right = f(left), f(right)
    while high - low > precision:
        if at_left <= at_right:
            high, right, at_right = right, left, at_left
            left = high - kept * (high - low)
            at_left = f(left)
        else:
            low, left, at_left = left, right, at_right
            right = low + kept * (high - low)
            at_right = f(right)
    return (low + high) / 2


class _Cells(NamedTuple):
    """Sparse probabilities of a sample, and the cells of its sparse confusion matrix.

    A pixel has only a few of hundreds of classes, and a label occurs with only a few classes.
    """

    shares: CSRRows  # P rows, Z entries in total
    pixel: np.ndarray  # (Z,) int64: pixel of each entry
    cell: np.ndarray  # (Z,) int64: cell of each entry, one of M
    true: np.ndarray  # (M,) int64: class of each cell
    right: np.ndarray  # (L,) int64: for each label that occurs, the cell of its own class
    num_classes: int

    @classmethod
    def of(cls, sample: Sample) -> _Cells:
        shares, num_classes = CSRRows.from_dense(sample.shares), sample.shares.shape[1]
        present, label = np.unique(sample.seen, return_inverse=True)
        met = shares.indices.astype(np.int64) * len(present) + label[shares.rows]
        cells, place = np.unique(np.append(met, present * len(present) + np.arange(len(present))), return_inverse=True)
        return cls(shares, shares.rows, place[: len(met)], cells // len(present), place[len(met) :], num_classes)


def _log_likelihood(cells: _Cells, temperature: float) -> float:
    """Return the log-likelihood of a view's labels at a temperature, with its best confusion matrix, in nats."""
    shares, pixel, cell, true, right, num_classes = cells
    probabilities = tempered_rows(shares, temperature).data.astype(np.float64)
    prior = RIGHT * np.bincount(shares.indices, probabilities, num_classes)[true[right]]
    # Rows sum to 1; classes that are no label of the mask have no diagonal entry.
    is_named = np.isin(true, true[right])
    confusion = np.where(is_named, 1 - RIGHT, 1.0) / len(right)
    confusion[right] += RIGHT
    for step in range(STEPS):
        confusion *= 1 - OUTLIERS
        likelihood = np.bincount(pixel, confusion[cell] * probabilities, shares.num_rows) + OUTLIERS / len(right)
        likelihood = np.maximum(likelihood, _TINY)
        if step < STEPS - 1:
            counts = confusion * np.bincount(cell, probabilities / likelihood[pixel], len(true))
            counts[right] += prior
            total = np.bincount(true, counts, num_classes)[true]
            np.divide(counts, total, out=confusion, where=total > 0)
    return float(np.log(likelihood).sum())
