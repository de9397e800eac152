"""The objects of a view, each as if it stood there alone: what speaks for and against each Gaussian in its object."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np


class ObjectsAlone(ABC):
    """The Gaussians of a view that belong to an object; the others take neither time nor memory."""

    ids: np.ndarray  # (M,) int32: those that reach a tile, as indices in the scene, in any order

    @property
    @abstractmethod
    def nbytes(self) -> int:
        """Memory that they take, in bytes."""

    @abstractmethod
    def reasons_to_go(self, depths: np.ndarray, shown: np.ndarray, hidden_from: np.ndarray) -> np.ndarray:
        """Weigh what speaks against each Gaussian in its object, were the object alone in the view.

        Parameters
        ----------
        depths : (M,) float32
            Depth of each Gaussian, in scene units.
        shown : (H, W) int32
            Object that the view shows in each pixel, negative where unknown.
        hidden_from : (H, W) float32
            Depth from which on the pixel hides a Gaussian.

        Returns
        -------
        (M,) float64
            Sum of alpha, in px, over the pixels that show another object and do not hide the Gaussian.
        """

    @abstractmethod
    def reasons_to_stay(self, kept: np.ndarray, asked: np.ndarray, shown: np.ndarray) -> np.ndarray:
        """Weigh what speaks for each Gaussian in its object k, were the object alone in the view.

        Parameters
        ----------
        kept : (M,) float32
            Share of each Gaussian that its object keeps, by which its alphas are multiplied.
        asked : (M,) bool
            Whose reasons are wanted; those of all others are 0. Only the pixels that these reach are looked at.
        shown : (H, W) int32
            As `reasons_to_go` takes it.

        Returns
        -------
        (M,) float64
            Sum of alpha T_k / (1 - T_k), in px, over the pixels that show the object, whose transmittance is T_k; as
            good as 0 where the object lets no light through.
        """
