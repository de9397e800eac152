"""A posed view as a linear operator: render and adjoint, whatever makes them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import cached_property
from typing import NamedTuple

import numpy as np

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.label_evidence import LabelEvidence
from gsseg_core.errors import MaskSizeError, SceneValueError, SettingsError
from gsseg_core.raster.cpu.label_pairs import add_votes
from gsseg_core.raster.devices import checked_device
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene


class Weights(NamedTuple):
    """The non-zero entries of W, by pixel and nearest Gaussian first.

    Attributes
    ----------
    pixels : (P,) int32
        Pixel index, row * width + column.
    gaussians : (P,) int32
        Index in the scene.
    weights : (P,) float32
        alpha times the transmittance in front, in (0, 0.99].
    """

    pixels: np.ndarray
    gaussians: np.ndarray
    weights: np.ndarray


class Blended(NamedTuple):
    """A view of the scene.

    Attributes
    ----------
    image : (H, W, K) float32
        Codes, blended: W q.
    transmittance : (H, W) float32
        What is left of each ray after the last Gaussian, in [0, 1].
    """

    image: np.ndarray
    transmittance: np.ndarray


class Shares(NamedTuple):
    """What the labelled pixels of a view say of the Gaussians that made them.

    Attributes
    ----------
    sightings : (P,) float32
        For each, the sum over the pixels of its label of w[p, i] / likelihood[p].
    rest : (L,) float64
        The same for what the rays had left over, T_end[p] / likelihood[p].
    log_likelihood : float
        Sum over the labelled pixels of log likelihood[p], natural.
    """

    sightings: np.ndarray
    rest: np.ndarray
    log_likelihood: float


class Observation(ABC):
    """A view with its mask: W cut down, in each pixel, to the label that was seen there.

    A *sighting* is a Gaussian with one of the labels under which this view sees it, that is with a weight above zero in
    some pixel of that label. Most Gaussians are seen under one label only, so there are about as many sightings as
    Gaussians that are seen, however many labels the mask has. Votes, the paper's loss and its gradient, and every step
    of EM need one number per sighting.

    Attributes
    ----------
    ids : (M,) int32
        Gaussians that some labelled pixel sees, as indices in the scene.
    start : (M + 1,) int64
        Sightings of ids[m] are start[m] to start[m + 1].
    labels : (P,) int32
        Label of each sighting, as its position in `classes`.
    classes : (L,) int32
        Labels that occur in the mask, ascending.
    areas : (L,) int64
        Pixels of each label.
    evidence : LabelEvidence
        What the labels say of the classes; of a plain mask, that they are classes.
    """

    ids: np.ndarray
    start: np.ndarray
    labels: np.ndarray
    classes: np.ndarray
    areas: np.ndarray

    @property
    @abstractmethod
    def nbytes(self) -> int:
        """Memory that it holds, in bytes."""

    @property
    def num_pixels(self) -> int:
        """Pixels with a label."""
        return int(self.areas.sum())

    @cached_property
    def evidence(self) -> LabelEvidence:
        """What the labels say of the classes."""
        return LabelEvidence(self.classes)

    @cached_property
    def order(self) -> np.ndarray:
        """Places in `ids` in the order of the scene, (M,) int32: whoever goes by it goes through memory once."""
        place = np.full(int(self.ids.max(initial=-1)) + 1, -1, np.int32)
        place[self.ids] = np.arange(len(self.ids), dtype=np.int32)
        return place[place >= 0]

    @property
    def rows(self) -> np.ndarray:
        """Which of `ids` each sighting is of, (P,) int64."""
        return np.repeat(np.arange(len(self.ids)), np.diff(self.start))

    def dense(
        self,
        values: np.ndarray,  # (P,)
    ) -> np.ndarray:
        """Write one number per sighting out by Gaussian and label, (M, L); zero where there is no sighting."""
        out = np.zeros((len(self.ids), len(self.classes)), values.dtype)
        out[self.rows, self.labels] = values
        return out

    @abstractmethod
    def votes(self) -> np.ndarray:
        """Sum of weights of each sighting, the entries of W^T onehot(y) that are not zero: (P,) float32, in px."""

    def vote(
        self,
        total: np.ndarray,  # (N, K) int64, added to
        units: float,
        sign: int = 1,
    ) -> None:
        """Add the votes to those of other views, or take them away, in whole units."""
        add_votes(total, self.ids, self.start, self.labels, *self.evidence.votes, self.votes(), units, sign)

    @abstractmethod
    def shares(
        self,
        said: np.ndarray,  # (P,)
        rest: np.ndarray,  # (L,)
    ) -> Shares:
        """Share one vote per labelled pixel among the Gaussians that made it.

        With likelihood[p] = (W said)[p, y_p] + T_end[p] rest[y_p], the share of a sighting is the sum over the pixels
        of its label of w[p, i] / likelihood[p]. It is the gradient of the log likelihood with respect to what was said.

        Parameters
        ----------
        said : (P,) float32
            What each Gaussian says of the label under which it is seen, at least 0.
        rest : (L,) float32
            What the background says of each label.

        Raises
        ------
        SceneValueError
            They are not of these shapes.
        """


class ViewOperator(ABC):
    """The weight matrix W (pixels x Gaussians) of one view of one scene, and its transpose.

    w[p, i] = alpha_i(p) * prod over nearer j of (1 - alpha_j(p)), as 3DGS blends colours (Kerbl et al. 2023, eq. 3).
    A row of W sums to 1 minus the ray's final transmittance.

    Attributes
    ----------
    camera : Camera
        Where from.
    num_gaussians : int
        N, the size of the scene.
    ids : (M,) int32
        Gaussians that can reach the image, nearest first. All others have a column of zeros.
    """

    camera: Camera
    num_gaussians: int
    ids: np.ndarray

    def render(
        self,
        codes: np.ndarray,  # (N, K)
    ) -> np.ndarray:
        """Blend codes into the view: W q.

        Parameters
        ----------
        codes : (N, K)
            Anything that a Gaussian carries: class probabilities, colours, depths.

        Returns
        -------
        (H, W, K) float32

        Raises
        ------
        SceneValueError
            There is not one row of codes per Gaussian.
        """
        return self.blend(codes).image

    def blend(
        self,
        codes: np.ndarray,  # (N, K)
    ) -> Blended:
        """Render codes, and return what is left of each ray, in one pass.

        Raises
        ------
        SceneValueError
            There is not one row of codes per Gaussian.
        """
        codes = np.asarray(codes)
        if codes.ndim != 2 or len(codes) != self.num_gaussians:
            raise SceneValueError(f"codes have shape {codes.shape}; expected ({self.num_gaussians}, K)")
        return self._blend(codes)

    def blend_rows(self, codes: CSRRows, num_classes: int) -> Blended:
        """Do the same for codes (N, K) of which only the entries that are not zero are at hand."""
        return self._blend(codes.dense(num_classes))

    def adjoint(
        self,
        residual: np.ndarray,  # (H, W, K)
    ) -> np.ndarray:
        """Carry values of pixels back to the Gaussians that made them: W^T r.

        Parameters
        ----------
        residual : (H, W, K)
            Anything that a pixel carries: one-hot labels, the gradient of a loss.

        Returns
        -------
        (N, K) float32

        Raises
        ------
        MaskSizeError
            The residual is not of the camera's size.
        """
        residual = np.asarray(residual)
        self._check_size(residual, 3)
        return self._adjoint(residual)

    def observe(
        self,
        labels: np.ndarray,  # (H, W) int32, negative = unknown
        evidence: LabelEvidence | None = None,
    ) -> Observation:
        """Tie the view to its mask.

        Parameters
        ----------
        labels : (H, W) int32
            Classes, negative where nothing is known; or prototypes 0 to L - 1, each of which occurs.
        evidence : LabelEvidence, optional
            What prototypes mean.

        Raises
        ------
        MaskSizeError
            The labels are not of the camera's size.
        """
        self._check_size(labels, 2)
        observation = self._observe(labels)
        if evidence is not None:
            observation.evidence = evidence
        return observation

    def vote(
        self,
        labels: np.ndarray,  # (H, W) int32
        evidence: LabelEvidence | None,
        total: np.ndarray,  # (N, K) int64, added to
        units: float,
        sign: int = 1,
    ) -> bool:
        """Add the view's votes to those of others, W^T onehot(y): what `observe` would say, with nothing kept of it.

        Parameters
        ----------
        labels, evidence
            The mask, as for `observe`.
        total : (N, K) int64
            Votes in units, of K classes, among them all that the mask speaks of.
        units : float
            Units per px of weight; a power of 2.
        sign : int
            1 to add, -1 to take back; what was added is taken back exactly.

        Returns
        -------
        bool
            Whether a labelled pixel sees any Gaussian.

        Raises
        ------
        MaskSizeError
            The labels are not of the camera's size.
        """
        self._check_size(labels, 2)
        return self._vote(labels, evidence, total, units, sign)

    def without(
        self,
        hidden: np.ndarray,  # (N,) bool
    ) -> ViewOperator:
        """Make the same view of the scene without some of its Gaussians; indices stay, and nothing is projected again.

        Raises
        ------
        SceneValueError
            There is not one entry per Gaussian.
        """
        if hidden.shape != (self.num_gaussians,):
            raise SceneValueError(f"hidden has shape {hidden.shape}; expected ({self.num_gaussians},)")
        return self._without(hidden[self.ids])

    def visibility(self) -> np.ndarray:
        """Sum of each Gaussian's weights over the image: W^T 1, (N,) float32, in px."""
        return self.adjoint(np.ones((self.camera.height, self.camera.width, 1), np.float32))[:, 0]

    def transmittance(self) -> np.ndarray:
        """Return what is left of each ray after the last Gaussian, (H, W) float32 in [0, 1]."""
        return self._blend(np.empty((self.num_gaussians, 0), np.float32)).transmittance

    def weights(self, row: int | None = None, column: int | None = None) -> Weights:
        """List W, or only the row of W of one pixel: which Gaussians made it, and how much.

        Parameters
        ----------
        row, column : int, optional
            The pixel. Without them, every pixel of the image.

        Raises
        ------
        SettingsError
            The pixel is not in the image, or only one of its coordinates is given.
        """
        if row is None and column is None:
            return self._weights(None)
        height, width = self.camera.height, self.camera.width
        if row is None or column is None or not (0 <= row < height and 0 <= column < width):
            raise SettingsError(
                f"view '{self.camera.name}': pixel is (row {row}, column {column}); "
                f"expected a row from 0 to {height - 1} and a column from 0 to {width - 1}"
            )
        return self._weights((row, column))

    @abstractmethod
    def _without(
        self,
        hidden: np.ndarray,  # (M,) bool
    ) -> ViewOperator: ...

    @abstractmethod
    def _blend(self, codes: np.ndarray) -> Blended: ...

    @abstractmethod
    def _adjoint(self, residual: np.ndarray) -> np.ndarray: ...

    @abstractmethod
    def _weights(self, pixel: tuple[int, int] | None) -> Weights: ...

    @abstractmethod
    def _observe(self, labels: np.ndarray) -> Observation: ...

    def _vote(
        self, labels: np.ndarray, evidence: LabelEvidence | None, total: np.ndarray, units: float, sign: int
    ) -> bool:
        observation = self.observe(labels, evidence)
        observation.vote(total, units, sign)
        return len(observation.ids) > 0

    def _check_size(self, image: np.ndarray, dimensions: int) -> None:
        height, width = self.camera.height, self.camera.width
        if image.ndim != dimensions or image.shape[:2] != (height, width):
            expected = f"({height}, {width}{', K' if dimensions == 3 else ''})"
            raise MaskSizeError(f"view '{self.camera.name}': image has shape {image.shape}; expected {expected}")


def make_operator(scene: GaussianScene, camera: Camera, device: str = "cpu") -> ViewOperator:
    """Make the operator of a view on a device.

    Parameters
    ----------
    scene : GaussianScene
        What is seen.
    camera : Camera
        Where from.
    device : str
        'cpu'; 'cuda', the first GPU; or 'cuda:1' and so on, another one. See docs/gpu.md.

    Raises
    ------
    SettingsError
        There is no such device, or what it needs is not installed.
    """
    if checked_device(device) == "cpu":
        from gsseg_core.raster.cpu.tile_operator import TileOperator

        return TileOperator(scene, camera)
    try:
        from gsseg_core.raster.gsplat_backend import GsplatOperator, load_gsplat
    except ModuleNotFoundError as missing:
        if missing.name != "torch":
            raise
        raise SettingsError(
            f"device is {device!r}, and PyTorch is missing; expected a CUDA build of it and gsplat: "
            "pip install 'gsseg[gsplat]'"
        ) from missing
    return GsplatOperator(scene, camera, device, load_gsplat(device))
