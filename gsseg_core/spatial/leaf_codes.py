"""Weighted codes of points, leaf by leaf of their tree, and sums over some points of a leaf.

The points of a leaf are of few classes, as objects are continuous in space. So what is kept is a vector for each class
that occurs in a leaf, with a lane for each of its points: a sum over any of them takes a few instructions and has no
branch to mispredict.
"""

from __future__ import annotations

from typing import NamedTuple

import numba as nb
import numpy as np

from gsseg_core.csr_rows import CSRRows, starts
from gsseg_core.kernels.compiler import called_by_kernels, kernel
from gsseg_core.simd import count_bits, first_bit, sum_where
from gsseg_core.spatial.kd_tree import LEAF, Tree, leaf_range

CODE_UNIT = 2.0**-24  # codes are summed in steps of this, which is the precision of a float32 near 1

_CHUNK = 64  # consecutive leaves of one thread


class LeafCodes(NamedTuple):
    """Codes times weights of the points of each of L leaves."""

    indptr: np.ndarray  # (L + 1,) int64: entries of leaf i are indptr[i] to indptr[i + 1]
    classes: np.ndarray  # (Z,) uint32: those that occur, ascending in a leaf
    units: np.ndarray  # (Z, LEAF) int32: of each point of the leaf, at most 1 in steps of CODE_UNIT

    @classmethod
    def build(cls, tree: Tree, codes: CSRRows, weights: np.ndarray, num_classes: int) -> LeafCodes:
        """Arrange codes, N rows of K classes, and weights, (N,), in [0, 1] both, in the order of the points given."""
        ordered, factors = codes.take(tree.order), weights[tree.order] * np.float32(1 / CODE_UNIT)
        indptr = starts(_count(ordered, factors, len(tree.blocks), num_classes))
        made = cls(indptr, np.empty(indptr[-1], np.uint32), np.empty((indptr[-1], LEAF), np.int32))
        _fill(ordered, factors, num_classes, made)
        return made


@kernel(parallel=True)
def _count(codes: CSRRows, factors: np.ndarray, leaves: int, num_classes: int) -> np.ndarray:
    """Count the classes of each leaf, (L,) int64; codes and factors, weights in steps of CODE_UNIT, are by place."""
    counts = np.zeros(leaves, np.int64)
    for chunk in nb.prange((leaves + _CHUNK - 1) // _CHUNK):
        occurring = none_of(num_classes)
        for leaf in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, leaves)):
            _mark(codes, factors, leaf, leaves, occurring)
            for word in range(len(occurring)):
                counts[leaf] += count_bits(occurring[word])
                occurring[word] = 0
    return counts


@kernel(parallel=True)
def _fill(codes: CSRRows, factors: np.ndarray, num_classes: int, made: LeafCodes) -> None:
    indptr, classes, units = made
    leaves, n = len(indptr) - 1, len(factors)
    for chunk in nb.prange((leaves + _CHUNK - 1) // _CHUNK):
        occurring, entry_of = none_of(num_classes), np.empty(num_classes, np.int64)
        for leaf in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, leaves)):
            _mark(codes, factors, leaf, leaves, occurring)
            z = indptr[leaf]
            for word in range(len(occurring)):
                while occurring[word]:
                    c = take_first(occurring, word)
                    classes[z], units[z], entry_of[c] = c, 0, z
                    z += 1
            first, last = leaf_range(leaf, leaves, n)
            for place in range(first, last):
                for e in range(codes.indptr[place], codes.indptr[place + 1]):
                    unit = _unit(codes, factors, place, e)
                    if unit > 0:
                        units[entry_of[codes.indices[e]], place - first] += unit


@called_by_kernels
def none_of(num_classes: int) -> np.ndarray:
    """Make a set of classes, a bit each in (K / 64,) int64, with none in it."""
    return np.zeros((num_classes + 63) // 64, np.int64)


@called_by_kernels
def put(occurring: np.ndarray, c: int) -> None:
    """Put a class into a set."""
    occurring[c >> 6] |= np.int64(1) << np.int64(c & 63)


@called_by_kernels
def take_first(occurring: np.ndarray, word: int) -> int:
    """Take the first of the classes of a word out of a set; there must be one."""
    bits = occurring[word]
    occurring[word] = bits & (bits - 1)
    return 64 * word + first_bit(bits)


@called_by_kernels
def add_leaf(
    codes: LeafCodes, leaf: int, lanes: int, which: int,
    sums: np.ndarray, occurring: np.ndarray,  # (K, 2) int64, of which it is column `which`; classes that it may be of
) -> None:  # fmt: skip
    """Add up the codes of those points of a leaf whose lanes' bits are set."""
    for z in range(codes.indptr[leaf], codes.indptr[leaf + 1]):
        sums[codes.classes[z], which] += sum_where(codes.units, z, lanes)
        put(occurring, codes.classes[z])


@called_by_kernels
def _mark(codes: CSRRows, factors: np.ndarray, leaf: int, leaves: int, occurring: np.ndarray) -> None:
    """Put the classes of which a point of a leaf has something into a set."""
    first, last = leaf_range(leaf, leaves, len(factors))
    for place in range(first, last):
        for e in range(codes.indptr[place], codes.indptr[place + 1]):
            if _unit(codes, factors, place, e) > 0:
                put(occurring, codes.indices[e])


@called_by_kernels
def _unit(codes: CSRRows, factors: np.ndarray, place: int, entry: int) -> np.int32:
    return np.int32(np.rint(factors[place] * codes.data[entry])) if factors[place] > 0 else np.int32(0)
