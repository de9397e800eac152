"""The view operator on the CPU, and a view with its mask: numba kernels over 16 x 16 tiles."""

from __future__ import annotations

import copy
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np

from gsseg_core.csr_rows import CSRRows, starts
from gsseg_core.data.label_evidence import LabelEvidence
from gsseg_core.raster.constants import CHANNELS, CHUNKS
from gsseg_core.raster.cpu import label_pairs, products
from gsseg_core.raster.cpu.entry_votes import pair_votes
from gsseg_core.raster.cpu.grid_blending import render_grid
from gsseg_core.raster.cpu.lifting import Lifted
from gsseg_core.raster.cpu.objects_alone import TileObjects
from gsseg_core.raster.cpu.projection import footprints, joined, project
from gsseg_core.raster.cpu.splat import LOG_OPACITY
from gsseg_core.raster.cpu.tiling import Tiles, assign
from gsseg_core.raster.objects_alone import ObjectsAlone
from gsseg_core.raster.observation import LabelWeights, Observation, VoteShares
from gsseg_core.raster.view_operator import ViewOperator
from gsseg_core.raster.view_renderer import NO_PIXELS, Blended, PixelGrid, Strongest
from gsseg_core.raster.vote_total import VoteTotal
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.spatial.row_order import take_rows

_ALL_WANTED = np.empty((0, 0), np.bool_)  # pixels that are wanted, where no image says which


