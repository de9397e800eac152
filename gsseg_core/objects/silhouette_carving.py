"""Cut each object to its silhouettes: drop the Gaussians that stick out of it when it stands alone.

In the scene, what is in front and beside hides a good part of a Gaussian across an edge. Cut out with its object, it
shows as a fringe, and so does what lay just under another surface. Which those are follows from the views alone. With
x the share of each Gaussian that its object keeps, object k standing alone covers pixel p by

    A_k(p) = 1 - T_k(p),    T_k(p) = prod over i in k of (1 - x_i alpha_i(p)),

which does not depend on who is in front, so all objects are made in one pass over a view. A_k should be 1 where the
view shows k, and 0 where it shows something else that does not hide it. Each Gaussian has reasons to stay, and to go,

    stay_i = sum over p that shows k of      alpha_i(p) T_k(p) / (1 - T_k(p))
    go_i   = sum over p that shows another of alpha_i(p),   unless i lies behind the surface of the scene there,

the two parts of the gradient of log A_k on its own pixels and log T_k on the others, with -log(1 - alpha) taken as
alpha. x_i <- min(1, x_i stay_i / go_i) is the multiplicative step of expectation maximisation for such sums (Shepp and
Vardi 1982). Where the object is covered by others anyway, T_k is small and there is little reason to stay; where a
Gaussian is all there is, it stays although it sticks out. One that never sticks out, or that no view reaches, stays.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numba as nb
import numpy as np

from gsseg_core.errors import MaskSizeError
from gsseg_core.objects.silhouettes import BEHIND, depths, surface
from gsseg_core.raster.backends import make_operator
from gsseg_core.raster.cpu.blending import in_block, open_rays, stride_of, tile_of_turn
from gsseg_core.raster.cpu.projection import project
from gsseg_core.raster.cpu.splat import WIDTH, aim, blend_block
from gsseg_core.raster.cpu.tiling import TILE, Tiles, assign
from gsseg_core.raster.view_operator import ViewOperator
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import REMOVED, Segmentation
from gsseg_core.simd import first_bit, store_row

STEPS = 5
"""Steps of the shares: the labels hardly change after these."""

KEPT = 0.5
"""Least share with which a Gaussian stays with its object."""

_LEAST = np.float32(0.01)  # of a share, so that a Gaussian may come back
_ROUNDING = np.float32(1e-3)  # of 1 - T, below which a pixel is as good as empty


@dataclass(frozen=True, eq=False)
class Silhouette:
    """What a view shows, to cut objects by.

    Attributes
    ----------
    camera : Camera
        Where from.
    labels : (H, W) int32
        Class of each pixel, negative where unknown.
    depth : (H, W) float32
        Depth of the scene's surface, scene units; infinite where there is none.
    """

    camera: Camera
    labels: np.ndarray
    depth: np.ndarray

    @classmethod
    def of(
        cls,
        scene: GaussianScene,
        operator: ViewOperator,
        labels: np.ndarray,  # (H, W) int32
    ) -> Silhouette:
        """Put a label map and the depth of the scene together.

        Raises
        ------
        MaskSizeError
            The labels are not of the camera's size.
        """
        camera = operator.camera
        if labels.shape != (camera.height, camera.width):
            raise MaskSizeError(
                f"view '{camera.name}': labels have shape {labels.shape}; expected ({camera.height}, {camera.width})"
            )
        return cls(camera, labels.astype(np.int32), surface(scene, operator).depth)


@dataclass(frozen=True, eq=False)
class Shares:
    """What `shares` returns.

    Attributes
    ----------
    kept : (N,) float64
        Share of each Gaussian that its object keeps, 0.01 to 1; 1 where it has no object or no view says anything.
    stay, go : (N,) float64
        Reasons for either at the last step, in px; both 0 where there is none to go.
    """

    kept: np.ndarray
    stay: np.ndarray
    go: np.ndarray


def shares(
    scene: GaussianScene,
    labels: np.ndarray,  # (N,) int
    silhouettes: Iterable[Silhouette],
    steps: int = STEPS,
) -> Shares:
    """Find how much of each Gaussian its object should keep.

    Parameters
    ----------
    scene : GaussianScene
        N Gaussians.
    labels : (N,) int32
        Class of each; those of class 0 and below belong to no object and are not looked at.
    silhouettes : iterable of Silhouette
        Views.
    steps : int
        How often to go through them, at least 1.

    Returns
    -------
    Shares
    """
    labels = np.ascontiguousarray(labels, np.int32)
    views = [_View.of(scene, silhouette) for silhouette in silhouettes]
    kept = np.ones(len(scene))
    stay, go, asked = np.zeros(len(scene)), np.zeros(len(scene)), labels > 0
    for _ in range(steps):
        stay, go = np.zeros(len(scene)), np.zeros(len(scene))
        for view in views:
            view.add_reasons(labels, kept, asked, stay, go)
        # Reasons to go do not depend on the shares: who has none is not asked again.
        asked = go > 0
        kept = np.where(asked, np.clip(kept * stay / np.maximum(go, 1e-30), _LEAST, 1.0), kept)
    return Shares(kept, np.where(asked, stay, 0), go)


def carved(
    scene: GaussianScene, segmentation: Segmentation, cameras: Iterable[Camera], device: str = "cpu"
) -> Segmentation:
    """Take out of each object what sticks out of its silhouettes in some views; these Gaussians become `REMOVED`.

    What the views show are the label maps that the segmentation itself renders, not the masks: they are learnt from all
    masks together, so that errors of single masks carve nothing away.
    """
    silhouettes = []
    for camera in cameras:
        operator = make_operator(scene, camera, device)
        silhouettes.append(Silhouette.of(scene, operator, segmentation.render(operator).labels))
    out = carve(scene, segmentation.labels, silhouettes)
    return replace(segmentation, labels=np.where(out, np.int32(REMOVED), segmentation.labels))


def carve(
    scene: GaussianScene,
    labels: np.ndarray,  # (N,) int
    silhouettes: Iterable[Silhouette],
    steps: int = STEPS,
) -> np.ndarray:
    """Find the Gaussians that stick out of their objects, (N,) bool.

    Parameters are those of `shares`. Results do not depend on the order of the Gaussians, nor on the number of threads.
    """
    out: np.ndarray = shares(scene, labels, silhouettes, steps).kept < KEPT
    return out


@dataclass(frozen=True, eq=False)
class _View:
    """A silhouette, and the scene projected and sorted for it: about 60 bytes for each Gaussian in sight."""

    silhouette: Silhouette
    ids: np.ndarray
    table: np.ndarray
    tiles: Tiles
    depths: np.ndarray

    @classmethod
    def of(cls, scene: GaussianScene, silhouette: Silhouette) -> _View:
        camera = silhouette.camera
        projected = project(scene, camera)
        tiles = assign(projected, camera.width, camera.height)
        return cls(silhouette, projected.ids, projected.table, tiles, depths(scene, camera)[projected.ids])

    def add_reasons(
        self,
        labels: np.ndarray,  # (N,) int32
        kept: np.ndarray,  # (N,)
        asked: np.ndarray,  # (N,) bool, whose reasons are wanted
        stay: np.ndarray,  # (N,) added to
        go: np.ndarray,  # (N,) added to
    ) -> None:
        tiles = self.tiles
        per_entry = np.zeros((2, len(tiles.entries)), np.float32)
        mine = labels[self.ids]
        _add_reasons(
            tiles.columns, self.table, tiles.start, tiles.entries, mine, int(mine.max(initial=0)) + 1,
            kept[self.ids].astype(np.float32), asked[self.ids], self.depths, self.silhouette.labels,
            self.silhouette.depth * np.float32(BEHIND), *per_entry,
        )  # fmt: skip
        for total, part in zip((stay, go), per_entry, strict=True):
            total[self.ids] += np.bincount(tiles.entries, weights=part, minlength=len(self.ids))


@nb.njit(parallel=True, nogil=True, cache=True, error_model="numpy", fastmath={"contract", "reassoc", "nnan", "nsz"})
def _add_reasons(
    columns: int,
    table: np.ndarray,  # (M, 8)
    start: np.ndarray,  # (T + 1,)
    entries: np.ndarray,  # (E,)
    labels: np.ndarray,  # (M,)
    num_labels: int,
    kept: np.ndarray,  # (M,)
    asked: np.ndarray,  # (M,) bool
    depths: np.ndarray,  # (M,)
    shown: np.ndarray,  # (H, W)
    hidden_from: np.ndarray,  # (H, W)
    stay: np.ndarray,  # (E,) out
    go: np.ndarray,  # (E,) out
) -> None:
    height, width = shown.shape
    rows = (start.shape[0] - 1) // columns
    stride = stride_of(rows)
    for turn in nb.prange(rows * columns):
        tile = tile_of_turn(turn, columns, rows, stride)
        # Only labels of those who are asked matter here.
        slots, many = np.full(num_labels, -1, np.int64), 0
        for e in range(start[tile], start[tile + 1]):
            label = labels[entries[e]]
            if asked[entries[e]] and slots[label] < 0:
                slots[label] = many
                many += 1
        if not many:
            continue
        fresh, lines = np.empty((TILE, TILE), np.float32), np.empty((2, TILE), np.float32)
        left, top, inside = open_rays(tile, columns, width, height, fresh)
        limit = _cut(hidden_from, tile, columns)
        through = np.ones((many, TILE, TILE), np.float32)  # T_k
        alpha = np.empty((1, TILE), np.float32)
        for e in range(start[tile], start[tile + 1]):
            g = entries[e]
            if labels[g] > 0 and slots[labels[g]] >= 0:
                reached, mine = aim(table, g, left, top, lines) & inside, through[slots[labels[g]]]
                while reached:
                    b = first_bit(reached)
                    reached &= reached - 1
                    _alphas(lines, b, table[g, WIDTH], fresh, alpha)
                    for i in range(TILE):
                        mine[b, i] *= np.float32(1) - kept[g] * alpha[0, i]
        need, excess = np.zeros_like(through), np.zeros_like(through)
        for label in range(1, num_labels):
            if slots[label] >= 0:
                _weigh(shown, label, tile, columns, through[slots[label]], need[slots[label]], excess[slots[label]])
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
def _cut(
    image: np.ndarray,  # (H, W)
    tile: int,
    columns: int,
) -> np.ndarray:
    """One tile of an image, by block, (16, 16) float32; 0 outside of it."""
    out = np.zeros((TILE, TILE), np.float32)
    left, top = (tile % columns) * TILE, (tile // columns) * TILE
    for r in range(min(TILE, image.shape[0] - top)):
        for c in range(min(TILE, image.shape[1] - left)):
            out[in_block(r, c)] = image[top + r, left + c]
    return out


@nb.njit(inline="always")
def _alphas(
    lines: np.ndarray,  # (2, 16) from `aim`
    b: int,
    wide: float,
    fresh: np.ndarray,  # (16, 16) scratch
    alpha: np.ndarray,  # (1, 16) out
) -> None:
    """Alpha of a Gaussian in block b: `blend_block` makes it of rays that nothing has met yet."""
    fresh[b, :] = 1
    weight, _ = blend_block(fresh, b, lines, wide)
    store_row(alpha, 0, weight)


@nb.njit(fastmath={"contract", "nnan", "nsz"}, error_model="numpy")
def _weigh(
    shown: np.ndarray,  # (H, W)
    label: int,
    tile: int,
    columns: int,
    through: np.ndarray,  # (16, 16) T_k
    need: np.ndarray,  # (16, 16) out: T_k / (1 - T_k) where the label is shown
    excess: np.ndarray,  # (16, 16) out: 1 where another one is
) -> None:
    left, top = (tile % columns) * TILE, (tile // columns) * TILE
    for r in range(min(TILE, shown.shape[0] - top)):
        for c in range(min(TILE, shown.shape[1] - left)):
            b, i = in_block(r, c)
            if shown[top + r, left + c] == label:
                need[b, i] = through[b, i] / (np.float32(1) - through[b, i] + _ROUNDING)
            elif shown[top + r, left + c] >= 0:
                excess[b, i] = 1
