"""Boundary alignment: moves boundaries of a mask to where the scene itself has edges of colour or depth.

The model: each region A of a mask (connected pixels of one label) was drawn s_A px too wide all around, where s_A is an
integer from -S to S. The boundary of two touching regions then lies s_A - s_B px too far inside B. f_AB(b) is the mean
strength of the scene's edges (`gsseg_core.learn.em.scene_edges`) over the pixels on both sides of the boundary of A and
B after moving it b px into A; n_AB is the number of these pixels at b = 0. Up to a constant, the log posterior of all
shifts of a view is

    sum_AB SHARPNESS sqrt(n_AB / LENGTH) f_AB(s_A - s_B) + sum_A log p(s_A).

A mean field approximates the posterior by one factor per region, and sets each in turn to its optimum given the others.
Each view has its own prior p, which is symmetric and re-estimated in every round. If most boundaries are true, most
shifts are found to be 0. Then p favours 0, and the other boundaries also stay unless the edges are clear.

The evidence (log-likelihood) decides between three hypotheses about a mask:

- The mask is right. Its evidence is exact.
- Regions were drawn too wide or too narrow. The evidence is the bound that the mean field maximises,
  sum_q log-posterior + entropy of q.
- The whole mask is offset from its image (`gsseg_core.learn.em.mask_offset`), with regions right or not.

The first one wins unless another is clearly likelier. Shifts of many regions need a larger margin, because small gains
from soft edges next to each region add up. So true masks stay unchanged, and a mask with a wrong pose moves as a whole
instead of being bent to edges of other objects. Nothing moves if edges are no stronger along the boundaries than
elsewhere, as on a wall of posters. docs/method.md has the reasons.
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
"""Log-likelihood, in nats, of a boundary of `LENGTH` pixels along edges of mean strength 1."""

LENGTH = 30.0  # in px, both sides together

LONGEST = 400
"""Number of pixels beyond which a boundary gains no weight: the width error is only roughly equal all around."""

SHORTEST = 3  # boundaries with fewer px on either side are not moved

VANISHED = -20.0
"""Log-likelihood, in nats, of a boundary moved so far into a region that hardly any of the region would be left."""

TELLING = 1.75
"""Nothing is moved unless edges within S px of the boundaries are this many times as strong as in the whole view."""

CLEAR = 4.0  # margin in nats by which another hypothesis must be likelier than an unmoved mask

EACH_CLEAR, ALL_CLEAR = 1.0, 20.0
"""For shifts of regions: nats added to that margin for each moved boundary, and the largest total margin.

