"""The objects of a view, each as if it stood there alone, on the CPU."""

from __future__ import annotations

from dataclasses import dataclass

import numba as nb
import numpy as np

from gsseg_core.kernels.compiler import called_by_kernels, kernel
from gsseg_core.raster.constants import T_MIN
from gsseg_core.raster.cpu.blending import corner_of, in_block, open_rays, tile_of_turn
from gsseg_core.raster.cpu.splat import WIDTH, aim, alpha_of
from gsseg_core.raster.cpu.tiling import TILE, Tiles
from gsseg_core.raster.objects_alone import ObjectsAlone
from gsseg_core.simd import (
    AHEAD,
    FAST,
    add_product,
    add_scaled,
    first_bit,
    load_row,
    prefetch,
    store_row,
    sum_row,
    zero_row,
)
from gsseg_core.spatial.row_order import take_rows

ROUNDING = np.float32(1e-3)  # of 1 - T, below which a pixel is as good as empty
_UNKNOWN, _MIXED = np.int32(-1), np.int32(-2)  # in place of the one label that a block or a tile shows
_NOT_SHOWN = TILE * TILE  # in place of a label's slot: a tile shows no more labels than it has pixels


@dataclass(frozen=True, eq=False)
class TileObjects(ObjectsAlone):
    """They come in the order in which tiles meet them: what one tile needs lies close together."""

    ids: np.ndarray
    labels: np.ndarray  # (M,) int32: object of each, above 0
    tiles: Tiles  # of these alone, without what is told by Gaussian

    @classmethod
    def of(cls, ids: np.ndarray, tiles: Tiles, labels: np.ndarray) -> TileObjects:
        """Choose them among the Gaussians of a view, `ids` (M',), by the labels (N,) int32 of the whole scene."""
        labels = labels[ids]
        start, entries, rows = _choose(tiles.start, tiles.entries, labels)
        return cls(ids[rows], labels[rows], Tiles(*tiles[:5], take_rows(tiles.table, rows), start, entries))

    @property
    def nbytes(self) -> int:
        """Bytes that they take."""
        return sum(array.nbytes for array in (self.ids, self.labels, *self.tiles[5:]))

    def reasons_to_go(self, depths: np.ndarray, shown: np.ndarray, hidden_from: np.ndarray) -> np.ndarray:
        """Weigh what speaks against each Gaussian in its object."""
        go = _reasons_to_go(self.tiles, self.labels, depths, shown, hidden_from)
        return sums_by_gaussian(self.tiles.entries, go, len(self.ids))

    def reasons_to_stay(self, kept: np.ndarray, asked: np.ndarray, shown: np.ndarray) -> np.ndarray:
        """Weigh what speaks for each Gaussian in its object."""
        count = int(self.labels.max(initial=0)) + 1
        stay = _reasons_to_stay(self.tiles, self.labels, count, kept, asked, shown)
        return sums_by_gaussian(self.tiles.entries, stay, len(self.ids))


