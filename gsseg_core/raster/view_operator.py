"""A posed view as a linear operator: render and adjoint, whatever makes them."""

from __future__ import annotations

from abc import abstractmethod
from typing import NamedTuple

import numpy as np

from gsseg_core.data.label_evidence import LabelEvidence
from gsseg_core.errors import MaskFormatError, SceneValueError
from gsseg_core.files.limits import MAX_LABEL
from gsseg_core.raster.constants import BLOCK
from gsseg_core.raster.objects_alone import ObjectsAlone
from gsseg_core.raster.observation import LabelWeights, Observation, check_total
from gsseg_core.raster.view_renderer import ViewRenderer
from gsseg_core.raster.vote_total import VoteTotal
from gsseg_core.scene.gaussian_scene import GaussianScene


class Weights(NamedTuple):
    """The non-zero entries of W, by pixel and nearest Gaussian first."""

    pixels: np.ndarray  # (P,) int32: row * width + column
    gaussians: np.ndarray  # (P,) int32: index in the scene
    weights: np.ndarray  # (P,) float32: alpha times the transmittance in front, in (0, 0.99]


class ViewOperator(ViewRenderer):
    """The weight matrix W (pixels x Gaussians) of one view of one scene, and its transpose.

    w[p, i] = alpha_i(p) * prod over nearer j of (1 - alpha_j(p)), as 3DGS blends colours (Kerbl et al. 2023, eq. 3).
    A row of W sums to 1 minus the ray's final transmittance.

    Its `ids` come in an order of its own; all other Gaussians have a column of zeros.

    Attributes
    ----------
    scene : GaussianScene
        The scene that is seen.
    """

    scene: GaussianScene

    def adjoint(self, residual: np.ndarray) -> np.ndarray:
        """Carry anything that a pixel carries, as labels or a loss's gradient, back to the Gaussians: W^T r.

        Parameters
        ----------
        residual : (H, W, K)
            Values of the pixels.

        Returns
        -------
        (N, K) float32

        Raises
        ------
        MaskSizeError
            The residual is not of the camera's size.
        """
        residual = np.asarray(residual)
        self.camera.check_image(residual, "image has", channels=True)
        return self._adjoint(residual)

    def observe(
        self, labels: np.ndarray, evidence: LabelEvidence | None = None, weights: np.ndarray | None = None
    ) -> Observation:
        """Tie the view to its mask; rays end at surfaces then (`T_LIFTED` in `gsseg_core.raster.constants`).

        Parameters
        ----------
        labels : (H, W) int32
            Classes, negative where nothing is known; or prototypes 0 to L - 1, each of which occurs.
        evidence : LabelEvidence, optional
            What prototypes mean.
        weights : (ceil(H / 4), ceil(W / 4)) float32, optional
            By how much the pixels of each block of 4 x 4 count in `Observation.shares`, 1 by default; those of 0 are
            not gone through. In `votes` each counts once.

        Raises
        ------
        MaskFormatError
            The labels are not whole numbers that 32 bits hold, or larger than `MAX_LABEL`, or than there is evidence
            for.
        MaskSizeError
            The labels are not of the camera's size.
        SceneValueError
            The weights are of another shape, or not finite, or below 0.
        """
        self._check_labels(labels, evidence)
        if weights is not None:
            self._check_weights(weights)
        observation = self._observe(labels, weights)
        if evidence is not None:
            observation.evidence = evidence
        return observation

    def lift(self, labels: np.ndarray) -> LabelWeights:
        """Sum each Gaussian's weights by the labels, as for `observe`, of the pixels that it made: W^T onehot(labels).

        These are the votes of what `observe` returns, for less time where nothing else is asked of a view. Raises as
        that does.
        """
        self._check_labels(labels, None)
        return self._lift(labels)

    def vote(self, labels: np.ndarray, evidence: LabelEvidence | None, total: VoteTotal, *, sign: int = 1) -> bool:
        """Add the votes of a mask to those of other views, as `Observation.vote` does, and keep nothing of the view.

        Parameters
        ----------
        labels, evidence
            The mask, as for `observe`, which also says what is raised.
        total : VoteTotal
            Votes of N Gaussians for K classes, among them all that the mask speaks of; added to.
        sign : int
            1 to add, -1 to take back; what was added is taken back exactly.

        Returns
        -------
        bool
            Whether a labelled pixel sees any Gaussian.

        Raises
        ------
        SceneValueError
            The total is of another number of Gaussians, has too few classes, or is something else.
        """
        self._check_labels(labels, evidence)
        most = int((labels if evidence is None else evidence.votes.indices).max(initial=0))
        if isinstance(total, VoteTotal):
            self._check_rows(total.shape[0], what="votes")
        check_total(self.camera.name, total, self.num_gaussians, most + 1)
        return self._vote(labels, evidence, total, sign)

    def without(self, hidden: np.ndarray) -> ViewOperator:
        """Make the view without some Gaussians, (N,) bool; indices stay, and nothing is projected again.

        Raises
        ------
        SceneValueError
            There is not one bool per Gaussian.
        """
        if hidden.shape != (self.num_gaussians,) or hidden.dtype != bool:
            raise SceneValueError(f"hidden is {hidden.dtype} {hidden.shape}; expected bool ({self.num_gaussians},)")
        return self._without(hidden[self.ids])

    def objects_alone(self, labels: np.ndarray) -> ObjectsAlone:
        """Choose the Gaussians that belong to an object, those of labels (N,) int32 above 0, each object by itself.

        Raises `SceneValueError` where the labels are of another number of Gaussians.
        """
        self._check_rows(len(labels), what="labels")
        return self._objects_alone(labels)

    def visibility(self) -> np.ndarray:
        """Sum of each Gaussian's weights over the image: W^T 1, (N,) float32, in px."""
        return self.adjoint(np.ones((self.camera.height, self.camera.width, 1), np.float32))[:, 0]

    def transmittance(self) -> np.ndarray:
        """Return what is left of each ray after the last Gaussian, (H, W) float32 in [0, 1]."""
        return self.blend_seen(np.empty((len(self.ids), 0), np.float32)).transmittance

    @abstractmethod
    def footprints(self) -> np.ndarray:
        """Sum of the alphas of each of `ids` over an endless image, opacity * 2 pi sqrt(|S|): (M,), in px."""

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
        whole = row is None and column is None
        pixel = None if whole else self.camera.checked_pixel(row, column)
        pixels, rows, weights = self._weights(pixel)
        if pixel is None:  # Of each pixel they come nearest first, and a stable sort keeps that order.
            order = np.argsort(pixels, kind="stable")
        else:
            order = np.flatnonzero(pixels == pixel[0] * self.camera.width + pixel[1])
        return Weights(pixels[order], self.ids[rows[order]], weights[order])

    @abstractmethod
    def _without(self, hidden: np.ndarray) -> ViewOperator:
        """Make the view without some of `ids`, (M,) bool."""

    @abstractmethod
    def _objects_alone(self, labels: np.ndarray) -> ObjectsAlone: ...

    @abstractmethod
    def _adjoint(self, residual: np.ndarray) -> np.ndarray: ...

    @abstractmethod
    def _weights(self, pixel: tuple[int, int] | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """List pixels and places in `ids`, both (P,) int32, and weights, (P,) float32, nearest first in each pixel.

        If only a `pixel` is wanted, others may be among them.
        """

    @abstractmethod
    def _observe(self, labels: np.ndarray, weights: np.ndarray | None) -> Observation: ...

    def _lift(self, labels: np.ndarray) -> LabelWeights:
        return self._observe(labels, None).by_label()

    def _vote(self, labels: np.ndarray, evidence: LabelEvidence | None, total: VoteTotal, sign: int) -> bool:
        observation = self.observe(labels, evidence)
        observation.vote(total, sign=sign)
        return observation.num_pairs > 0

    def _check_weights(self, weights: np.ndarray) -> None:
        """Refuse what would be repeated over the image, or make every share NaN."""
        expected = -(-self.camera.height // BLOCK), -(-self.camera.width // BLOCK)
        if weights.shape != expected or not (weights.min() >= 0 and weights.max() < np.inf):
            found = f"view '{self.camera.name}': weights have shape {weights.shape}, {weights.min(initial=np.inf)} to"
            raise SceneValueError(f"{found} {weights.max(initial=-np.inf)}; expected {expected}, finite, 0 or more")

    def _check_labels(self, labels: np.ndarray, evidence: LabelEvidence | None) -> None:
        """Refuse what a kernel would take for places beyond its tables."""
        self.camera.check_image(labels, "image has")
        most = MAX_LABEL if evidence is None else len(evidence.rest) - 1
        # What int32 cannot hold, as the int64 that NaN becomes, would be taken for the label in its lower half.
        if labels.dtype.kind not in "iu" or labels.max() > most or labels.min() < -(2**31):
            found = f"view '{self.camera.name}': labels are {labels.dtype} from {labels.min()} up to {labels.max()}"
            raise MaskFormatError(f"{found}; expected integers up to {most}, of 32 bits")