Errors of masks differ between views and average out. Soft edges, as of leaves, lie next to the objects in all views
alike. Boundaries moved to them are slightly nearer to the truth in each view, but the learnt result is worse.
"""

BAND = 64  # image rows per parallel task
ROUNDS = 6  # of the mean field, each with a better prior


def reach(farthest: int) -> int:
    """Return how far from boundaries `align_boundaries` reads edges, in px to each side."""
    return 2 * farthest + FARTHEST


def align_boundaries(
    labels: np.ndarray,  # (H, W) int32: the mask; negative where unknown
    edges: np.ndarray,  # (H, W) float32: from `scene_edges`, valid within `reach` of boundaries and in the sample
    farthest: int,  # S, in px: the most by which a region may be too wide or too narrow
) -> np.ndarray:
    """Align a mask and its boundaries with edges of the scene; pixels that a moved mask does not cover are unknown."""
    here = _align_regions(labels, edges, farthest)
    offset = likeliest_offset(here.beside, here.weights, edges)
    if offset == (0, 0):
        return here.labels
    moved = _align_regions(move_mask(labels, offset), edges, farthest)
    return moved.labels if moved.on_edges and moved.evidence - LOG_OFFSETS > here.evidence + CLEAR else here.labels


class _Alignment(NamedTuple):
    """A mask with aligned boundaries, without an offset of the whole mask."""

    labels: np.ndarray  # (H, W) int32
    evidence: float  # log-likelihood of the edges, in nats
    on_edges: bool  # whether edges are stronger along the boundaries than elsewhere
    beside: np.ndarray  # (P,) int64: pixels along the original boundaries, as flat indices (row-major)
    weights: np.ndarray  # (P,) log-likelihood of an edge of strength 1 at each of these pixels, in nats


def _align_regions(labels: np.ndarray, edges: np.ndarray, farthest: int) -> _Alignment:
    """Align the boundaries of a mask without moving the whole mask; parameters are those of `align_boundaries`."""
    most = 2 * farthest - 1  # most px that a boundary can move to either side
    region, first, area = connected_pixels(labels)
    other, ring = _nearest_regions(region, most + 1)
    pairs, pair, lengths, strengths = _boundary_strengths(region, other, ring, edges, len(area), most + 1)
    moving = lengths[:, most : most + 2].min(axis=1) >= SHORTEST
    along = np.maximum(lengths[:, most] + lengths[:, most + 1], 1)  # px of both sides
    weights = SHARPNESS * np.sqrt(np.minimum(along, LONGEST) / LENGTH)  # nats for edges of strength 1
    log_likelihood = _edge_log_likelihood(lengths[moving], strengths[moving], weights[moving])
    beside = np.flatnonzero((ring.ravel() == 1) & np.append(moving, False)[pair])
    still = float(log_likelihood[:, most].sum())
    near = slice(farthest, 3 * farthest)  # a boundary may lie this far from its edge
    on_edges = bool(strengths[:, near].sum() >= TELLING * sampled(edges).mean() * lengths[:, near].sum())
    aligned, evidence = labels.copy(), still
    if on_edges:
        shifts, of_shifts = _shifts(pairs[moving], log_likelihood, len(area), farthest)
        moved = np.where(moving, np.clip(shifts[pairs[:, 0]] - shifts[pairs[:, 1]], -most, most), 0)
        if of_shifts > still + min(CLEAR + EACH_CLEAR * np.count_nonzero(moved), ALL_CLEAR):
            evidence = of_shifts
            _move(region, other, ring, pair, pairs, moved, labels.ravel()[first], aligned)
    return _Alignment(aligned, evidence, on_edges, beside, (weights / along)[pair[beside]])


def _shifts(touching: np.ndarray, log_likelihood: np.ndarray, count: int, farthest: int) -> tuple[np.ndarray, float]:
    """Find by how many px each region was drawn too wide, (R,) int64; `_mean_field_round` has the shapes.

    Also returns the evidence for it in nats: the lower bound of the log-likelihood that the mean field maximises.
    """
    prior = np.full(2 * farthest + 1, 0.25 / farthest)
    prior[farthest] = 0.5
    posterior, touches = np.tile(prior, (count, 1)), np.zeros(count, bool)
    touches[touching] = True
    begin = starts(np.bincount(touching.ravel(), minlength=count))
    # Pair i has two ends, one in each of its regions: 2 i and 2 i + 1. Here the ends are sorted by region.
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
    """Return the log-likelihood of each boundary moved by -(2 S - 1) to 2 S - 1 px, (P, 4 S - 1), in nats.

    Lengths and strengths, (P, 4 S), come from `_boundary_strengths`; weights, (P,), are nats for edges of strength 1.
    """
    there = np.minimum(lengths[:, 1:], lengths[:, :-1]) >= SHORTEST
    mean = (strengths[:, 1:] + strengths[:, :-1]) / np.maximum(lengths[:, 1:] + lengths[:, :-1], 1)
    return np.where(there, weights[:, None] * mean, VANISHED)


@kernel
def _mean_field_round(
    pairs: np.ndarray, log_likelihood: np.ndarray, begin: np.ndarray, ends: np.ndarray, log_prior: np.ndarray,
    posterior: np.ndarray,
) -> None:  # fmt: skip
    """Update the posterior of each region in turn, in place, given those of the regions that it touches.

    `pairs`, (P, 2), are regions that touch; `log_likelihood`, (P, 4 S - 1), is that of each move of their boundary.
    `ends`, (2 P,), are the ends of the pairs sorted by region, and `begin`, (R + 1,), is where each region's begin.
    `log_prior` of the shifts is (2 S + 1,), `posterior` is (R, 2 S + 1).
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
    """Find the nearest other region of each pixel by spreading from boundary pixels, in parallel bands of rows.

    Returns the region, (H, W) int32, and its distance in px, rounded up, (H, W) int32: -1 and 0 beyond `farthest` px.
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
    """Mark the pixels that touch another region at a side or a corner, (H, W) bool."""
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
    """Set the region of a run of pixels in row y as the nearest one of pixels around it, if no other is nearer.

    Changes `other`, (H, W), and the squared distance `away`, (last - first, W), in place, in rows `first` to `last`.
    """
    own = region[y, begin]
    for v in range(max(y - farthest, first), min(y + farthest + 1, last)):
        across = int(np.sqrt(farthest**2 - (v - y) ** 2))
        left, right = max(begin - across, 0), min(end + across, region.shape[1])
        there, nearest, squares = region[v, left:right], other[v, left:right], away[v - first, left:right]
        # Without branches, so that the compiler vectorises it.
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
    """List the pairs of touching regions, of `count` regions, and sum edges by pair and ring; images are (H, W).

    A ring is the set of pixels at one distance from the boundary. Returns the pairs, lower number first, (P, 2) int64;
    the pair that each pixel is near, (H W,) int32, -1 for none; and for each ring its number of pixels and its sum of
    edges, (P, 2 farthest) float64 each, from the farthest in the second region to the farthest in the first.
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
    """Sort the pixels near another region by the lower region number; return each number's start, and the pixels."""
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
    """Move the boundary of each pair `moved` px, (P,), into its first region, in `labels`, (H, W); `label` is (R,)."""
    height, width = region.shape
    for y in range(height):
        for x in range(width):
            k = pair[y * width + x]
            if k >= 0:
                depth = moved[k] if region[y, x] == pairs[k, 0] else -moved[k]
                if ring[y, x] <= depth:
                    labels[y, x] = label[other[y, x]]
