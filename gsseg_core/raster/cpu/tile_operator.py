"""The view operator on the CPU: numba kernels over 16 x 16 tiles."""

from __future__ import annotations

import copy

import numpy as np

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.label_evidence import LabelEvidence
from gsseg_core.raster.constants import CHANNELS
from gsseg_core.raster.cpu import products
from gsseg_core.raster.cpu.label_pairs import take
from gsseg_core.raster.cpu.lifted_mask import LiftedMask
from gsseg_core.raster.cpu.projection import project
from gsseg_core.raster.cpu.silhouette_kernels import silhouette_terms
from gsseg_core.raster.cpu.splat import HEIGHT, LOG_OPACITY, WIDTH
from gsseg_core.raster.cpu.tile_observation import TileObservation
from gsseg_core.raster.cpu.tiling import TILE, assign
from gsseg_core.raster.observation import Observation
from gsseg_core.raster.view_operator import Blended, SilhouetteTerms, ViewOperator, Weights
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene


class TileOperator(ViewOperator):
    """W of one view, remade tile by tile at every product and never stored.

    Holds only the projected Gaussians and their tiles, about 36 bytes per visible Gaussian and 12 per tile that it
    touches. Results are the same bit for bit whatever the number of threads and the order of the Gaussians, unless two
    of them have the very same geometry and different codes.
    """

    def __init__(self, scene: GaussianScene, camera: Camera) -> None:
        self.camera = camera
        self.num_gaussians = len(scene)
        projected = project(scene, camera)
        self.ids = projected.ids
        self._table = projected.table
        self._tiles = assign(projected, camera.width, camera.height)

    def footprints(self) -> np.ndarray:
        """Sum of the alphas of each of `ids` over an endless image, (M,)."""
        # |S| = var(x|y) S_yy, and the table has log2(e) / 2 over each of them.
        area = np.pi / np.log(2.0) / np.sqrt(self._table[:, WIDTH] * self._table[:, HEIGHT])
        areas: np.ndarray = np.exp2(self._table[:, LOG_OPACITY]) * area
        return areas

    def silhouette_terms(
        self,
        labels: np.ndarray,
        kept: np.ndarray,
        asked: np.ndarray,
        depths: np.ndarray,
        shown: np.ndarray,
        hidden_from: np.ndarray,
    ) -> SilhouetteTerms:
        """Weigh what speaks for each Gaussian in its object, and what against it, entry by entry."""
        tiles = self._tiles
        stay, go = np.zeros((2, len(tiles.entries)), np.float32)
        silhouette_terms(
            tiles.columns, self._table, tiles.start, tiles.entries, labels, int(labels.max(initial=0)) + 1,
            kept.astype(np.float32), asked, depths, shown, hidden_from, stay, go,
        )  # fmt: skip
        return SilhouetteTerms(*(np.bincount(tiles.entries, part, len(self.ids)) for part in (stay, go)))

    def _without(self, hidden: np.ndarray) -> TileOperator:
        other = copy.copy(self)
        other._table = self._table.copy()
        other._table[hidden, LOG_OPACITY] = -np.inf
        return other

    def _blend(self, codes: np.ndarray) -> Blended:
        visible = take(np.ascontiguousarray(codes, np.float32), self.ids)
        if codes.shape[1] <= products.FEW:
            blended, tiles = self._blank(codes.shape[1]), self._tiles
            products.render_few(tiles.columns, self._table, tiles.start, tiles.entries, visible, *blended)
            return blended
        # A Gaussian speaks for few classes; the others cost nothing.
        return self._blend_visible(CSRRows.from_dense(visible), codes.shape[1])

    def blend_rows(self, codes: CSRRows, num_classes: int) -> Blended:
        """Blend codes without their zeros."""
        return self._blend_visible(codes.take(self.ids), num_classes)

    def _blend_visible(self, codes: CSRRows, num_classes: int) -> Blended:
        blended, tiles = self._blank(num_classes), self._tiles
        products.render(tiles.columns, self._table, tiles.start, tiles.entries, *codes, *blended)
        return blended

    def _blank(self, channels: int) -> Blended:
        size = self.camera.height, self.camera.width
        return Blended(np.empty((*size, channels), np.float32), np.empty(size, np.float32))

    def _adjoint(self, residual: np.ndarray) -> np.ndarray:
        tiles = self._tiles
        out = np.zeros((self.num_gaussians, residual.shape[2]), np.float32)
        for k in range(0, residual.shape[2], CHANNELS):
            part = residual[..., k : k + CHANNELS].astype(np.float32, order="C")
            sums = np.empty((len(tiles.entries), part.shape[2]), np.float32)
            rows = np.empty((len(self.ids), part.shape[2]), np.float32)
            products.adjoint_entries(tiles.columns, self._table, tiles.start, tiles.entries, part, sums)
            products.reduce_entries(tiles.gaussian_start, tiles.gaussian_entries, sums, rows)
            out[self.ids, k : k + CHANNELS] = rows
        return out

    def _weights(self, pixel: tuple[int, int] | None) -> Weights:
        """List W, or only the row of W of one pixel."""
        tiles, camera = self._tiles, self.camera
        wanted: np.ndarray = np.arange(tiles.columns * tiles.rows)
        if pixel is not None:
            wanted = np.array([pixel[0] // TILE * tiles.columns + pixel[1] // TILE])
        image = (tiles.columns, camera.width, camera.height, self._table, tiles.start, tiles.entries, wanted)
        counts = np.zeros(len(wanted) + 1, np.int64)
        none = np.empty(0, np.int32)
        products.list_weights(*image, counts, none, none, np.empty(0, np.float32))
        start = np.cumsum(counts)
        pixels, rows = np.empty(start[-1], np.int32), np.empty(start[-1], np.int32)
        weights = np.empty(start[-1], np.float32)
        products.list_weights(*image, start, pixels, rows, weights)
        # Entries of a tile are sorted by depth; a stable sort by pixel keeps that order within each.
        order: np.ndarray = np.argsort(pixels, kind="stable")
        if pixel is not None:
            order = order[pixels[order] == pixel[0] * camera.width + pixel[1]]
        return Weights(pixels[order], self.ids[rows[order]], weights[order])

    def _observe(self, labels: np.ndarray) -> Observation:
        lifted = LiftedMask(self.camera, self._table, self._tiles, labels)
        return TileObservation(self.camera, self.ids, self._table, self._tiles, lifted)

    def _vote(
        self, labels: np.ndarray, evidence: LabelEvidence | None, total: np.ndarray, units: float, sign: int
    ) -> bool:
        lifted = LiftedMask(self.camera, self._table, self._tiles, labels)
        lifted.vote(self.ids, self._tiles, evidence or LabelEvidence(lifted.classes), total, units, sign)
        return lifted.sees


def view_operator(scene: GaussianScene, camera: Camera, device: str) -> TileOperator:
    """Make the operator of a view on the CPU, the only device of this name."""
    del device
    return TileOperator(scene, camera)
