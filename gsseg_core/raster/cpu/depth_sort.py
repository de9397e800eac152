"""Sorts uint32 keys, or positive float32 by their bits, in parallel and in the same way on any number of threads."""

from __future__ import annotations

import numba as nb
import numpy as np

from gsseg_core.kernels.compiler import kernel

FEW = 1 << 20  # keys: of more, those that are moved would go to too many places at once for the cache
DIGIT_BITS = (11, 8)  # of few keys, whose three digits are counted in the fastest cache, and of more
PARTS = 4  # parts that are counted and moved beside each other; fixed, so that threads change nothing


def sort_by_depth(depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Order (M,) int32 that sorts depths, (M,) float32 > 0, and the sorted depths; equal ones stay in their order."""
    order, keys = sort_keys(depth.view(np.uint32))
    return order, keys.view(np.float32)


def sort_keys(keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Order (M,) int32 that sorts keys, (M,) uint32, and the sorted keys; equal ones stay in their order.

    A radix sort: every pass moves the keys stably by one digit, the least significant first.
    """
    order = np.arange(len(keys), dtype=np.int32)
    bits = DIGIT_BITS[len(keys) > FEW]
    for shift in range(0, 32, bits):
        counts = np.zeros((PARTS, 1 << bits), np.int64)
        _count_digits(keys, shift, counts)
        if (counts.sum(axis=0) == len(keys)).any():
            continue  # All keys have the same digit.
        # Digit by digit, and chunk by chunk within a digit.
        place = (np.cumsum(counts.T) - counts.T.ravel()).reshape(-1, PARTS).T.copy()
        moved_keys, moved_order = np.empty_like(keys), np.empty_like(order)
        _move(keys, order, shift, place, moved_keys, moved_order)
        keys, order = moved_keys, moved_order
    return order, keys


@kernel(parallel=True)
def _count_digits(keys: np.ndarray, shift: int, counts: np.ndarray) -> None:
    count, mask = keys.shape[0], np.uint32(counts.shape[1] - 1)
    for chunk in nb.prange(PARTS):
        for i in range(chunk * count // PARTS, (chunk + 1) * count // PARTS):
            counts[chunk, (keys[i] >> np.uint32(shift)) & mask] += 1


@kernel(parallel=True)
def _move(
    keys: np.ndarray, order: np.ndarray, shift: int,  # (M,) uint32, (M,) int32
    place: np.ndarray,  # (PARTS, digits) where the next key of each digit goes
    moved_keys: np.ndarray, moved_order: np.ndarray,  # (M,) out, each
) -> None:  # fmt: skip
    count, mask = keys.shape[0], np.uint32(place.shape[1] - 1)
    for chunk in nb.prange(PARTS):
        for i in range(chunk * count // PARTS, (chunk + 1) * count // PARTS):
            digit = (keys[i] >> np.uint32(shift)) & mask
            n = place[chunk, digit]
            place[chunk, digit] = n + 1
            moved_keys[n], moved_order[n] = keys[i], order[i]
