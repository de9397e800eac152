"""Sorts uint32 keys in parallel and in the same way on any number of threads."""

from __future__ import annotations

import numba as nb
import numpy as np

from gsseg_core.kernels.compiler import kernel

DIGIT_BITS = (8, 13)  # of a digit: the least for few keys, whose digits must be counted fast, and the most
PARTS = 4  # parts that are counted and moved beside each other; fixed, so that threads change nothing
_KEY = 32  # bits of a row, after which its key begins


def sort_keys(keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Order (M,) int32 that sorts keys, (M,) uint32, and the sorted keys; equal ones stay in their order.

    A radix sort: every pass moves the keys stably by one digit, the least significant first. A key lies beside its row,
    so that both move at once, and counts from the least, as there may be fewer digits then.
    """
    least = int(keys.min()) if len(keys) else 0
    used = (int(keys.max(initial=0)) - least).bit_length()
    passes = -(-used // int(np.clip(len(keys).bit_length() - 5, *DIGIT_BITS)))
    bits = -(-used // max(passes, 1))
    pairs = np.empty(len(keys), np.uint64)
    _pair(keys, least, pairs)
    for digit in range(passes):
        shift = digit * bits + _KEY
        counts = np.zeros((PARTS, 1 << bits), np.int64)
        _count_digits(pairs, shift, counts)
        # Digit by digit, and part by part within a digit.
        place = (np.cumsum(counts.T) - counts.T.ravel()).reshape(-1, PARTS).T.copy()
        moved = np.empty_like(pairs)
        _move(pairs, shift, place, moved)
        pairs = moved
    order, ordered = np.empty(len(keys), np.int32), np.empty_like(keys)
    _part(pairs, least, order, ordered)
    return order, ordered


@kernel(parallel=True)
def _pair(keys: np.ndarray, least: int, pairs: np.ndarray) -> None:
    for i in nb.prange(keys.shape[0]):
        pairs[i] = np.uint64(keys[i] - least) << np.uint64(_KEY) | np.uint64(i)


@kernel(parallel=True)
def _part(pairs: np.ndarray, least: int, order: np.ndarray, keys: np.ndarray) -> None:
    for i in nb.prange(pairs.shape[0]):
        order[i], keys[i] = np.int32(pairs[i]), least + np.int64(pairs[i] >> np.uint64(_KEY))


@kernel(parallel=True)
def _count_digits(pairs: np.ndarray, shift: int, counts: np.ndarray) -> None:
    count, mask = pairs.shape[0], np.uint64(counts.shape[1] - 1)
    for part in nb.prange(PARTS):
        for i in range(part * count // PARTS, (part + 1) * count // PARTS):
            counts[part, (pairs[i] >> np.uint64(shift)) & mask] += 1


@kernel(parallel=True)
def _move(
    pairs: np.ndarray, shift: int,  # (M,) uint64
    place: np.ndarray,  # (PARTS, digits) where the next pair of each digit goes
    moved: np.ndarray,  # (M,) out
) -> None:  # fmt: skip
    count, mask = pairs.shape[0], np.uint64(place.shape[1] - 1)
    for part in nb.prange(PARTS):
        for i in range(part * count // PARTS, (part + 1) * count // PARTS):
            digit = (pairs[i] >> np.uint64(shift)) & mask
            moved[place[part, digit]] = pairs[i]
            place[part, digit] += 1
