"""Masks of a made-up room as automatic generators make them: hundreds of things, under numbers of each view's own.

Things are the Gaussians nearest to seeds on the surfaces, and each has four parts. In each view a quarter of the things
are cut into these, a tenth goes under one id with a neighbour, and a tenth of what then is there has no mask.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from room import Room
from scipy.spatial import cKDTree

from gsseg_core.data.label_images import UNKNOWN, write_mask
from gsseg_core.raster.backends import make_operator
from gsseg_core.raster.depth import surface
from gsseg_core.raster.view_renderer import PixelGrid
from gsseg_core.scene.camera import Camera

THINGS, PARTS = 300, 4
CUT, MERGED, MISSING = 0.25, 0.1, 0.1  # shares of the things, and of the segments
LEAST_PX = 100  # of a segment
STEP = 2  # px to which masks are drawn
FAR = 1.5  # mean distances of the cameras from their centre: what is farther off is told apart by its direction


class AutomaticMasks:
    """Draws the masks of a room."""

    def __init__(self, room: Room, seed: int = 0) -> None:
        self._scene, self._rng = room.scene, np.random.default_rng(seed)
        eyes = np.stack([camera.center for camera in room.cameras])
        self._centre = eyes.mean(axis=0)
        self._reach = FAR * np.linalg.norm(eyes - self._centre, axis=1).mean()
        places = self._drawn_near(room.scene.means.astype(np.float64))
        seeds, parts = (places[self._rng.choice(len(places), THINGS * n, replace=False)] for n in (1, PARTS))
        things = cKDTree(seeds)
        self._parts, self._owner = cKDTree(parts), things.query(parts)[1]
        self._near = things.query(seeds, 4)[1][:, 1:]

    def draw(self, camera: Camera) -> np.ndarray:
        """Draw the mask of a view, (H, W) int32, 1 and up; `UNKNOWN` where there is none."""
        depth = surface(self._scene, make_operator(self._scene, camera), PixelGrid(0, STEP)).depth
        known = np.isfinite(depth)
        y, x = STEP * np.indices(depth.shape) + 0.5
        z = np.where(known, depth, 0)
        places = np.stack([(x - camera.cx) / camera.fx * z, (y - camera.cy) / camera.fy * z, z, np.ones_like(z)], -1)
        world = (places @ np.linalg.inv(camera.world_to_camera).T)[..., :3]
        part = self._parts.query(self._drawn_near(world), workers=-1)[1]
        things = np.arange(THINGS)
        merged = self._rng.random(THINGS) < MERGED
        things[merged] = self._near[merged, self._rng.integers(0, self._near.shape[1], np.count_nonzero(merged))]
        thing, cut = self._owner[part], self._rng.random(THINGS) < CUT
        segment = np.unique(np.where(cut[thing], THINGS + part, things[thing]), return_inverse=True)[1]
        segment = segment.reshape(depth.shape)
        count = np.bincount(segment[known], minlength=int(segment.max()) + 1)
        there = (self._rng.random(len(count)) >= MISSING) & (STEP**2 * count >= LEAST_PX)
        ids = np.where(there, self._rng.permutation(len(count)) + 1, UNKNOWN)[segment]
        mask = np.where(known, ids, UNKNOWN).astype(np.int32).repeat(STEP, axis=0).repeat(STEP, axis=1)
        return mask[: camera.height, : camera.width]

    def write(self, folder: Path, camera: Camera) -> None:
        """Write the mask of a view, with 16 bits."""
        write_mask(folder / f"{camera.name}.png", self.draw(camera), 16)

    def _drawn_near(self, places: np.ndarray) -> np.ndarray:
        """Move places (..., 3) that are far off onto a sphere around the cameras."""
        away = places - self._centre
        distance = np.linalg.norm(away, axis=-1, keepdims=True)
        return np.asarray(self._centre + away * np.minimum(1, self._reach / np.maximum(distance, 1e-9)))
