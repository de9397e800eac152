"""Boundary alignment: boundaries of a mask are moved to where the scene itself has edges of colour or depth.

The model: each region A of a mask, connected pixels of one label, was drawn s_A px too wide all around, s_A a whole
number from -S to S. Where two regions touch, their boundary then lies s_A - s_B px too far inside B. With f_AB(b) the
mean strength of the scene's edges (`gsseg_core.learn.em.scene_edges`) over the pixels on both sides of the boundary of
A and B, moved b px into A, and n_AB how many these are at b = 0, the log of the posterior of all shifts of a view is,
but for a constant,

    sum_AB SHARPNESS sqrt(n_AB / LENGTH) f_AB(s_A - s_B) + sum_A log p(s_A).

The posterior is approximated by one factor per region (mean field), each in turn set to its optimum given the others.
The prior p is the view's own and symmetric, re-estimated in every round: in a mask with true boundaries most shifts are
found to be 0, so p favours 0, and the rest stays, too, unless the edges are clear.

Three hypotheses on a mask are compared by the evidence for each, its log-likelihood: that it is right, exact; that
regions were drawn too wide or too narrow, by the bound that the mean field maximises, sum_q log-posterior + entropy of
q; and that the mask as a whole lies beside its image (`gsseg_core.learn.em.mask_offset`), with regions right or not.
The first stands unless another is clearly likelier, shifts of many regions the more clearly, since a little that each
of them gains, by soft edges beside it, is much in sum. So true masks stay as they are, and a mask whose pose is off is
moved as a whole, and not bent to edges that are not its own. Where edges are no stronger along the boundaries than
elsewhere, as on a wall of posters, nothing is moved. docs/method.md has the reasons.
"""

from __future__ import annotations

from typing import NamedTuple

import numba as nb
import numpy as np

from gsseg_core.csr_rows import starts
from gsseg_core.kernels.compiler import called_by_kernels, kernel
from gsseg_core.learn.em.mask_offset import FARTHEST, LOG_OFFSETS, likeliest_offset, move_mask
from gsseg_core.learn.em.rejected_regions import connected_pixels
from gsseg_core.learn.em.scene_edges import sampled

SHARPNESS = 3.0
"""Log-likelihood of edges of one unit in the mean, in nats, where `LENGTH` pixels lie along the boundary."""

LENGTH = 30.0  # in px, of both sides

LONGEST = 400
"""More pixels than these weigh no more: that a region is too wide by the same all around holds only roughly."""

SHORTEST = 3  # boundaries of fewer px on either side are not moved

VANISHED = -20.0
"""Log-likelihood, in nats, of a boundary so far inside a region that hardly anything of it would be left."""

TELLING = 1.75
"""Nothing is moved unless edges within S px of the boundaries are this many times as strong as in the whole view."""

CLEAR = 4.0  # nats by which another hypothesis must be likelier than that nothing has to be moved

EACH_CLEAR, ALL_CLEAR = 1.0, 20.0
"""Nats by which shifts of regions must be likelier than that: so many more for each boundary moved, so many at most.

Errors of masks differ from view to view, and even out over many. Edges that are soft, as of leaves, lie beside the
objects in all views alike: what is moved to them is a little nearer to the truth in each view, and worse over all.
"""

BAND = 64  # rows of the image that are gone through at once
ROUNDS = 6  # of the mean field, each with a better prior


def reach(farthest: int) -> int:
    """How far from boundaries `align_boundaries` looks at edges, in px to each side."""
    return 2 * farthest + FARTHEST


def align_boundaries(
    labels: np.ndarray,  # (H, W) int32: the mask; negative where unknown
    edges: np.ndarray,  # (H, W) float32: by `scene_edges`, as far as `reach` from boundaries and in the sample
    farthest: int,  # S, in px: regions are drawn too wide or too narrow by this much at most
) -> np.ndarray:
    """Align a mask and its boundaries with edges of the scene; where it was moved away from a side, it is unknown."""
    here = _align_regions(labels, edges, farthest)
    offset = likeliest_offset(here.beside, here.weights, edges)
    if offset == (0, 0):
        return here.labels
    moved = _align_regions(move_mask(labels, offset), edges, farthest)
    return moved.labels if moved.tells and moved.evidence - LOG_OFFSETS > here.evidence + CLEAR else here.labels


