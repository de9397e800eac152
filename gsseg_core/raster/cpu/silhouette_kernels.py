"""Terms of silhouettes: what each Gaussian adds to its object where the view shows it, and where it shows others."""

from __future__ import annotations

import numba as nb
import numpy as np

from gsseg_core.raster.cpu.blending import corner_of, in_block, open_rays, stride_of, tile_of_turn
from gsseg_core.raster.cpu.splat import WIDTH, aim, blend_block
from gsseg_core.raster.cpu.tiling import TILE, Tiles
from gsseg_core.simd import first_bit, store_row

_ROUNDING = np.float32(1e-3)  # of 1 - T, below which a pixel is as good as empty


@nb.njit(parallel=True, nogil=True, cache=True, error_model="numpy", fastmath={"contract", "reassoc", "nnan", "nsz"})
def silhouette_terms(
    tiles: Tiles, labels: np.ndarray, num_labels: int,  # (M,) int32; those above 0 are objects
    kept: np.ndarray, asked: np.ndarray, depths: np.ndarray,  # (M,), (M,) bool, (M,)
    shown: np.ndarray, hidden_from: np.ndarray,  # (H, W), (H, W)
    stay: np.ndarray, go: np.ndarray,  # (E,) out, each
) -> None:  # fmt: skip
    """Sum by entry the reasons of its Gaussian to stay with its object, and to go; see `SilhouetteTerms`."""
    table, start, entries = tiles.table, tiles.start, tiles.entries
    stride = stride_of(tiles.rows)
    for turn in nb.prange(tiles.rows * tiles.columns):
        tile = tile_of_turn(turn, tiles.columns, tiles.rows, stride)
        # Only labels of those who are asked matter here.
        slots, count = np.full(num_labels, -1, np.int64), 0
        for e in range(start[tile], start[tile + 1]):
            label = labels[entries[e]]
            if asked[entries[e]] and slots[label] < 0:
                slots[label] = count
                count += 1
        if not count:
            continue
        fresh, lines = np.empty((TILE, TILE), np.float32), np.empty((2, TILE), np.float32)
        left, top, inside = open_rays(tiles, tile, fresh)
        limit = _cut(hidden_from, *corner_of(tiles, tile))
        through = np.ones((count, TILE, TILE), np.float32)  # T_k
        alpha = np.empty((1, TILE), np.float32)
        for e in range(start[tile], start[tile + 1]):
            g = entries[e]
            if labels[g] > 0 and slots[labels[g]] >= 0:
                reached, own = aim(table, g, left, top, lines) & inside, through[slots[labels[g]]]
                while reached:
                    b = first_bit(reached)
                    reached &= reached - 1
                    _alphas(lines, b, table[g, WIDTH], fresh, alpha)
                    for i in range(TILE):
                        own[b, i] *= np.float32(1) - kept[g] * alpha[0, i]
        need, excess = np.zeros_like(through), np.zeros_like(through)
        for label in range(1, num_labels):
            if slots[label] >= 0:
                slot = slots[label]
                _weigh(shown, label, *corner_of(tiles, tile), through[slot], need[slot], excess[slot])
        for e in range(start[tile], start[tile + 1]):
            g = entries[e]
            if asked[g]:
                reached, slot = aim(table, g, left, top, lines) & inside, slots[labels[g]]
                more, less, z = np.float32(0), np.float32(0), depths[g]
                while reached:
                    b = first_bit(reached)
                    reached &= reached - 1
                    _alphas(lines, b, table[g, WIDTH], fresh, alpha)
                    for i in range(TILE):
                        more += alpha[0, i] * need[slot, b, i]
                        less += alpha[0, i] * (excess[slot, b, i] if z <= limit[b, i] else np.float32(0))
                stay[e], go[e] = more, less


@nb.njit
def _cut(image: np.ndarray, left: int, top: int) -> np.ndarray:
    """One tile of an image (H, W), by block, (16, 16) float32; 0 outside of it."""
    out = np.zeros((TILE, TILE), np.float32)
    for r in range(min(TILE, image.shape[0] - top)):
        for c in range(min(TILE, image.shape[1] - left)):
            out[in_block(r, c)] = image[top + r, left + c]
    return out


@nb.njit(inline="always")
def _alphas(
    lines: np.ndarray, b: int, wide: float,  # (2, 16) from `aim`
    fresh: np.ndarray, alpha: np.ndarray,  # (16, 16) scratch, (1, 16) out
) -> None:  # fmt: skip
    """Alpha of a Gaussian in block b: `blend_block` makes it of rays that nothing has met yet."""
    fresh[b, :] = 1
    weight, _ = blend_block(fresh, b, lines, wide)
    store_row(alpha, 0, weight)


@nb.njit(fastmath={"contract", "nnan", "nsz"}, error_model="numpy")
def _weigh(
    shown: np.ndarray, label: int, left: int, top: int, through: np.ndarray,  # (H, W); (16, 16) T_k
    need: np.ndarray, excess: np.ndarray,  # (16, 16) out: T_k / (1 - T_k) where the label is shown; 1 where another is
) -> None:  # fmt: skip
    for r in range(min(TILE, shown.shape[0] - top)):
        for c in range(min(TILE, shown.shape[1] - left)):
            b, i = in_block(r, c)
            if shown[top + r, left + c] == label:
                need[b, i] = through[b, i] / (np.float32(1) - through[b, i] + _ROUNDING)
            elif shown[top + r, left + c] >= 0:
                excess[b, i] = 1
