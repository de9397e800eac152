"""How deep a view sees: the depth, tile by tile, beyond which no labelled pixel sees anything, as lifting finds it."""

from __future__ import annotations

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


def nearest_depths(scene: GaussianScene, camera: Camera) -> np.ndarray:
    """Find how near Gaussians come in each tile of a view: (T,) float32, in scene units, infinite where none is.

    T is the number of 16 x 16 tiles, row by row.
    """
    projected = project(scene, camera)
    tiles = assign(projected, camera.width, camera.height)
    return _entry_depths(scene, camera, projected.ids, tiles, tiles.start[:-1], np.diff(tiles.start) > 0)


def ray_ends(
    scene: GaussianScene,
    camera: Camera,
    labels: np.ndarray,  # (H, W) int32, negative where unknown
) -> np.ndarray:
    """Find the depth at which the rays of all labelled pixels of each tile have ended: (T,) float32, in scene units.

    What lies beyond has no weight in any of them, and lifting never comes to it. Infinite where a ray goes on;
    -infinite where no pixel has a label.
    """
    projected = project(scene, camera)
    tiles = assign(projected, camera.width, camera.height)
    ends = _find_ends(tiles, np.greater_equal(labels, 0, order="C"))
    found = _entry_depths(scene, camera, projected.ids, tiles, ends, ends >= 0)
    found[ends == _NO_LABEL] = -np.inf
    return found


_GOES_ON, _NO_LABEL = -1, -2


def _entry_depths(
    scene: GaussianScene, camera: Camera, ids: np.ndarray, tiles: Tiles, entries: np.ndarray, valid: np.ndarray
) -> np.ndarray:
    """Depths of an entry of each tile, (T,) float32, where that is valid; else infinite."""
    found = np.full(len(valid), np.inf, np.float32)
    found[valid] = depths(scene, camera, ids[tiles.entries[entries[valid]]])
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