class _Alignment(NamedTuple):
    """A mask with its boundaries aligned, where as a whole it stays in its place."""

    labels: np.ndarray  # (H, W) int32
    evidence: float  # log-likelihood of the edges, in nats
    tells: bool  # whether edges are stronger along the boundaries than elsewhere
    beside: np.ndarray  # (P,) int64, pixels along the boundaries as they were, counted row by row
    weights: np.ndarray  # (P,) what edges of one unit are worth in each of them, in nats


def _align_regions(labels: np.ndarray, edges: np.ndarray, farthest: int) -> _Alignment:
    """Align the boundaries of a mask that as a whole stays in its place; `align_boundaries` says what is what."""
    most = 2 * farthest - 1  # px that a boundary can be moved to either side
    region, first, area = connected_pixels(labels)
    other, ring = _nearest_regions(region, most + 1)
    pairs, pair, lengths, strengths = _boundary_strengths(region, other, ring, edges, len(area), most + 1)
    moving = lengths[:, most : most + 2].min(axis=1) >= SHORTEST
    along = np.maximum(lengths[:, most] + lengths[:, most + 1], 1)  # px of both sides
    weights = SHARPNESS * np.sqrt(np.minimum(along, LONGEST) / LENGTH)  # nats that edges of one unit are worth
    log_likelihood = _edge_log_likelihood(lengths[moving], strengths[moving], weights[moving])
    beside = np.flatnonzero((ring.ravel() == 1) & np.append(moving, False)[pair])
    still = float(log_likelihood[:, most].sum())
    near = slice(farthest, 3 * farthest)  # a boundary may lie this far from its edge
    tells = bool(strengths[:, near].sum() >= TELLING * sampled(edges).mean() * lengths[:, near].sum())
    aligned, evidence = labels.copy(), still
    if tells:
        shifts, of_shifts = _shifts(pairs[moving], log_likelihood, len(area), farthest)
        moved = np.where(moving, np.clip(shifts[pairs[:, 0]] - shifts[pairs[:, 1]], -most, most), 0)
        if of_shifts > still + min(CLEAR + EACH_CLEAR * np.count_nonzero(moved), ALL_CLEAR):
            evidence = of_shifts
            _move(region, other, ring, pair, pairs, moved, labels.ravel()[first], aligned)
    return _Alignment(aligned, evidence, tells, beside, (weights / along)[pair[beside]])


def _shifts(touching: np.ndarray, log_likelihood: np.ndarray, count: int, farthest: int) -> tuple[np.ndarray, float]:
    """Find by how much each region was drawn too wide, (R,) int64, in px; `_mean_field_round` has the shapes.

    Returns the evidence for it, too, in nats: the bound of the log-likelihood that the mean field maximises.
    """
    prior = np.full(2 * farthest + 1, 0.25 / farthest)
    prior[farthest] = 0.5
    posterior, touches = np.tile(prior, (count, 1)), np.zeros(count, bool)
    touches[touching] = True
    begin = starts(np.bincount(touching.ravel(), minlength=count))
    # Pair i ends in its two regions, as 2 i and as 2 i + 1; these are the ends, region by region.
    ends = np.argsort(touching.ravel(), kind="stable")
    for _ in range(ROUNDS):
        _mean_field_round(touching, log_likelihood, begin, ends, np.log(prior), posterior)
        counts = posterior[touches].sum(axis=0)
        prior = (counts + counts[::-1]) / 2 + 1
        prior /= prior.sum()
    found: np.ndarray = np.where(touches, posterior.argmax(axis=1) - farthest, 0)
    shift, most = np.arange(2 * farthest + 1), 2 * farthest - 1
    moves = np.clip(shift[:, None] - shift, -most, most) + most
    of_pairs = np.einsum("pi,pj,pij->", *posterior[touching.T], log_likelihood[:, moves])
    likely = posterior[touches]
    of_shifts = (likely * (np.log(prior) - np.log(np.maximum(likely, 1e-300)))).sum()
    return found, float(of_pairs + of_shifts)


