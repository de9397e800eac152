"""How deep a view sees: the depth, tile by tile, beyond which no labelled pixel sees anything, as lifting finds it."""

from __future__ import annotations

from collections.abc import Callable

import numba as nb
import numpy as np

from gsseg_core.kernels.compiler import kernel
from gsseg_core.raster.cpu.blending import aim_next, blocks_with, corner_of, open_rays, tile_of_turn
from gsseg_core.raster.cpu.projection import project
from gsseg_core.raster.cpu.splat import OPEN, WIDTH, lift_block
from gsseg_core.raster.cpu.tiling import TILE, Tiles, assign
from gsseg_core.raster.depth import depths
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.simd import FAST, first_bit

_GOES_ON, _NO_LABEL = -1, -2  # in place of the entry at which a tile's rays end


def nearest_depths(scene: GaussianScene, camera: Camera) -> np.ndarray:
    """Find how near Gaussians come in each tile of a view: (T,) float32, in scene units, infinite where none is.

    T is the number of 16 x 16 tiles, row by row.
    """
    return _entry_depths(scene, camera, lambda tiles: np.where(np.diff(tiles.start), tiles.start[:-1], _GOES_ON))


def ray_ends(
    scene: GaussianScene,
    camera: Camera,
    labels: np.ndarray,  # (H, W) int32, negative where unknown
) -> np.ndarray:
    """Find the depth at which the rays of all labelled pixels of each tile have ended: (T,) float32, in scene units.

    What lies beyond has no weight in any of them, and lifting never comes to it. Infinite where a ray goes on;
    -infinite where no pixel has a label.
    """
    return _entry_depths(scene, camera, lambda tiles: _find_ends(tiles, np.greater_equal(labels, 0, order="C")))


def _entry_depths(scene: GaussianScene, camera: Camera, find: Callable[[Tiles], np.ndarray]) -> np.ndarray:
    """Depths of the entry that is found of each tile, (T,) float32; infinite where there is none."""
    projected = project(scene, camera)
    tiles = assign(projected, camera.width, camera.height)
    entries = find(tiles)
    found = np.where(entries == _NO_LABEL, np.float32(-np.inf), np.float32(np.inf))
    found[entries >= 0] = depths(scene, camera, projected.ids[tiles.entries[entries[entries >= 0]]])
    return found


@kernel(parallel=True, fastmath=FAST, error_model="numpy")
def _find_ends(tiles: Tiles, labelled: np.ndarray) -> np.ndarray:  # (H, W) bool
    """Find the entry of each tile at which its last labelled block ends, as `lifting` would, (T,) int64."""
    ends, table, entries = np.empty(tiles.rows * tiles.columns, np.int64), tiles.table, tiles.entries
    for turn in nb.prange(tiles.rows * tiles.columns):
        tile = tile_of_turn(tiles, turn)
        rays, lines = np.empty((TILE, TILE), np.float32), np.empty((2, 2, TILE), np.float32)
        left, top, live = open_rays(tiles, tile, rays)
        live &= blocks_with(labelled, *corner_of(tiles, tile))
        ends[tile] = _GOES_ON if live else _NO_LABEL
        last = tiles.start[tile + 1]
        ahead = aim_next(table, entries, tiles.start[tile] - 1, last, left, top, lines)
        for e in range(tiles.start[tile], last):
            blocks, wide = ahead & live, table[entries[e], WIDTH]
            ahead = aim_next(table, entries, e, last, left, top, lines)
            while blocks:
                b = first_bit(blocks)
                blocks &= blocks - 1
                _, bits = lift_block(rays, b, lines, e % 2, wide)
                if not bits & OPEN:
                    live &= ~(1 << b)
            if not live:
                if ends[tile] == _GOES_ON:
                    ends[tile] = e
                break
    return ends