class TileOperator(ViewOperator):
    """W of one view, remade tile by tile at every product and never stored.

    Holds only the projected Gaussians and their tiles, about 44 bytes per visible Gaussian and 8 per tile that it
    touches. Results are the same bit for bit whatever the number of threads and the order of the Gaussians, unless two
    of them have the very same geometry and different codes.
    """

    def __init__(self, camera: Camera, num_gaussians: int, ids: np.ndarray, tiles: Tiles) -> None:  # ids (M,)
        self.camera, self.num_gaussians, self.ids, self._tiles = camera, num_gaussians, ids, tiles

    def footprints(self) -> np.ndarray:
        """Sum of the alphas of each of `ids` over an endless image, (M,)."""
        return footprints(self._tiles.table)

    def _objects_alone(self, labels: np.ndarray) -> ObjectsAlone:
        return TileObjects.of(self.ids, self._tiles, labels)

    def _without(self, hidden: np.ndarray) -> TileOperator:
        other, table = copy.copy(self), self._tiles.table.copy()
        table[hidden, LOG_OPACITY] = -np.inf
        other._tiles = self._tiles._replace(table=table)
        return other

    def blend_seen(self, codes: np.ndarray, wanted: np.ndarray | None = None) -> Blended:
        """Blend codes (M, K) of what is visible."""
        self._check_rows(len(codes), self.ids, wanted)
        codes = np.ascontiguousarray(codes, np.float32)
        if codes.shape[1] <= products.FEW:
            return Blended(*products.render_few(self._tiles, codes, _ALL_WANTED if wanted is None else wanted))
        # A Gaussian speaks for few classes; the others cost nothing.
        rows = np.arange(len(codes), dtype=np.int32)
        return Blended(*products.render(self._tiles, CSRRows.from_dense(codes), rows, codes.shape[1]))

    def blend_grid(self, codes: np.ndarray, grid: PixelGrid) -> Blended:
        """Blend codes into the pixels of a grid, without the others where that is the faster way."""
        if grid.step == 1 or codes.shape[1] > products.FEW:
            return super().blend_grid(codes, grid)
        self._check_rows(len(codes), self.ids)
        return Blended(*render_grid(self._tiles, np.ascontiguousarray(codes, np.float32), *grid))

    def blend_rows(self, codes: CSRRows, num_classes: int) -> Blended:
        """Blend codes without their zeros."""
        return Blended(*products.render(self._tiles, codes, self._rows(codes, num_classes), num_classes))

    def strongest(
        self, codes: CSRRows, num_classes: int, background: bool, grid: PixelGrid = NO_PIXELS,
        of: np.ndarray | None = None, beside: np.ndarray | None = None, wanted: np.ndarray | None = None,
    ) -> Strongest:  # fmt: skip
        """Find the class of each pixel, tile by tile, without an image of all classes."""
        others = np.ascontiguousarray(np.empty((len(self.ids), 0)) if beside is None else beside, np.float32)
        self._check_rows(len(others), self.ids, wanted)
        classes, known, on_grid, image, left_over = products.strongest(
            self._tiles, codes, self._rows(codes, num_classes, of), num_classes, background, *grid, others,
            _ALL_WANTED if wanted is None else wanted,
        )  # fmt: skip
        return Strongest(classes, known, on_grid, None if beside is None else Blended(image, left_over))

    def _adjoint(self, residual: np.ndarray) -> np.ndarray:
        out = np.zeros((self.num_gaussians, residual.shape[2]), np.float32)
        for k in range(0, residual.shape[2], CHANNELS):
            part = residual[..., k : k + CHANNELS].astype(np.float32, order="C")
            out[self.ids, k : k + CHANNELS] = products.adjoint(self._tiles, part)
        return out

    def _weights(self, pixel: tuple[int, int] | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return products.list_weights(self._tiles, pixel)

    def _observe(self, labels: np.ndarray, weights: np.ndarray | None) -> Observation:
        return TileObservation(self.camera.name, self.ids, self._tiles, Lifted.of(self._tiles, labels, weights))

    def _lift(self, labels: np.ndarray) -> LabelWeights:
        lifted = Lifted.of(self._tiles, labels)
        *pairs, parts = pair_votes(self.ids, self._tiles, lifted)
        listed = (joined(values, parts[:, 0], parts[:, 1] - parts[:, 0]) for values in pairs)
        return LabelWeights.of(lifted.classes, *listed)

    def _vote(self, labels: np.ndarray, evidence: LabelEvidence | None, total: VoteTotal, sign: int) -> bool:
        lifted = Lifted.of(self._tiles, labels)
        evidence = evidence or LabelEvidence(lifted.classes)
        total.add(pair_votes(self.ids, self._tiles, lifted), evidence.votes, sign)
        return lifted.sees


def view_operator(scene: GaussianScene, camera: Camera, device: str) -> TileOperator:
    """Project a scene, and sort what can be seen into tiles; the CPU is the only device of its name."""
    del device
    projected = project(scene, camera)
    return TileOperator(camera, len(scene), projected.ids, assign(projected, camera.width, camera.height))


def vote_total(votes: VoteTotal, device: str) -> AbstractContextManager[VoteTotal]:
    """Give the votes themselves: observations add to them at once."""
    del device
    return nullcontext(votes)


class TileObservation(Observation):
    """W of one view, cut down to the Gaussians that its labelled pixels see; remade from them in every product.

    Holds 44 bytes per Gaussian that is seen and 16 per pair; 4 per tile in which the Gaussian is, and where a pixel
    there has a weight, 6 more and 4 for each label of the tile; and of the mask one or two per pixel.
    """

    def __init__(self, name: str, ids: np.ndarray, tiles: Tiles, lifted: Lifted) -> None:  # ids (M,)
        self.name, self.classes, self._mask = name, lifted.classes, lifted.labels
        self.areas, self.weighted_areas = lifted.areas[0].astype(np.int64), lifted.areas[1]
        label_count, self._records = np.diff(self._mask.start), lifted.records.copy()
        start, shared_start = starts(lifted.seen), starts(lifted.weighted)
        self._slot_start = starts(lifted.weighted * label_count)
        kept, shared, self._blocks = label_pairs.keep_entries(
            tiles.start, lifted.reached, start, shared_start, self._mask.weights
        )
        capacity = lifted.room_for_pairs(tiles)
        begins = (tiles.start, lifted.slot_start, shared_start, self._slot_start, self._mask.start)
        facts = np.stack([*(begin[:-1] for begin in begins), label_count], axis=1)
        entries, self._pair = np.empty(start[-1], np.int32), np.empty(self._slot_start[-1], np.int32)
        found, gaussians, label_counts, labels, votes = label_pairs.number_pairs(
            tiles, kept, facts, lifted.sums, self._mask.present, len(self.classes), capacity, entries, self._pair
        )
        before = np.cumsum(found, axis=0) - found
        chunks = np.arange(CHUNKS) * len(ids) // CHUNKS
        seen, counts = (joined(part, chunks, found[:, 0]) for part in (gaussians, label_counts))
        labels, votes = (joined(part, capacity[:-1], found[:, 1]) for part in (labels, votes))
        label_pairs.number_on(entries, before[:, 0])
        label_pairs.number_on(self._pair, before[:, 1])
        self.ids, self.start, self.labels, self._votes = ids[seen], starts(counts), labels, votes
        self._tiles = Tiles(*tiles[:5], take_rows(tiles.table, seen), start, entries)
        self._shared = self._tiles._replace(start=shared_start, entries=entries[shared])

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what `shares` was called with last."""
        return {**self.__dict__, "answered": None}

    @property
    def nbytes(self) -> int:
        """Memory that it holds, in bytes."""
        held = (self.ids, self.start, self.labels, self._votes, *self._tiles[5:],
                self._shared.start, self._shared.entries, self._blocks, self._records, self._slot_start, self._pair,
                *self._mask)  # fmt: skip
        # And what `shares` was called with last, and returned.
        return sum(array.nbytes for array in held) + 2 * self._votes.nbytes

    def operator(self, camera: Camera, num_gaussians: int) -> TileOperator:
        """Make an operator of the Gaussians that labelled pixels see."""
        return TileOperator(camera, num_gaussians, self.ids, self._tiles)

    def votes(self) -> np.ndarray:
        """Weights summed by pair, (P,) float32."""
        return self._votes

    def _shares(self, likelihood: np.ndarray, rest: np.ndarray) -> VoteShares:
        slots = self._slot_start, self._pair
        logs, left_over, sums = label_pairs.share(
            self._shared, self._mask, self._blocks, self._records, *slots, likelihood, rest
        )
        pairs = label_pairs.add_up(*slots, sums, len(likelihood)).sum(axis=0)
        total = np.bincount(self._mask.present, weights=left_over, minlength=len(rest))
        return VoteShares(pairs, total, float(logs.sum()))