@kernel
def _choose(start: np.ndarray, entries: np.ndarray, labels: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Keep the entries of Gaussians with a label, (M',) int32, above 0, and number these as they occur.

    Returns where the entries of each tile begin, (T + 1,) int64; the new number of each entry's Gaussian, (E,) int32;
    and the former one of each, (M,) int32.
    """
    new, former = np.full(labels.shape[0], -1, np.int32), np.empty(labels.shape[0] + 1, np.int32)
    kept_start, kept, e, n = np.zeros_like(start), np.empty_like(entries), 0, np.int32(0)
    last = entries.shape[0] - 1
    for tile in range(start.shape[0] - 1):
        for i in range(start[tile], start[tile + 1]):
            later = entries[min(i + 2 * AHEAD, last)]
            prefetch(new, later)
            prefetch(labels, later)
            g = entries[i]
            own, known = labels[g] > 0, new[g]
            # Without a branch, which nobody could predict: what does not count is overwritten.
            former[n] = g
            number = n if known < 0 else known
            kept[e] = number
            new[g] = number if own else np.int32(-1)
            n += np.int32(own & (known < 0))
            e += own
        kept_start[tile + 1] = e
    return kept_start, kept[:e].copy(), former[:n].copy()


@kernel(parallel=True, error_model="numpy", fastmath=FAST)
def _reasons_to_go(
    tiles: Tiles, labels: np.ndarray, depths: np.ndarray,  # (M,) int32 above 0, (M,)
    shown: np.ndarray, hidden_from: np.ndarray,  # (H, W), (H, W)
) -> np.ndarray:  # fmt: skip
    """Sum by entry its Gaussian's alphas over the pixels that show another label, where they do not hide it: (E,)."""
    table, start, entries = tiles.table, tiles.start, tiles.entries
    go = np.zeros(len(entries), np.float32)
    for turn in nb.prange(tiles.rows * tiles.columns):
        tile = tile_of_turn(tiles, turn)
        fresh, lines = np.empty((TILE, TILE), np.float32), np.empty((2, TILE), np.float32)
        left, top, inside = open_rays(tiles, tile, fresh)
        seen, limit = np.full((TILE, TILE), _UNKNOWN, np.int32), np.zeros((TILE, TILE), np.float32)
        _cut(shown, *corner_of(tiles, tile), seen)
        _cut(hidden_from, *corner_of(tiles, tile), limit)
        only, farthest = np.empty(TILE, np.int32), np.empty(TILE, np.float32)
        tile_only, tile_farthest = _summed_up(seen, limit, only, farthest)
        if tile_only == _UNKNOWN:
            continue
        alpha = np.empty((1, TILE), np.float32)
        for e in range(start[tile], start[tile + 1]):
            g = entries[e]
            label, z = labels[g], depths[g]
            if label == tile_only or z > tile_farthest:
                continue
            reached, total = aim(table, g, left, top, lines, 0) & inside, np.float32(0)
            while reached:
                b = first_bit(reached)
                reached &= reached - 1
                if only[b] == label or only[b] == _UNKNOWN or z > farthest[b]:
                    continue
                store_row(alpha, 0, alpha_of(b, lines, 0, table[g, WIDTH]))
                for i in range(TILE):
                    outside = seen[b, i] != label and seen[b, i] >= 0 and z <= limit[b, i]
                    total += alpha[0, i] if outside else np.float32(0)
            go[e] = total
    return go


@kernel(parallel=True, error_model="numpy", fastmath=FAST)
def _reasons_to_stay(
    tiles: Tiles, labels: np.ndarray, num_labels: int,  # (M,) int32 above 0
    kept: np.ndarray, asked: np.ndarray, shown: np.ndarray,  # (M,) float32, (M,) bool, (H, W)
) -> np.ndarray:  # fmt: skip
    """Sum by entry its Gaussian's alpha T_k / (1 - T_k) over the pixels that show its object k, for those asked for.

    Returns (E,) float32.
    """
    table, start, entries = tiles.table, tiles.start, tiles.entries
    stay = np.zeros(len(entries), np.float32)
    for turn in nb.prange(tiles.rows * tiles.columns):
        tile = tile_of_turn(tiles, turn)
        seen = np.full((TILE, TILE), _UNKNOWN, np.int32)
        corner = corner_of(tiles, tile)
        _cut(shown, *corner, seen)
        slots = np.full(num_labels, _NOT_SHOWN, np.int64)
        shows, count = _blocks_by_slot(seen, slots)
        if not count:
            continue
        left, top = np.float32(corner[0] + 0.5), np.float32(corner[1] + 0.5)
        lines = np.empty((2, 2, TILE), np.float32)
        live = np.zeros_like(shows)  # blocks that show the object and who is asked for, until it covers all in them
        for e in range(start[tile], start[tile + 1]):
            g = entries[e]
            slot = slots[labels[g]]
            if asked[g] and live[slot] != shows[slot]:
                live[slot] |= aim(table, g, left, top, lines, 0) & shows[slot]
        members, n = np.empty(start[tile + 1] - start[tile] + 1, np.int32), 0
        for e in range(start[tile], start[tile + 1]):  # without a branch: who is not wanted is overwritten
            members[n] = entries[e]
            n += live[slots[labels[entries[e]]]] != 0
        if not n:
            continue
        through = np.ones((count * TILE, TILE), np.float32)  # T_k, block by block
        # Aimed one early, as in `aim_next`.
        ahead = aim(table, members[0], left, top, lines, 0)
        for m in range(n):
            g = members[m]
            slot = slots[labels[g]]
            reached = ahead & live[slot]
            if m + 1 < n and live[slots[labels[members[m + 1]]]]:
                ahead = aim(table, members[m + 1], left, top, lines, (m + 1) % 2)
            while reached:
                b = first_bit(reached)
                reached &= reached - 1
                before = load_row(through, slot * TILE + b)
                share = add_scaled(zero_row(), alpha_of(b, lines, m % 2, table[g, WIDTH]), -kept[g])
                after = add_product(before, before, share)
                store_row(through, slot * TILE + b, after)
                if sum_row(after) < T_MIN:
                    live[slot] &= ~(1 << b)
        need = np.zeros_like(through)
        _weigh(seen, through, need)
        for e in range(start[tile], start[tile + 1]):
            g = entries[e]
            slot, total = slots[labels[g]], zero_row()
            if asked[g] and live[slot]:
                reached = aim(table, g, left, top, lines, 0) & live[slot]
                while reached:
                    b = first_bit(reached)
                    reached &= reached - 1
                    alpha = alpha_of(b, lines, 0, table[g, WIDTH])
                    total = add_product(total, alpha, load_row(need, slot * TILE + b))
                stay[e] = sum_row(total)
    return stay


@kernel
def sums_by_gaussian(entries: np.ndarray, weights: np.ndarray, count: int) -> np.ndarray:  # (E,) int32, (E,) float32
    """Add up the weights of each Gaussian's entries, (count,) float64: as `bincount`, but most are 0 and left out."""
    total = np.zeros(count)
    for e in range(entries.shape[0]):
        if weights[e] != 0:
            total[entries[e]] += weights[e]
    return total


@called_by_kernels
def _cut(image: np.ndarray, left: int, top: int, out: np.ndarray) -> None:  # (H, W); (16, 16)
    """One tile of an image, by block; what lies outside of the image stays as it was."""
    for r in range(min(TILE, image.shape[0] - top)):
        for c in range(min(TILE, image.shape[1] - left)):
            out[in_block(r, c)] = image[top + r, left + c]


@called_by_kernels
def _summed_up(
    seen: np.ndarray, limit: np.ndarray, only: np.ndarray, farthest: np.ndarray,  # (16, 16) each; (16,) out, each
) -> tuple[np.int32, np.float32]:  # fmt: skip
    """Of each block, and of the tile: the only label that it shows, and the depth behind which all is hidden."""
    tile_only, tile_farthest = _UNKNOWN, np.float32(0)
    for b in range(TILE):
        found, depth = _UNKNOWN, np.float32(0)
        for i in range(TILE):
            if seen[b, i] >= 0:
                found = _joined(found, seen[b, i])
                depth = max(depth, limit[b, i])
        only[b], farthest[b] = found, depth
        if found != _UNKNOWN:
            tile_only = _joined(tile_only, found)
            tile_farthest = max(tile_farthest, depth)
    return tile_only, tile_farthest


@nb.njit(inline="always")
def _joined(known: np.int32, label: np.int32) -> np.int32:
    if known == _UNKNOWN:
        return label
    return known if known == label else _MIXED


@called_by_kernels
def _blocks_by_slot(seen: np.ndarray, slots: np.ndarray) -> tuple[np.ndarray, int]:  # (16, 16), by label; changed
    """Give each label that a tile shows a slot, and put that in its place.

    Returns in which blocks it is, as bits by slot, and how many slots there are.
    """
    blocks, count = np.zeros(_NOT_SHOWN + 1, np.int64), 0
    for b in range(TILE):
        for i in range(TILE):
            label = seen[b, i]
            if not 0 < label < len(slots):
                seen[b, i] = _NOT_SHOWN
                continue
            if slots[label] == _NOT_SHOWN:
                slots[label] = count
                count += 1
            seen[b, i] = slots[label]
            blocks[slots[label]] |= 1 << b
    return blocks, count


@called_by_kernels(fastmath={"contract", "nnan", "nsz"}, error_model="numpy")
def _weigh(
    seen: np.ndarray,  # (16, 16): slots
    through: np.ndarray, need: np.ndarray,  # (16 S, 16) T_k; out, T_k / (1 - T_k) where label k is shown
) -> None:  # fmt: skip
    for b in range(TILE):
        for i in range(TILE):
            if seen[b, i] != _NOT_SHOWN:
                n = seen[b, i] * TILE + b
                need[n, i] = through[n, i] / (np.float32(1) - through[n, i] + ROUNDING)
