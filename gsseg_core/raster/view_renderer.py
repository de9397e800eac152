"""Render a posed view: blend what its Gaussians carry, such as class probabilities or colours."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sized
from typing import Any, NamedTuple, TypeVar

import numpy as np

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.errors import SceneValueError
from gsseg_core.scene.camera import Camera

Image = TypeVar("Image", bound=Any)  # (H, W, ...), of NumPy or PyTorch


class Blended(NamedTuple):
    """A view of the scene."""

    image: np.ndarray  # (H, W, K) float32: codes, blended, W q
    transmittance: np.ndarray  # (H, W) float32: what is left of each ray after the last Gaussian, in [0, 1]


class PixelGrid(NamedTuple):
    """A regular grid of the pixels of a view: every `step`-th row and column, from the `first` on."""

    first: int
    step: int

    def of(self, image: Image) -> Image:  # (H, W, ...)
        """Take these pixels of an image."""
        return image[self.first :: self.step, self.first :: self.step]


EVERY_PIXEL = PixelGrid(0, 1)
NO_PIXELS = PixelGrid(1 << 30, 1 << 30)  # of which no image has one


class Strongest(NamedTuple):
    """The class that a view shows most of in each pixel."""

    classes: np.ndarray  # (H, W) int32: the column of the largest blended probability
    known: np.ndarray  # (H, W) bool: whether more than half of the pixel is, by the sum of its probabilities
    on_grid: np.ndarray  # (R, C, K) float32: all probabilities of the pixels of a grid
    beside: Blended | None = None  # what else was blended, if anything

    @classmethod
    def of(cls, image: np.ndarray, grid: PixelGrid) -> Strongest:
        """Find the strongest class of each pixel of an image of probabilities, (H, W, K)."""
        return cls(image.argmax(axis=2).astype(np.int32), image.sum(axis=2) > 0.5, grid.of(image))

    def labels(self) -> np.ndarray:
        """Class of each pixel of which more than half is known, (H, W) int32; `UNKNOWN` elsewhere."""
        return np.where(self.known, self.classes, np.int32(UNKNOWN))


class ViewRenderer(ABC):
    """A view of one scene that blends what its Gaussians carry.

    Attributes
    ----------
    camera : Camera
        Where from.
    num_gaussians : int
        N, the size of the scene.
    ids : (M,) int32
        Gaussians that can reach the image, in the order in which `blend_seen` takes their codes.
    """

    camera: Camera
    num_gaussians: int
    ids: np.ndarray

    def render(self, codes: np.ndarray) -> np.ndarray:
        """Blend anything that Gaussians carry, such as class probabilities, colours or depths, into the view: W q.

        Parameters
        ----------
        codes : (N, K)
            One row per Gaussian.

        Returns
        -------
        (H, W, K) float32

        Raises
        ------
        SceneValueError
            There is not one row of codes per Gaussian.
        """
        return self.blend(codes).image

    def blend(self, codes: np.ndarray) -> Blended:
        """Render codes (N, K) as `render` does, and tell what is left of each ray."""
        codes = np.asarray(codes)
        if codes.ndim != 2 or len(codes) != self.num_gaussians:
            raise SceneValueError(f"codes have shape {codes.shape}; expected ({self.num_gaussians}, K)")
        return self.blend_seen(codes.take(self.ids, axis=0))

    @abstractmethod
    def blend_seen(self, codes: np.ndarray, wanted: np.ndarray | None = None) -> Blended:
        """Blend codes (M, K) of `ids` alone; raises as `render` does.

        If only some pixels are `wanted`, (H, W) bool, others may have any value.
        """

    def blend_grid(self, codes: np.ndarray, grid: PixelGrid) -> Blended:
        """Blend codes (M, K) of `ids` alone into the pixels of a grid, (R, C, K) and (R, C); raises as `render`."""
        return Blended(*map(grid.of, self.blend_seen(codes)))

    @abstractmethod
    def blend_rows(self, codes: CSRRows, num_classes: int) -> Blended:
        """Blend sparse codes, (N, K); raises as `render` does."""

    def blend_probabilities(self, codes: CSRRows, num_classes: int, background: bool) -> np.ndarray:
        """Blend class probabilities, sparse, (N, K): (H, W, K) float32.

        What a ray has left over is `background`, class 0, or else nothing, so that a pixel sums to what is known of it.
        """
        image, left_over = self.blend_rows(codes, num_classes)
        if background:
            image[..., 0] += left_over
        return image

    @abstractmethod
    def strongest(
        self, codes: CSRRows, num_classes: int, background: bool, grid: PixelGrid = NO_PIXELS,
        of: np.ndarray | None = None, beside: np.ndarray | None = None, wanted: np.ndarray | None = None,
    ) -> Strongest:  # fmt: skip
        """Find the class of each pixel: that of the largest of `blend_probabilities`.

        Where codes are of some Gaussians alone, (R, K), `of` says of which, (R,) distinct: all of `ids` are among them.
        Codes `beside` these, (M, C) of `ids`, as colours, are blended in the same pass, as `blend_seen` does. If only
        some pixels are `wanted`, (H, W) bool, others may have any value.
        """

    def _rows(self, codes: CSRRows, num_classes: int, of: np.ndarray | None = None) -> np.ndarray:
        """Check sparse codes, and tell which of their rows each of `ids` has, (M,) int32."""
        self._check_rows(len(codes.indptr) - 1, of)
        self._check_classes(codes.indices, num_classes)
        if of is None:
            return self.ids
        place = np.full(self.num_gaussians, -1, np.int32)
        place[of] = np.arange(len(of), dtype=np.int32)
        return self._all_there(place[self.ids])

    def _check_classes(self, indices: Any, num_classes: int) -> None:  # (Z,) of NumPy or PyTorch
        """Refuse sparse codes of too many classes."""
        if len(indices) and (most := int(indices.max())) >= num_classes:
            raise SceneValueError(f"view {self.camera.name!r}: codes are of class {most}; expected below {num_classes}")

    def _all_there(self, rows: Any) -> Any:  # (M,) of NumPy or PyTorch
        """Return the rows of codes that `ids` have; refuse codes of which some have none, -1."""
        if len(rows) and int(rows.min()) < 0:
            raise SceneValueError(f"view {self.camera.name!r}: a Gaussian that it shows has no codes; expected all")
        return rows

    def _check_rows(
        self, count: int, of: Sized | None = None, wanted: np.ndarray | None = None, what: str = "codes"
    ) -> None:  # fmt: skip
        """Refuse codes, or votes, that are not of all Gaussians, or those of some; and `wanted` of another size."""
        if wanted is not None:
            self.camera.check_image(wanted, "wanted pixels have")
        expected = self.num_gaussians if of is None else len(of)
        if count != expected:
            raise SceneValueError(f"view {self.camera.name!r}: {what} are of {count} Gaussians; expected {expected}")
