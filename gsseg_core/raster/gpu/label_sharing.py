"""Kernels over a view and its mask on a GPU: labels of each tile, sums of weights by label, and shares of votes.

Each tile gives the labels in it numbers of its own, and each of its entries has one *slot* for each of them. Sums are
of whole units, so they do not depend on the order in which threads come to add.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from gsseg_core.data.label_evidence import UNITS
from gsseg_core.raster.constants import BLOCK, TINY
from gsseg_core.raster.gpu.blending import (
    BATCH,
    LIFTED,
    OPEN,
    PARTS,
    STRIDE,
    THREADS,
    WARP,
    WARPS,
    alpha_of,
    centre_of,
    load_batch,
    own_pixel,
    weigh_batch,
)
from gsseg_core.raster.gpu.device import called_by_kernels, cuda, gpu_kernel, to_cpu

_MOST = np.float32(2.0**26)
"""Px that a pixel's neighbours add to a sum at once, at most; more occurs only where nothing explains a label."""

_TINY = np.float32(TINY)
_NOTHING = np.float32(0)


def halves(units: torch.Tensor) -> torch.Tensor:  # int64 of at least 0
    """Cut numbers of units in two, (..., 2): of megapixels that hardly anything explains, 64 bits hold no sum."""
    return torch.stack([units >> 32, units & 0xFFFFFFFF], dim=-1)


def joined(sums: torch.Tensor) -> np.ndarray:  # (..., 2) int64
    """Put sums of halves together, in units, float64."""
    high, low = np.moveaxis(to_cpu(sums), -1, 0)
    return np.asarray(high * 2.0**32 + low)


@gpu_kernel
def number_labels(
    mask: np.ndarray, columns: int,  # (H, W) int32: positions of labels, negative where unknown
    slots: np.ndarray, counts: np.ndarray,  # (T, THREADS) int16 out, -1 where unknown; (T,) int32 out: labels of each
) -> None:  # fmt: skip
    """Give numbers to the labels of one tile, in the order of the threads that first see them."""
    labels = cuda.shared.array(THREADS, np.int32)
    begins = cuda.shared.array(THREADS, np.int32)
    tile, t, row, column = own_pixel(columns)
    label = mask[row, column] if row < mask.shape[0] and column < mask.shape[1] else np.int32(-1)
    labels[t] = label
    cuda.syncthreads()
    first = 0
    while labels[first] != label:
        first += 1
    begins[t] = first == t and label >= 0
    cuda.syncthreads()
    number = 0
    for other in range(first):
        number += begins[other]
    slots[tile, t] = number if label >= 0 else -1
    if t == THREADS - 1:
        total = 0
        for other in range(THREADS):
            total += begins[other]
        counts[tile] = total


@gpu_kernel
def list_labels(
    mask: np.ndarray, columns: int, slots: np.ndarray, label_start: np.ndarray,  # as above; (T + 1,)
    present: np.ndarray,  # (label_start[-1],) int32 out: the labels of each tile
) -> None:  # fmt: skip
    """List the labels of one tile by their numbers."""
    tile, t, row, column = own_pixel(columns)
    if slots[tile, t] >= 0:
        present[label_start[tile] + slots[tile, t]] = mask[row, column]


@called_by_kernels
def add_units(sums: np.ndarray, place: int, pixels: Any) -> None:
    """Add px to a sum; to none, where two kernels disagree by a rounding on whether a weight is zero."""
    if pixels > 0 and place >= 0:
        cuda.atomic.add(sums, place, np.int64(np.float64(min(pixels, _MOST)) * UNITS + 0.5))