def _edge_log_likelihood(lengths: np.ndarray, strengths: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Log-likelihood of boundaries moved by -(2 S - 1) to 2 S - 1 px, (P, 4 S - 1), in nats.

    Lengths and strengths, (P, 4 S), are those of `_boundary_strengths`; weights, (P,), are of edges of one unit.
    """
    there = np.minimum(lengths[:, 1:], lengths[:, :-1]) >= SHORTEST
    mean = (strengths[:, 1:] + strengths[:, :-1]) / np.maximum(lengths[:, 1:] + lengths[:, :-1], 1)
    return np.where(there, weights[:, None] * mean, VANISHED)


@kernel
def _mean_field_round(
    pairs: np.ndarray, log_likelihood: np.ndarray, begin: np.ndarray, ends: np.ndarray, log_prior: np.ndarray,
    posterior: np.ndarray,
) -> None:  # fmt: skip
    """Update the posterior of each region in turn, given those of the regions that it touches.

    With the log-likelihood of each move of the boundary of each pair of regions, (P, 2), that touch, (P, 4 S - 1); the
    ends of the pairs, (2 P,), and where those of each region begin, (R + 1,); the log of the prior of each shift,
    (2 S + 1,); and the posterior, (R, 2 S + 1), changed in place.
    """
    num_shifts, middle = log_prior.shape[0], log_likelihood.shape[1] // 2
    for region in range(posterior.shape[0]):
        field = log_prior.copy()
        for end in ends[begin[region] : begin[region + 1]]:
            pair, sign = end // 2, 1 - 2 * (end % 2)
            other = posterior[pairs[pair, (end + 1) % 2]]
            for i in range(num_shifts):
                for j in range(num_shifts):
                    field[i] += other[j] * log_likelihood[pair, min(max(sign * (i - j), -middle), middle) + middle]
        field = np.exp(field - field.max())
        posterior[region] = field / field.sum()


@kernel(parallel=True)
def _nearest_regions(region: np.ndarray, farthest: int) -> tuple[np.ndarray, np.ndarray]:  # (H, W) int32
    """Find for each pixel the nearest other region, by spreading from boundary pixels, band by band.

    Returns the region, (H, W) int32, -1 if it is farther; and how far it is in px, rounded up, (H, W) int32, 0 if so.
    """
    height, width = region.shape
    borders = _borders(region)
    other, ring = np.full((height, width), -1, np.int32), np.zeros((height, width), np.int32)
    for band in nb.prange(-(-height // BAND)):
        first, last = band * BAND, min(band * BAND + BAND, height)
        away = np.full((last - first, width), farthest**2 + 1, np.int32)
        for y in range(max(first - farthest, 0), min(last + farthest, height)):
            x = 0
            while x < width:
                end = x + 1
                if borders[y, x]:
                    while end < width and borders[y, end] and region[y, end] == region[y, x]:
                        end += 1
                    _spread_region(region, y, x, end, farthest, first, last, other, away)
                x = end
        for y in range(first, last):
            for x in range(width):
                if other[y, x] >= 0:
                    ring[y, x] = int(np.ceil(np.sqrt(away[y - first, x])))
    return other, ring


@called_by_kernels
def _borders(region: np.ndarray) -> np.ndarray:
    """Find pixels that touch another region, over sides or corners, (H, W) bool."""
    height, width = region.shape
    borders = np.zeros((height, width), np.bool_)
    for y in range(height):
        here, out = region[y], borders[y]
        for v in range(max(y - 1, 0), min(y + 2, height)):
            there = region[v]
            for x in range(width - 1):
                out[x] |= (here[x] != there[x + 1]) & (here[x] >= 0) & (there[x + 1] >= 0)
            for x in range(width):
                out[x] |= (here[x] != there[x]) & (here[x] >= 0) & (there[x] >= 0)
            for x in range(1, width):
                out[x] |= (here[x] != there[x - 1]) & (here[x] >= 0) & (there[x - 1] >= 0)
    return borders


@called_by_kernels
def _spread_region(
    region: np.ndarray, y: int, begin: int, end: int, farthest: int, first: int, last: int, other: np.ndarray,
    away: np.ndarray,
) -> None:  # fmt: skip
    """Offer a stretch of row y as the nearest region to the pixels around it, in the rows from first to last.

    Changed in place are `other`, (H, W), and `away`, (last - first, W): the squared distance to it.
    """
    own = region[y, begin]
    for v in range(max(y - farthest, first), min(y + farthest + 1, last)):
        across = int(np.sqrt(farthest**2 - (v - y) ** 2))
        left, right = max(begin - across, 0), min(end + across, region.shape[1])
        there, nearest, squares = region[v, left:right], other[v, left:right], away[v - first, left:right]
        # No branches, so that whole vectors go through it.
        for j in range(right - left):
            beside = max(begin - left - j, left + j - end + 1, 0)
            squared = np.int32((v - y) ** 2 + beside * beside)
            nearer = (squared < squares[j]) & (there[j] != own) & (there[j] >= 0)
            squares[j] = squared if nearer else squares[j]
            nearest[j] = own if nearer else nearest[j]


@kernel
def _boundary_strengths(
    region: np.ndarray, other: np.ndarray, ring: np.ndarray, edges: np.ndarray, count: int, farthest: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Enumerate pairs of regions that touch, of `count` in all, and sum up edges by pair and ring; images are (H, W).

    Returns the pairs, the lower number first, (P, 2) int64; which of them each pixel is near, -1 for none, (H W,)
    int32; and pixels and sum of their edges, from the farthest ring inside the second region to that inside the first,
    (P, 2 farthest) float64 each.
    """
    of_pixel, of_other, rings, strength = region.ravel(), other.ravel(), ring.ravel(), edges.ravel()
    begin, order = _sort_by_lower_region(of_pixel, of_other, count)
    pair, met = np.full(of_pixel.shape[0], -1, np.int32), np.full(count, -1, np.int64)
    pairs, n = np.empty((order.shape[0], 2), np.int64), 0
    for low in range(count):
        first = n
        for p in order[begin[low] : begin[low + 1]]:
            high = max(of_pixel[p], of_other[p])
            if met[high] < first:
                met[high], pairs[n, 0], pairs[n, 1] = n, low, high
                n += 1
            pair[p] = met[high]
    lengths, strengths = np.zeros((n, 2 * farthest)), np.zeros((n, 2 * farthest))
    for p in order:
        k = farthest + rings[p] - 1 if of_pixel[p] == pairs[pair[p], 0] else farthest - rings[p]
        lengths[pair[p], k] += 1
        strengths[pair[p], k] += strength[p]
    return pairs[:n].copy(), pair, lengths, strengths


@called_by_kernels
def _sort_by_lower_region(of_pixel: np.ndarray, of_other: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Sort the pixels near another region by the lower number of the two: where each begins, and the pixels."""
    begin = np.zeros(count + 1, np.int64)
    for p in range(of_pixel.shape[0]):
        if of_other[p] >= 0:
            begin[min(of_pixel[p], of_other[p]) + 1] += 1
    begin = np.cumsum(begin)
    place, order = begin[:-1].copy(), np.empty(begin[-1], np.int32)
    for p in range(of_pixel.shape[0]):
        if of_other[p] >= 0:
            low = min(of_pixel[p], of_other[p])
            order[place[low]] = p
            place[low] += 1
    return begin, order


@kernel
def _move(
    region: np.ndarray, other: np.ndarray, ring: np.ndarray, pair: np.ndarray, pairs: np.ndarray, moved: np.ndarray,
    label: np.ndarray, labels: np.ndarray,
) -> None:  # fmt: skip
    """Move the boundary of each pair by so many px, (P,), into its first region, in labels (H, W); label is (R,)."""
    height, width = region.shape
    for y in range(height):
        for x in range(width):
            k = pair[y * width + x]
            if k >= 0:
                depth = moved[k] if region[y, x] == pairs[k, 0] else -moved[k]
                if ring[y, x] <= depth:
                    labels[y, x] = label[other[y, x]]
