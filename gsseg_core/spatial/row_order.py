"""Rows of arrays in another order: Gaussians that are near each other in space are to be so in memory."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numba as nb
import numpy as np

from gsseg_core.kernels.compiler import kernel
from gsseg_core.scene.gaussian_scene import ACTIVATED, GaussianScene
from gsseg_core.scene.scene_cache import PerScene
from gsseg_core.simd import AHEAD, prefetch

_CELLS = 1 << 10  # along each axis: three numbers of ten bits make one of thirty
_SAMPLE = 1 << 16  # Gaussians by which the box of the curve is found
_TAIL = 1.0  # percent of these on each side that may lie outside, so that a far floater makes no cell large
_LINE = 16  # numbers of 32 bits in a cache line


class RowOrder(NamedTuple):
    """In which order arrays hold the N Gaussians of a scene."""

    order: np.ndarray  # (N,) int32: the Gaussian at each place
    places: np.ndarray  # (N,) int32: the place of each Gaussian

    @classmethod
    def own(cls, count: int) -> RowOrder:
        """Leave them in the order that they have."""
        return cls(*(np.arange(count, dtype=np.int32) for _ in cls._fields))


_KNOWN: PerScene[RowOrder] = PerScene()


def along_curve(scene: GaussianScene) -> RowOrder:
    """Order the Gaussians of a scene by `curve_order`; it is kept as long as the scene."""

    def found() -> RowOrder:
        order = curve_order(scene.means).astype(np.int32)
        return RowOrder(order, inverse(order))

    return _KNOWN.of(scene, found)


def in_curve_order(scene: GaussianScene) -> tuple[GaussianScene, np.ndarray]:
    """Give a scene whose Gaussians lie `along_curve`, and the place of each of this one's in it, (N,) int32."""
    order, places = along_curve(scene)
    ordered = reordered(scene, order)
    _KNOWN.of(ordered, partial(RowOrder.own, len(scene)))
    return ordered, places


def curve_order(means: np.ndarray) -> np.ndarray:
    """Order Gaussians of means (N, 3) along the Z-order curve of Morton (1966): the index of each, (N,) int64.

    Those in one cell stay in their order. Trainers leave them in nearly random order, so that each look at a neighbour
    waits for memory.
    """
    low, high = np.percentile(means[:: len(means) // _SAMPLE + 1], (_TAIL, 100 - _TAIL), axis=0)
    with np.errstate(over="ignore"):  # What is so far away is in the last cell.
        cells = (means - low.astype(np.float32)) * np.float32(_CELLS / max(float((high - low).max()), 1e-30))
    key = np.zeros(len(means), np.uint32)
    for axis, place in enumerate(np.clip(cells, 0, _CELLS - 1).astype(np.uint32).T):
        key |= _spread(place) << np.uint32(axis)
    # One number for the cell and the index sorts in a fifth of the time that argsort takes.
    both = np.sort(key.astype(np.uint64) << np.uint64(32) | np.arange(len(means), dtype=np.uint64))
    return (both & np.uint64(0xFFFFFFFF)).astype(np.int64)


def rows_by_label(labels: np.ndarray) -> dict[int, np.ndarray]:  # (N,) int
    """List the rows that have each label, (M,) int64 ascending: by label, ascending, of those that occur."""
    # Short numbers are sorted by their digits, in a quarter of the time.
    short = labels.min(initial=0) >= -(2**15) and labels.max(initial=0) < 2**15
    order = np.argsort(labels.astype(np.int16) if short else labels, kind="stable")
    in_order = labels[order]
    first = np.flatnonzero(np.diff(in_order, prepend=in_order[:1] - 1))
    return dict(zip(in_order[first].tolist(), np.split(order, first[1:]), strict=False))  # No row is no label.


def _spread(number: np.ndarray) -> np.ndarray:
    """Put two zeros before each of the ten bits of numbers, (N,) uint32."""
    for shift, mask in ((16, 0x30000FF), (8, 0x300F00F), (4, 0x30C30C3), (2, 0x9249249)):
        number = (number | number << np.uint32(shift)) & np.uint32(mask)
    return number


def inverse(order: np.ndarray) -> np.ndarray:  # (N,) integers
    """Place of each index in an order, (N,) of the same type."""
    places = np.empty_like(order)
    places[order] = np.arange(len(order), dtype=order.dtype)
    return places


def reordered(scene: GaussianScene, order: np.ndarray) -> GaussianScene:
    """Give a scene whose Gaussian i is Gaussian order[i] of this one, (N,) integers, as `GaussianScene.subset` does."""
    records = scene.vertices
    arrays: dict[str, Any] = {
        name: take_rows(getattr(scene, name).reshape(len(scene), -1), order) for name in ACTIVATED
    }
    arrays["opacities"] = arrays["opacities"][:, 0]
    if records.itemsize % 4 or not records.flags.c_contiguous:
        return replace(scene.subset(order), **arrays)
    # As numbers that they need not be: they are only copied.
    vertices = np.empty_like(records)
    out, table = (each.view(np.float32).reshape(len(scene), -1) for each in (vertices, records))
    take_rows_into(out, table, order)
    return replace(scene, vertices=vertices, **arrays)


@kernel(parallel=True)
def take_rows_into(out: np.ndarray, table: np.ndarray, chosen: np.ndarray) -> None:
    """Copy some rows, (M',), of a table (M, K) of 32 bits into the first K columns of another."""
    last = chosen.shape[0] - 1
    for m in nb.prange(chosen.shape[0]):
        later = table[chosen[min(m + AHEAD, last)]]
        for j in range(0, table.shape[1], _LINE):
            prefetch(later, j)
        row, copy = table[chosen[m]], out[m]
        for j in range(row.shape[0]):
            copy[j] = row[j]


@kernel
def take_rows(table: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Copy some rows into a table of their own; several times as fast as NumPy where they lie anywhere."""
    # NumPy would ask for huge pages, which take longer to get where tables come and go with each view.
    out = np.empty((len(chosen), table.shape[1]), table.dtype)
    take_rows_into(out, table, chosen)
    return out
