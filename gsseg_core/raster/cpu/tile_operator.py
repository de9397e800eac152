"""The view operator on the CPU: numba kernels over 16 x 16 tiles."""

from __future__ import annotations

import copy

import numpy as np

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.label_evidence import LabelEvidence
from gsseg_core.raster.constants import CHANNELS
from gsseg_core.raster.cpu import products
from gsseg_core.raster.cpu.entry_votes import add_entry_votes
from gsseg_core.raster.cpu.label_pairs import take
from gsseg_core.raster.cpu.lifting import Lifted
from gsseg_core.raster.cpu.projection import project
from gsseg_core.raster.cpu.silhouette_kernels import silhouette_terms
from gsseg_core.raster.cpu.splat import HEIGHT, LOG_OPACITY, WIDTH
from gsseg_core.raster.cpu.tile_observation import TileObservation
from gsseg_core.raster.cpu.tiling import TILE, assign
from gsseg_core.raster.observation import Observation
from gsseg_core.raster.view_operator import Blended, SilhouetteTerms, ViewOperator
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
        self._tiles = assign(projected, camera.width, camera.height)

    def footprints(self) -> np.ndarray:
        """Sum of the alphas of each of `ids` over an endless image, (M,)."""
        # |S| = var(x|y) S_yy, and the table has log2(e) / 2 over each of them.
        table = self._tiles.table
        area = np.pi / np.log(2.0) / np.sqrt(table[:, WIDTH] * table[:, HEIGHT])
        areas: np.ndarray = np.exp2(table[:, LOG_OPACITY]) * area
        return areas

    def silhouette_terms(
        self, labels: np.ndarray, kept: np.ndarray, asked: np.ndarray, depths: np.ndarray, shown: np.ndarray,
        hidden_from: np.ndarray,
    ) -> SilhouetteTerms:  # fmt: skip
        """Weigh what speaks for each Gaussian in its object, and what against it, entry by entry."""
        tiles, count = self._tiles, int(labels.max(initial=0)) + 1
        stay, go = np.zeros((2, len(tiles.entries)), np.float32)
        silhouette_terms(tiles, labels, count, kept.astype(np.float32), asked, depths, shown, hidden_from, stay, go)
        return SilhouetteTerms(*(np.bincount(tiles.entries, part, len(self.ids)) for part in (stay, go)))

    def _without(self, hidden: np.ndarray) -> TileOperator:
        other, table = copy.copy(self), self._tiles.table.copy()
        table[hidden, LOG_OPACITY] = -np.inf
        other._tiles = self._tiles._replace(table=table)
        return other

    def _blend(self, codes: np.ndarray) -> Blended:
        visible = take(np.ascontiguousarray(codes, np.float32), self.ids)
        if codes.shape[1] <= products.FEW:
            return Blended(*products.render_few(self._tiles, visible))
        # A Gaussian speaks for few classes; the others cost nothing.
        return Blended(*products.render(self._tiles, CSRRows.from_dense(visible), codes.shape[1]))

    def blend_rows(self, codes: CSRRows, num_classes: int) -> Blended:
        """Blend codes without their zeros."""
        return Blended(*products.render(self._tiles, codes.take(self.ids), num_classes))

    def _adjoint(self, residual: np.ndarray) -> np.ndarray:
        out = np.zeros((self.num_gaussians, residual.shape[2]), np.float32)
        for k in range(0, residual.shape[2], CHANNELS):
            part = residual[..., k : k + CHANNELS].astype(np.float32, order="C")
            out[self.ids, k : k + CHANNELS] = products.adjoint(self._tiles, part)
        return out

    def _weights(self, pixel: tuple[int, int] | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        tiles = self._tiles
        wanted: np.ndarray = np.arange(tiles.columns * tiles.rows)
        if pixel is not None:
            wanted = np.array([pixel[0] // TILE * tiles.columns + pixel[1] // TILE])
        counts, none = np.zeros(len(wanted) + 1, np.int64), np.empty(0, np.int32)
        products.list_weights(tiles, wanted, counts, none, none, np.empty(0, np.float32))
        start = np.cumsum(counts)
        pixels, rows = np.empty(start[-1], np.int32), np.empty(start[-1], np.int32)
        weights = np.empty(start[-1], np.float32)
        products.list_weights(tiles, wanted, start, pixels, rows, weights)
        if pixel is not None:
            here = pixels == pixel[0] * tiles.width + pixel[1]
            return pixels[here], rows[here], weights[here]
        return pixels, rows, weights

    def _observe(self, labels: np.ndarray) -> Observation:
        return TileObservation(self.camera.name, self.ids, self._tiles, Lifted.of(self._tiles, labels))

    def _vote(
        self, labels: np.ndarray, evidence: LabelEvidence | None, total: np.ndarray, units: float, sign: int
    ) -> bool:
        lifted = Lifted.of(self._tiles, labels)
        evidence = evidence or LabelEvidence(lifted.classes)
        add_entry_votes(total, self.ids, self._tiles, lifted, evidence, units, sign)
        return lifted.sees


def view_operator(scene: GaussianScene, camera: Camera, device: str) -> TileOperator:
    """Make the operator of a view on the CPU, the only device of this name."""
    del device
    return TileOperator(scene, camera)
