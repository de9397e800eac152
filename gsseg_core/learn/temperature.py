"""Temperature scaling: probabilities that are right as often as they claim.

What a view blends is a share, not a probability. A pixel at an edge that is made to 0.7 of Gaussians of one object
belongs to it far more often than in seven cases of ten; and the pixels of one view are no independent witnesses: a
Gaussian of which 0.7 of all pixels say the same has most views on its side, and each view counts about once. Both are
mended by one number. With the temperature T, shares O[k] become

    P[k] = O[k]^(1/T) / sum_j O[j]^(1/T)

(temperature scaling of log O; Guo et al., On Calibration of Modern Neural Networks, ICML 2017). Their order stays, and
so do all labels. The temperature is fitted to masks that the codes have not learnt from (`gsseg_core.learn.calibrate`).
A mask may be wrong, while what is wanted is the probability of the true class, so what is maximised is the likelihood

    sum_v sum_p log sum_k P_v[p, k] C_v[k, y_p]

with a confusion matrix per view, C_v[true, seen], learnt at every temperature that is tried, in `STEPS` steps of
expectation-maximisation, with a prior of `RIGHT` times the pixels of each class in which the segmenter was right.
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
VIEWS = 16  # views whose masks the temperature is fitted to, at most
PIXELS = 2048  # pixels of each view that the temperature is fitted to, on a grid, at most about

STEPS = 5
RIGHT = 0.3
OUTLIERS = 1e-3  # share of pixels that carry any label of the view by chance
_PRECISION = 0.02  # of the logarithm of the temperature
_TINY = 1e-12  # likelihood of a label, at least
_LEAST = np.finfo(np.float32).tiny  # in place of 0 as a divisor
_SMALLEST = float(_LEAST)  # temperatures are above it, and below its reciprocal


def tempered(
    shares: np.ndarray,  # (..., K) float32, not negative; a row sums to at most 1, up to rounding
    temperature: float,  # above 0
) -> np.ndarray:
    """Raise shares to the power of 1 / temperature, and scale each row back to its sum: (..., K) float32.

    Below 1 the largest gains, above 1 the others do. The order in a row stays, zeros stay zeros. At 1 the very same
    array is returned; else no entry is above 1. Going to a temperature and then to its reciprocal leads back, up to
    rounding and to entries that are too small for the type. Raises `SettingsError` for what is no temperature.
    """
    if temperature == 1:
        return shares
    rows = CSRRows.from_dense(shares.reshape(-1, shares.shape[-1]).astype(np.float32, copy=False))
    return tempered_rows(rows, temperature).dense(shares.shape[-1]).reshape(shares.shape)


def tempered_rows(shares: CSRRows, temperature: float) -> CSRRows:
    """Do with sparse shares, float32, what `tempered` does; zeros take neither memory nor time."""
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
            # The logarithm of 0 is minus infinity, of which any power is 0 again.
            out[z] = np.exp(np.log(data[z] / max(peak, _LEAST)) / temperature)
            total += out[z]
        for z in range(indptr[i], indptr[i + 1]):
            # Rounding may take the only class of a row above the whole, and the whole above 1.
            out[z] = min(out[z] * (known / max(total, _LEAST)), min(known, np.float32(1)))
    return out


class Sample(NamedTuple):
    """Pixels of one view: predicted probabilities, and labels of its mask."""

    shares: np.ndarray  # (P, C) float32: of the C classes that occur in the prediction or the mask; rows sum to 1
    seen: np.ndarray  # (P,) int64: label of each pixel, as its column in `shares`, ascending
    unknown: int  # pixels with a label of which little is predicted, and which are left out


def grid_of(height: int, width: int) -> PixelGrid:
    """Choose the pixels of a view that the temperature is fitted to."""
    step = max(1, int(np.ceil(np.sqrt(height * width / PIXELS))))
    while -(-height // step) * -(-width // step) > PIXELS:
        step += 1
    return PixelGrid(min(step, height, width) // 2, step)


def sample_grid(image: np.ndarray, labels: np.ndarray) -> Sample:
    """Sample a view where label and prediction are known.

    The image, (R, C, K), is blended of codes that have not seen the mask, (R, C) int32 and negative where unknown; both
    are those of `grid_of`.
    """
    shares, seen = image.reshape(-1, image.shape[2]), labels.ravel()
    total, labelled = shares.sum(axis=1), seen >= 0
    known = np.flatnonzero(labelled & (total > 0.5))
    unknown = int(labelled.sum()) - len(known)
    known = known[np.argsort(seen[known], kind="stable")]
    seen, some = seen[known], shares.max(axis=0, initial=0) > 0
    some[seen] = True
    columns = np.flatnonzero(some)  # Of thousands of classes a view shows some: the others are not copied.
    shares = shares[known[:, None], columns] / total[known, None]
    occurs = shares.max(axis=0, initial=0) > 1e-6
    occurs[np.searchsorted(columns, seen)] = True
    columns = columns[occurs]
    return Sample(np.ascontiguousarray(shares[:, occurs]), np.searchsorted(columns, seen), unknown)


def fit_temperature(samples: Sequence[Sample]) -> float:
    """Fit the temperature at which held-out masks are likeliest, each seen through a confusion matrix of its own.

    It is in [`LOWEST`, `HIGHEST`], and 1 where there is no pixel to go by.
    """
    known = [_Cells.of(sample) for sample in samples if len(sample.seen)]
    if not known:
        return 1.0

    def loss(log_temperature: float) -> float:
        temperature = float(np.exp(log_temperature))
        return -sum(_log_likelihood(cells, temperature) for cells in known)

    return float(np.exp(golden_section(loss, float(np.log(LOWEST)), float(np.log(HIGHEST)), _PRECISION)))


def golden_section(f: Callable[[float], float], low: float, high: float, precision: float) -> float:
    """Find where a function with one minimum is least between two bounds, by sections in the golden ratio.

    SciPy's search takes longer to load than this one takes to find.
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
    """What is not 0 of the probabilities of a sample, and the cells of its confusion matrix that this meets.

    Of hundreds of classes, a pixel has a few, and a label is carried by pixels of a few.
    """

    shares: CSRRows  # P rows, Z entries in all
    pixel: np.ndarray  # (Z,) int64: of each entry
    cell: np.ndarray  # (Z,) int64: of the M cells
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
    """Natural logarithm of the likelihood of a view's labels at a temperature, through its best confusion matrix."""
    shares, pixel, cell, true, right, num_classes = cells
    probabilities = tempered_rows(shares, temperature).data.astype(np.float64)
    prior = RIGHT * np.bincount(shares.indices, probabilities, num_classes)[true[right]]
    # Rows sum to 1; those of classes that no label means have nothing on the diagonal.
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
