"""Kernels of the tree of parts: which regions merge, which of them views show, and which of those stay.

Regions are rows of their shares of S segments, which come view after view; those that others merge to come before them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gsseg_core.kernels.compiler import called_by_kernels, kernel
from gsseg_core.objects.sight import EVIDENCE, FULL_SIGHT, FULL_SIGHT_PX, PLENTY

DOUBT = 0.3  # views that disagree, added to every pair of regions: where views are few, agreement is the share of them


class Merged(NamedTuple):
    """R regions, of which some merged to others."""

    parts: np.ndarray  # (R, 2) int64: which two each was made of; -1 where it was there from the first
    agreement: np.ndarray  # (R,): of these two
    shares: np.ndarray  # (R, S): of the segments, in px


@kernel(error_model="numpy")
def merge_regions(shares: np.ndarray, view: np.ndarray) -> Merged:  # (r, S) float64, (S,) int64
    """Merge regions, in every round those that agree with each other more than with any third."""
    num, ids = shares.shape
    room = max(2 * num, 1)
    parts, agreement, every = np.full((room, 2), -1), np.ones(room), np.empty((room, ids))
    every[:num] = shares
    # What is left, each in the place of its first region; shares and sight of the views by place.
    width, total, region, left = num, num, np.arange(num), np.ones(num, np.bool_)
    num_views = view[-1] + 1 if ids else 0
    votes, counts, agreed = np.zeros((ids, num)), np.zeros((num_views, num)), np.zeros((num, num))
    own, own_counts, first, best = np.empty(ids), np.empty(num_views), np.empty(num, np.int64), np.empty(num, np.int64)
    for p in range(num):
        _vote(every[p], view, own, own_counts)
        _agree(own, own_counts, votes, counts, left, agreed[p, :p])
        agreed[:p, p] = agreed[p, :p]
        votes[:, p], counts[:, p] = own, own_counts
    while True:
        alive = np.flatnonzero(left[:width])
        if 2 * len(alive) < width:  # What has merged into others costs nothing any more.
            width = len(alive)
            for rows in (votes, counts):
                for row in rows:
                    row[:width] = row[alive]
            for p in range(width):
                agreed[p, :width] = agreed[alive[p]][alive]
            region[:width], left[:width] = region[alive], True
        many = 0
        for p in range(width):
            best[p] = agreed[p, :width].argmax()
        for p in range(width):
            if best[p] > p and best[best[p]] == p and agreed[p, best[p]] > 0:
                first[many] = p
                many += 1
        if many == 0:
            return Merged(parts[:total], agreement[:total], every[:total])
        for p in first[:many]:
            b = best[p]
            parts[total, 0], parts[total, 1], agreement[total] = region[p], region[b], agreed[p, b]
            every[total] = every[region[p]] + every[region[b]]
            region[p], left[b], total = total, False, total + 1
            votes[:, b], counts[:, b], agreed[b, :width], agreed[:width, b] = 0, 0, 0, 0
            _vote(every[region[p]], view, own, own_counts)
            votes[:, p], counts[:, p] = own, own_counts
        for p in first[:many]:
            _vote(every[region[p]], view, own, own_counts)
            _agree(own, own_counts, votes, counts, left, agreed[p, :width])
            agreed[p, p] = 0
            agreed[:width, p] = agreed[p, :width]


@called_by_kernels(error_model="numpy")
def _vote(shares: np.ndarray, view: np.ndarray, votes: np.ndarray, counts: np.ndarray) -> None:
    """Write how far each view counts for a region, and the shares that its ids have as far as it does."""
    counts[:] = 0
    for s in range(len(shares)):
        counts[view[s]] += shares[s]
    most = 0.0
    for seen in counts:
        most = max(most, seen)
    full = max(min(FULL_SIGHT * most, PLENTY), 1e-9)
    votes[:] = shares
    s = 0
    for v in range(len(counts)):
        seen = counts[v]
        counts[v] = min(seen / full, 1.0) * seen / (seen + FULL_SIGHT_PX)
        factor = counts[v] / max(seen, 1e-9)
        while s < len(shares) and view[s] == v:
            votes[s] *= factor
            s += 1


@called_by_kernels(error_model="numpy")
def _agree(
    own: np.ndarray, own_counts: np.ndarray, votes: np.ndarray, counts: np.ndarray, left: np.ndarray,
    agreed: np.ndarray,
) -> None:  # fmt: skip
    """Write how far a region agrees with those in the first places."""
    width = len(agreed)
    both = np.zeros(width)
    agreed[:] = 0
    for v in range(len(own_counts)):
        if own_counts[v] != 0:
            for r in range(width):
                both[r] += own_counts[v] * counts[v, r]
    for s in range(len(own)):
        if own[s] != 0:
            for r in range(width):
                agreed[r] += own[s] * votes[s, r]
    for r in range(width):
        agreed[r] = agreed[r] / (both[r] + DOUBT) if left[r] and both[r] >= EVIDENCE else 0.0


@kernel(error_model="numpy")
def showing(
    parts: np.ndarray, shares: np.ndarray, view: np.ndarray, size: np.ndarray, itself: float, least: float
) -> np.ndarray:  # (R, views) bool
    """Tell which views show each region as a segment, by an IoU above `itself`, and see so many px of it.

    A segment is one region of those that hold each other: the one that fits it best, the larger one if both do.
    """
    num_views = view[-1] + 1 if len(view) else 0
    overlap, shown = np.empty(shares.shape), np.zeros((len(shares), num_views), np.bool_)
    fits = np.empty(shares.shape, np.bool_)
    seen = np.zeros((len(shares), num_views))
    for r in range(len(shares)):
        for s in range(len(view)):
            seen[r, view[s]] += shares[r, s]
        for s in range(len(view)):
            overlap[r, s] = shares[r, s] / max(seen[r, view[s]] + size[s] - shares[r, s], 1e-9)
            fits[r, s] = overlap[r, s] > itself
        for part in parts[r]:
            if part >= 0:
                for s in range(len(view)):
                    fits[part, s] &= overlap[part, s] > overlap[r, s]
                    fits[r, s] &= overlap[r, s] >= overlap[part, s]
    for r in range(len(shares)):
        for s in range(len(view)):
            shown[r, view[s]] |= fits[r, s] & (seen[r, view[s]] >= least)
    return shown


@kernel
def staying(parts: np.ndarray, shown: np.ndarray, certain: int, several: int) -> np.ndarray:  # (R,) bool
    """Tell which regions several views show; the first `certain` ones stay in any case.

    Views (R, views) that show a region which does not stay wait for the next larger one: `shown` gets what waits.
    """
    stays, inside = np.zeros(len(parts), np.bool_), np.zeros(len(parts), np.int64)  # regions that stay in each
    for r in range(len(parts)):
        alive, last = 0, -1
        for part in parts[r]:
            if part >= 0:
                inside[r] += inside[part]
                if inside[part] or shown[part].any():
                    alive, last = alive + 1, part
        if alive == 1:  # Then it is the same but for a rim, and views that show the one mean the other as well.
            shown[r] |= shown[last]
        stays[r] = r < certain or shown[r].sum() >= several
        if stays[r]:
            shown[r], inside[r] = False, 1
    return stays


@kernel
def cells(points: np.ndarray, size: float) -> np.ndarray:  # (n, 3) float32
    """Group points by halving the longer side of their box until groups are of this size at most, (n,) int64."""
    cell, order, count = np.empty(len(points), np.int64), np.arange(len(points)), 0
    parts = [(0, len(points))]
    while len(parts):
        first, last = parts.pop()
        part = order[first:last]
        if len(part) <= size:
            cell[part] = count
            count += 1
            continue
        longest, axis = np.float32(-1), 0
        for k in range(3):
            low = high = points[part[0], k]
            for i in part:
                low, high = min(low, points[i, k]), max(high, points[i, k])
            if high - low > longest:
                longest, axis = high - low, k
        order[first:last] = part[np.argsort(points[part, axis], kind="mergesort")]
        middle = first + len(part) // 2
        parts.append((first, middle))
        parts.append((middle, last))
    return cell


def call_all() -> None:
    """Call each kernel with arrays of the types that the tree has for it, so that it is compiled."""
    view = np.zeros(1, np.int64)
    merged = merge_regions(np.ones((2, 1)), view)
    staying(merged.parts, showing(merged.parts, merged.shares, view, np.ones(1), 0.5, 10.0), 0, 3)
    cells(np.zeros((2, 3), np.float32), 1.0)
