"""How good silhouettes could be, were the Gaussians of an object chosen by the truth of the very views that score it.

Each object keeps any subset of its own Gaussians. Those are taken out, and put back, one after the other whenever that
raises the IoU of the object with its true masks, until nothing changes. It is the `visible` score of
`object_scores`, but for two things: the threshold at an alpha of one half is a steep logistic, so that
two Gaussians that hide each other can both go, and whether a pixel is hidden is asked of each Gaussian rather than of
the object's mean depth. It finds a local optimum: a bound from below on what selection can reach.
"""

from __future__ import annotations

from collections.abc import Sequence

import numba as nb
import numpy as np

from gsseg_core.data.view import View
from gsseg_core.raster.backends import make_operator
from gsseg_core.raster.cpu.blending import corner_of, in_tile, open_rays
from gsseg_core.raster.cpu.projection import project
from gsseg_core.raster.cpu.splat import WIDTH, aim, blend_block
from gsseg_core.raster.cpu.tiling import TILE, Tiles, assign
from gsseg_core.raster.depth import BEHIND, depths, surface
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.simd import first_bit, store_row

SWEEPS = 4  # for each steepness
STEEPNESS = (4.0, 12.0, 36.0)  # of the logistic, in optical depth, one after the other


def best_selection(
    scene: GaussianScene,
    labels: np.ndarray,  # (N,) int
    views: Sequence[View],  # with true masks
    whole: GaussianScene,  # whose surface hides things: the scene before anything was split
) -> np.ndarray:
    """Labels (N,) after the Gaussians that the truth does not want are taken out of their objects (-2)."""
    truth = np.concatenate([view.read_labels().ravel() for view in views])
    limits = [surface(whole, make_operator(whole, view.camera)).depth * np.float32(BEHIND) for view in views]
    chosen = labels.copy()
    for label in np.intersect1d(labels[labels > 0], truth).tolist():
        members = np.flatnonzero(labels == label)
        start, pixels, depth = _cover(scene.subset(members), views, limits)
        kept = np.ones(len(members), bool)
        for steepness in STEEPNESS:
            _descend(start, pixels, depth, truth, label, kept, steepness)
        chosen[members[~kept]] = -2
    return chosen


def _cover(
    alone: GaussianScene, views: Sequence[View], limits: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """List what each Gaussian covers: where its list starts, 2 * pixel (+ 1 if not hidden there), -log(1 - alpha)."""
    parts, first = [], 0
    for view, limit in zip(views, limits, strict=True):
        camera = view.camera
        projected = project(alone, camera)
        tiles = assign(projected, camera.width, camera.height)
        depth = depths(alone, camera, projected.ids)
        lists = (tiles, depth, limit, first)
        nothing = np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.float32)
        size = _walk(*lists, *nothing)
        found = np.zeros(size, np.int64), np.zeros(size, np.int64), np.zeros(size, np.float32)
        _walk(*lists, *found)
        parts.append((projected.ids[found[0]], found[1], found[2]))
        first += camera.width * camera.height
    gaussians, pixels, optical = (np.concatenate(part) for part in zip(*parts, strict=True))
    order = np.argsort(gaussians, kind="stable")
    start = np.concatenate([[0], np.cumsum(np.bincount(gaussians, minlength=len(alone)))])
    return start, pixels[order], optical[order]


@nb.njit(cache=True, error_model="numpy")
def _walk(
    tiles: Tiles,
    depth: np.ndarray,  # (M,)
    limit: np.ndarray,  # (H, W)
    first: int,  # pixel of this view among those of all
    gaussians: np.ndarray,  # (P,) out, or empty to count only
    pixels: np.ndarray,  # (P,) out
    optical: np.ndarray,  # (P,) out
) -> int:
    height, width = limit.shape
    fresh, lines = np.empty((TILE, TILE), np.float32), np.empty((2, TILE), np.float32)
    alpha, n = np.empty((1, TILE), np.float32), 0
    for tile in range(tiles.columns * tiles.rows):
        left, top = corner_of(tiles, tile)
        u, v, inside = open_rays(tiles, tile, fresh)
        for e in range(tiles.start[tile], tiles.start[tile + 1]):
            g = tiles.entries[e]
            reached = aim(tiles.table, g, u, v, lines, 0) & inside
            while reached:
                b = first_bit(reached)
                reached &= reached - 1
                fresh[b, :] = 1
                weight, _ = blend_block(fresh, b, lines, 0, tiles.table[g, WIDTH])
                store_row(alpha, 0, weight)
                for i in range(TILE):
                    r, c = in_tile(b, i)
                    if alpha[0, i] > 0 and top + r < height and left + c < width:
                        if len(gaussians):
                            gaussians[n] = g
                            shows = depth[g] <= limit[top + r, left + c]
                            pixels[n] = 2 * (first + (top + r) * width + left + c) + shows
                            optical[n] = -np.log(1 - alpha[0, i])
                        n += 1
    return n


@nb.njit(cache=True, error_model="numpy")
def _descend(
    start: np.ndarray,  # (M + 1,)
    pixels: np.ndarray,  # (P,)
    optical: np.ndarray,  # (P,)
    truth: np.ndarray,  # (pixels of all views,)
    label: int,
    kept: np.ndarray,  # (M,) bool, in and out
    steepness: float,
) -> None:
    total = np.zeros((2, len(truth)), np.float32)  # of all members, and of those that are not hidden
    for g in range(len(kept)):
        if kept[g]:
            for e in range(start[g], start[g + 1]):
                total[0, pixels[e] >> 1] += optical[e]
                total[1, pixels[e] >> 1] += optical[e] * (pixels[e] & 1)
    hit, union = 0.0, 0.0
    for p in range(len(truth)):
        if truth[p] == label:
            hit += _covered(total[0, p], steepness)
            union += 1
        elif truth[p] >= 0:
            union += _covered(total[1, p], steepness)
    for _ in range(SWEEPS):
        flips = 0
        for g in range(len(kept)):
            sign = np.float32(-1 if kept[g] else 1)
            more, beside = 0.0, 0.0
            for e in range(start[g], start[g + 1]):
                p = pixels[e] >> 1
                if truth[p] == label:
                    more += _covered(total[0, p] + sign * optical[e], steepness) - _covered(total[0, p], steepness)
                elif truth[p] >= 0 and pixels[e] & 1:
                    beside += _covered(total[1, p] + sign * optical[e], steepness) - _covered(total[1, p], steepness)
            if (hit + more) * union > hit * (union + beside):
                kept[g] = not kept[g]
                hit, union, flips = hit + more, union + beside, flips + 1
                for e in range(start[g], start[g + 1]):
                    total[0, pixels[e] >> 1] += sign * optical[e]
                    total[1, pixels[e] >> 1] += sign * optical[e] * (pixels[e] & 1)
        if not flips:
            return


@nb.njit(inline="always")
def _covered(optical: float, steepness: float) -> float:
    """1 where the accumulated alpha is above one half, softly."""
    # No alpha is below 1/255, so this is what rounding leaves of a pixel that nothing reaches.
    return 0.0 if optical < 1e-3 else 1 / (1 + np.exp(steepness * (np.log(2) - optical)))