@gpu_kernel
def lift(
    table: np.ndarray, start: np.ndarray, entries: np.ndarray, columns: int,
    slots: np.ndarray, label_start: np.ndarray, slot_start: np.ndarray,  # (T, THREADS), (T + 1,), (T + 1,)
    weights: np.ndarray,  # (H / 4, W / 4) of blocks
    reached: np.ndarray, sums: np.ndarray,  # (E,) uint8, (slot_start[-1],) int64, both in: zeros
) -> None:  # fmt: skip
    """Sum weights over the pixels of one tile by entry and label, and mark entries that pixels with a weight see."""
    splats = cuda.shared.array((BATCH, 8), np.float32)
    weighed = cuda.shared.array((BATCH, STRIDE), np.float32)
    slot_of = cuda.shared.array(THREADS, np.int16)
    counts = cuda.shared.array(THREADS, np.uint8)
    tile, t, row, column = own_pixel(columns)
    label_count = label_start[tile + 1] - label_start[tile]
    if label_count == 0:
        return
    x, y = centre_of(row, column)
    slot_of[t] = slots[tile, t]
    counts[t] = slots[tile, t] >= 0 and weights[row // BLOCK, column // BLOCK] > 0
    ray = np.float32(1) if slots[tile, t] >= 0 else _NOTHING
    e = t // PARTS
    for first in range(start[tile], start[tile + 1], BATCH):
        if not cuda.syncthreads_or(np.int32(ray >= OPEN)):
            break
        count = load_batch(table, entries, first, start[tile + 1], splats, t)
        cuda.syncthreads()
        ray = weigh_batch(splats, count, x, y, ray, LIFTED, np.float32(1), weighed, t)
        cuda.syncthreads()
        if e < count:
            place = slot_start[tile] + (first + e - start[tile]) * label_count
            current, total, hit = -1, _NOTHING, False
            for position in range(t % PARTS, THREADS, PARTS):
                weight = weighed[e, position]
                if weight > 0:
                    if slot_of[position] != current:
                        add_units(sums, place + current, total)
                        current, total = slot_of[position], _NOTHING
                    total += weight
                    hit |= counts[position] > 0
            add_units(sums, place + current, total)
            if hit:
                reached[first + e] = 1


@gpu_kernel
def share(
    table: np.ndarray, start: np.ndarray, entries: np.ndarray, columns: int,  # of the entries that were reached
    slots: np.ndarray, label_start: np.ndarray, slot_start: np.ndarray, weights: np.ndarray,  # as above
    pair: np.ndarray, likelihood: np.ndarray, rest: np.ndarray,  # (slot_start[-1],) int32; (P,); (label_start[-1],)
    logs: np.ndarray,  # (T, THREADS) in: zeros; out: weight times log p(y_p) of each pixel
    left_over: np.ndarray, sums: np.ndarray,  # (label_start[-1],), (P,) int64, both added to
) -> None:  # fmt: skip
    """Share one vote per labelled pixel of one tile, times its weight; see `raster.cpu.label_pairs.share`."""
    splats = cuda.shared.array((BATCH, 8), np.float32)
    weighed = cuda.shared.array((BATCH, STRIDE), np.float32)
    slot_of = cuda.shared.array(THREADS, np.int16)
    only = cuda.shared.array(BATCH, np.float32)
    busy = cuda.shared.array(WARPS, np.uint8)
    tile, t, row, column = own_pixel(columns)
    label_count = label_start[tile + 1] - label_start[tile]
    if label_count == 0:
        return
    slot, counts = slots[tile, t], _NOTHING
    if slot >= 0:
        counts = weights[row // BLOCK, column // BLOCK]
    slot_of[t] = slot
    if t < WARPS:
        busy[t] = 0
    if not cuda.syncthreads_or(np.int32(counts > 0)):
        return
    if counts > 0:
        busy[t // WARP] = 1
    x, y = centre_of(row, column)
    value, ray = _NOTHING, np.float32(1) if counts > 0 else _NOTHING
    for first in range(start[tile], start[tile + 1], BATCH):
        if not cuda.syncthreads_or(np.int32(ray >= OPEN)):
            break
        count = load_batch(table, entries, first, start[tile + 1], splats, t)
        base = slot_start[tile] + (first - start[tile]) * label_count
        if label_count == 1 and t < count:
            only[t] = likelihood[pair[base + t]] if pair[base + t] >= 0 else _NOTHING
        cuda.syncthreads()
        if ray >= OPEN:
            for e in range(count):
                weight = alpha_of(splats, e, x, y) * ray if ray >= OPEN else _NOTHING
                if ray - weight < LIFTED:
                    weight = ray
                if weight > 0:
                    ray -= weight
                    if label_count == 1:
                        value += weight * only[e]
                    else:
                        number = pair[base + e * label_count + slot]
                        value += weight * likelihood[number] if number >= 0 else _NOTHING
    inverse = _NOTHING
    if counts > 0:
        p = value + rest[label_start[tile] + slot] * ray
        # A pixel that nothing explains has no share to give, at any codes; its term is held at a floor.
        logs[tile, t] = counts * math.log(max(p, _TINY))
        inverse = counts / p if p > _TINY else _NOTHING
        if ray * inverse > 0:
            add_units(left_over, label_start[tile] + slot, ray * inverse)
    ray = np.float32(1) if inverse > 0 else _NOTHING
    e = t // PARTS
    for first in range(start[tile], start[tile + 1], BATCH):
        if not cuda.syncthreads_or(np.int32(ray >= OPEN)):
            break
        count = load_batch(table, entries, first, start[tile + 1], splats, t)
        cuda.syncthreads()
        if busy[t // WARP]:
            ray = weigh_batch(splats, count, x, y, ray, LIFTED, inverse, weighed, t)
        cuda.syncthreads()
        if e < count:
            place = slot_start[tile] + (first + e - start[tile]) * label_count
            current, total = -1, _NOTHING
            for warp in range(WARPS):
                if busy[warp]:
                    for position in range(warp * WARP + t % PARTS, (warp + 1) * WARP, PARTS):
                        weight = weighed[e, position]
                        if weight > 0:
                            if slot_of[position] != current:
                                if total > 0:
                                    add_units(sums, pair[place + current], total)
                                current, total = slot_of[position], _NOTHING
                            total += weight
            if total > 0:
                add_units(sums, pair[place + current], total)


@gpu_kernel
def add_votes(
    total: np.ndarray, ids: np.ndarray, start: np.ndarray, labels: np.ndarray, votes: np.ndarray,  # (N, K) added to
    indptr: np.ndarray, classes: np.ndarray, of_labels: np.ndarray,  # L rows: what a pixel of each label votes
    sign: int,
) -> None:  # fmt: skip
    """Add the votes of one Gaussian to those of other views; see `raster.vote_total`."""
    m = cuda.grid(1)
    if m < ids.shape[0]:
        for s in range(start[m], start[m + 1]):
            for j in range(indptr[labels[s]], indptr[labels[s] + 1]):
                added = np.int64(round(np.float64(votes[s]) * of_labels[j] * UNITS))
                total[ids[m], classes[j]] += sign * added
