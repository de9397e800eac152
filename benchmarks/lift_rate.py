"""Useful pairs per second of the lift, beside what the processor could do at most.

A *pair* is a non-zero weight of W: one Gaussian in one pixel. The lift blends a view and sums its weights by label. Its
work is counted here in *aims*, one Gaussian in one tile (`splat.aim`: which blocks of 4 x 4 pixels does it reach?), and
*evaluations*, one Gaussian over the sixteen pixels of a block that it reaches and in which a ray is open
(`splat.lift_block`). Operations, each on sixteen numbers:

| step of an aim                                    | fma | add, sub, mul | other                      |
| ------------------------------------------------- | --- | ------------- | -------------------------- |
| where is the peak of each row, and how high?      | 2   | 2             | round                      |
| four times, once for each column of blocks:       |     |               |                            |
| the pixel next to the peak: is alpha 1/255 there? | 1   | 2             | min, max, compare          |

| step of an evaluation                             | fma | add, sub, mul | other                      |
| ------------------------------------------------- | --- | ------------- | -------------------------- |
| log2 of alpha: peak - wide * (c-x)^2              | 1   | 2             | 2 permutations             |
| alpha = 2^that                                    | 5   | 1             | round, convert, shift, +   |
| alpha <= 0.99                                     |     |               | min                        |
| counts it? is the ray open, still?                |     |               | 3 compares                 |
| weight = alpha T, T = T - weight                  |     | 2             |                            |
| where it ends the ray: weight = T, T = 0          |     |               | 2 selections               |

That is 6 + 10 + 13 = 29 vector instructions and 6 * 2 + 10 = 22 floating-point operations a lane of an aim,
6 + 5 + 12 = 23 and 6 * 2 + 5 = 17 a pixel of an evaluation. Summing by label adds one addition for each label in the
block, and per entry and label a sum of sixteen numbers, 15 additions in 4 steps.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numba as nb
import numpy as np
from llvmlite import ir
from machine import once
from numba.core import cgutils, types
from numba.extending import intrinsic

from gsseg_core.raster.constants import T_LIFTED
from gsseg_core.raster.cpu.blending import in_tile
from gsseg_core.raster.cpu.projection import Projected
from gsseg_core.raster.cpu.splat import ALPHA_MAX, HEIGHT, LOG_ALPHA_MIN, LOG_OPACITY, SHEAR, WIDTH, U, V
from gsseg_core.raster.cpu.tiling import TILE, Tiles
from gsseg_core.simd import LANES

AIM_FLOPS, AIM_INSTRUCTIONS = 22, 29  # of one aim, per lane and per sixteen
FLOPS, INSTRUCTIONS = 17, 23  # of one evaluation, per pixel and per sixteen
SUM_FLOPS, SUM_INSTRUCTIONS = 15, 4  # of one sum of sixteen
CHAINS = (8, 10, 12)


class Work(NamedTuple):
    """What lifting one view takes.

    Attributes
    ----------
    pairs : int
        Non-zero weights.
    aims : int
        Gaussians in tiles, up to where all rays of the tile have ended.
    evaluations : int
        Blocks of sixteen pixels that were blended.
    records : int
        Those with a non-zero weight.
    products : int
        Records times the labels in their block.
    sums : int
        Gaussians in a tile with at least one record.
    """

    pairs: int
    aims: int
    evaluations: int
    records: int
    products: int
    sums: int

    @property
    def flops(self) -> int:
        """Floating-point operations, a fused multiply-add being two."""
        blended = AIM_FLOPS * self.aims + FLOPS * self.evaluations
        return LANES * (blended + self.products) + SUM_FLOPS * self.sums

    @property
    def instructions(self) -> int:
        """Vector instructions on sixteen numbers."""
        blended = AIM_INSTRUCTIONS * self.aims + INSTRUCTIONS * self.evaluations
        return blended + self.products + SUM_INSTRUCTIONS * self.sums


def count_work(
    projected: Projected,
    tiles: Tiles,
    width: int,
    height: int,
    labels: np.ndarray | None = None,  # (H, W)
    least: float = T_LIFTED,
) -> Work:
    """Count by going through the pixels one by one, with an exponential of its own; a ray ends with less than `least`.

    Alphas within rounding of 1/255 may fall on the other side than the operator's, about one pair in a million.
    """
    if labels is None:
        labels = np.zeros((height, width), np.int32)
    counts = np.zeros((tiles.columns * tiles.rows, len(Work._fields)), np.int64)
    _count(
        tiles.columns, projected.table, tiles.start, tiles.entries, labels.astype(np.int32), np.float32(least), counts
    )
    return Work(*counts.sum(axis=0).tolist())


@nb.njit(parallel=True, cache=True)
def _count(
    columns: int,
    table: np.ndarray,  # (M, 8)
    start: np.ndarray,  # (T + 1,)
    entries: np.ndarray,  # (E,)
    labels: np.ndarray,  # (H, W)
    least: float,
    counts: np.ndarray,  # (T, 6) out, as in Work
) -> None:
    height, width = labels.shape
    for tile in nb.prange(start.shape[0] - 1):
        left, top = (tile % columns) * TILE, (tile // columns) * TILE
        rays, many = np.zeros((TILE, TILE), np.float32), np.zeros(TILE, np.int64)
        for b in range(TILE):
            seen = set([np.int32(-1)])
            for i in range(LANES):
                r, c = in_tile(b, i)
                if top + r < height and left + c < width:
                    rays[r, c] = 1.0
                    seen.add(labels[top + r, left + c])
            many[b] = len(seen) - 1
        live = np.array([_is_open(rays, b, least) for b in range(TILE)])
        for e in range(start[tile], start[tile + 1]):
            if not live.any():
                break
            counts[tile, 1] += 1
            g, any_hit = entries[e], False
            for b in range(TILE):
                if live[b]:
                    reached, hits = _blend(table[g], left, top, b, rays, least)
                    live[b] = _is_open(rays, b, least)
                    any_hit = any_hit or hits > 0
                    counts[tile, 0] += hits
                    counts[tile, 2] += reached
                    counts[tile, 3] += hits > 0
                    counts[tile, 4] += many[b] * (hits > 0)
            counts[tile, 5] += any_hit


@nb.njit
def _is_open(rays: np.ndarray, b: int, least: float) -> bool:
    """Whether a ray of a block is open."""
    found = False
    for i in range(LANES):
        found = found or rays[in_tile(b, i)] >= least
    return found


@nb.njit
def _blend(splat: np.ndarray, left: int, top: int, b: int, rays: np.ndarray, least: float) -> tuple[bool, int]:
    """Whether a Gaussian reaches a block, and how many of its open rays it hits."""
    reached, hits = False, 0
    for i in range(LANES):
        r, c = in_tile(b, i)
        dy = np.float32(r) - (splat[V] - np.float32(top + 0.5))
        x = splat[U] - np.float32(left + 0.5) + splat[SHEAR] * dy
        power = splat[LOG_OPACITY] - splat[HEIGHT] * dy * dy - splat[WIDTH] * (np.float32(c) - x) ** 2
        if power >= np.float32(LOG_ALPHA_MIN):
            reached = True
            if rays[r, c] >= least:
                hits += 1
                rays[r, c] *= 1 - min(np.float32(2.0) ** power, np.float32(ALPHA_MAX))
    return reached, hits


def _fma_kernel(chains: int) -> Callable[[int], float]:
    """Compile a loop of independent fused multiply-adds on sixteen numbers, all in registers."""

    @intrinsic
    def spin(typing: Any, start: Any, rounds: Any) -> Any:
        row = ir.VectorType(ir.FloatType(), LANES)

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            insert: Any = cgutils.get_or_insert_function
            fma = insert(builder.module, ir.FunctionType(row, [row] * 3), f"llvm.fma.v{LANES}f32")
            zero = ir.Constant(ir.IntType(32), 0)
            single = builder.insert_element(ir.Constant(row, ir.Undefined), arguments[0], zero)
            value = builder.shuffle_vector(single, single, ir.Constant(ir.VectorType(ir.IntType(32), LANES), None))
            slots = [cgutils.alloca_once_value(builder, value) for _ in range(chains)]
            with cgutils.for_range(builder, arguments[1]):
                for slot in slots:
                    builder.store(builder.call(fma, [builder.load(slot), value, value]), slot)
            total = builder.load(slots[0])
            for slot in slots[1:]:
                total = builder.fadd(total, builder.load(slot))
            return builder.extract_element(total, zero)

        return types.float32(types.float32, types.int64), generate

    @nb.njit(parallel=True, nogil=True)
    def run(rounds: int) -> float:
        threads = nb.get_num_threads()
        out = np.zeros(threads, np.float32)
        for thread in nb.prange(threads):
            out[thread] = spin(np.float32(0.5), rounds)
        return out.sum()

    return run


def fma_peak(seconds: float = 0.3, repeats: int = 5) -> float:
    """Fused multiply-adds on sixteen numbers that all threads together reach, per second: the best that was seen."""
    best = 0.0
    for chains in CHAINS:
        kernel, rounds = _fma_kernel(chains), 1 << 16
        kernel(rounds)
        while (spent := once(lambda: kernel(rounds))) < seconds / 4:  # noqa: B023 - called at once
            rounds *= 2
        rounds = int(rounds * seconds / spent)
        for _ in range(repeats):
            spent = once(lambda: kernel(rounds))  # noqa: B023
            best = max(best, nb.get_num_threads() * chains * rounds / spent)
    return best
