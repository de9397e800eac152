"""The view operator on the CPU: numba kernels over 16 x 16 tiles."""

from __future__ import annotations

import numpy as np

from gsseg_core import products
from gsseg_core.cameras import Camera
from gsseg_core.errors import SceneValueError
from gsseg_core.operator import Blended, Observation, Shares, ViewOperator, Weights
from gsseg_core.projection import project
from gsseg_core.scene import GaussianScene
from gsseg_core.tiles import TILE, assign


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

    def _blend(self, codes: np.ndarray) -> Blended:
        codes = codes[self.ids].astype(np.float32, order="C")
        image = np.empty((self.camera.height, self.camera.width, codes.shape[1]), np.float32)
        left_over = np.empty(image.shape[:2], np.float32)
        tiles = self._tiles
        products.render(tiles.columns, self._table, tiles.start, tiles.entries, codes, image, left_over)
        return Blended(image, left_over)

    def _adjoint(self, residual: np.ndarray) -> np.ndarray:
        tiles = self._tiles
        out = np.zeros((self.num_gaussians, residual.shape[2]), np.float32)
        for k in range(0, residual.shape[2], products.CHUNK):
            part = residual[..., k : k + products.CHUNK].astype(np.float32, order="C")
            sums = np.empty((len(tiles.entries), part.shape[2]), np.float32)
            rows = np.empty((len(self.ids), part.shape[2]), np.float32)
            products.adjoint_entries(tiles.columns, self._table, tiles.start, tiles.entries, part, sums)
            products.reduce_entries(tiles.gaussian_start, tiles.gaussian_entries, sums, rows)
            out[self.ids, k : k + products.CHUNK] = rows
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
        return TileObservation(self, labels)


class TileObservation(Observation):
    """A view and its mask on the CPU."""

    def __init__(
        self,
        operator: TileOperator,
        labels: np.ndarray,  # (H, W)
    ) -> None:
        tiles = operator._tiles
        self.ids = operator.ids
        self._camera, self._table, self._tiles = operator.camera, operator._table, tiles
        self.classes = np.unique(labels[labels >= 0]).astype(np.int32)
        position = np.full(max(self.classes.max(initial=0) + 1, 1), -1, np.int32)
        position[self.classes] = np.arange(len(self.classes))
        local = np.where(labels >= 0, position[np.maximum(labels, 0)], -1).astype(np.int32)
        self._label_start, self._present, self._slots = products.tile_labels(
            local, tiles.columns, tiles.rows, len(self.classes)
        )
        self.num_pixels = int((labels >= 0).sum())
        entries = np.diff(tiles.start)
        self._slot_start = np.concatenate([[0], np.cumsum(entries * np.diff(self._label_start))])
        self._entry_tile = np.repeat(np.arange(len(entries), dtype=np.int32), entries)

    @property
    def nbytes(self) -> int:
        """Memory that it holds, in bytes, the operator's included."""
        tiles = self._tiles
        held = (self._table, self.ids, tiles.start, tiles.entries, tiles.gaussian_start, tiles.gaussian_entries,
                self._label_start, self._present, self._slots, self._slot_start, self._entry_tile)  # fmt: skip
        return sum(array.nbytes for array in held)

    def votes(self) -> np.ndarray:
        """Sum the weights by label: W^T onehot(y), (M, L) float32."""
        shape = (len(self.ids), len(self.classes))
        return self._share(np.empty(shape, np.float32), np.zeros(shape[1], np.float32), divide=False).gaussians

    def shares(
        self,
        codes: np.ndarray,  # (M, L)
        rest: np.ndarray,  # (L,)
    ) -> Shares:
        """Share one vote per labelled pixel among the Gaussians that made it."""
        codes, rest = np.ascontiguousarray(codes, np.float32), np.ascontiguousarray(rest, np.float32)
        expected = (len(self.ids), len(self.classes))
        if codes.shape != expected or rest.shape != expected[1:]:
            raise SceneValueError(
                f"view '{self._camera.name}': codes and rest have shapes {codes.shape} and {rest.shape}; "
                f"expected {expected} and {expected[1:]}"
            )
        return self._share(codes, rest, divide=True)

    def _share(
        self,
        codes: np.ndarray,  # (M, L)
        rest: np.ndarray,  # (L,)
        divide: bool,
    ) -> Shares:
        tiles = self._tiles
        logs, left_over = np.zeros(len(self._slots)), np.zeros(len(self._present))
        sums = np.empty(self._slot_start[-1], np.float32)
        out = np.empty(codes.shape, np.float32)
        products.labelled(
            tiles.columns, self._camera.width, self._camera.height, self._table, tiles.start, tiles.entries,
            self._label_start, self._present, self._slots, codes, rest, divide, self._slot_start,
            logs, left_over, sums,
        )  # fmt: skip
        products.reduce_labelled(
            tiles.start, tiles.gaussian_start, tiles.gaussian_entries, self._entry_tile,
            self._label_start, self._present, self._slot_start, sums, out,
        )  # fmt: skip
        total = np.bincount(self._present, weights=left_over, minlength=codes.shape[1])
        return Shares(out, total, float(logs.sum()))
