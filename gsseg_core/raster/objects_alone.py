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
    def reasons_to_go(
        self,
        depths: np.ndarray,  # (M,) float32, of the Gaussians, scene units
        shown: np.ndarray,  # (H, W) int32: object that the view shows in each pixel, negative where unknown
        hidden_from: np.ndarray,  # (H, W) float32: depth from which on the pixel hides a Gaussian
    ) -> np.ndarray:
        """Weigh what speaks against each Gaussian in its object, were the object alone in the view.

        That is the sum of its alpha, (M,) float64 in px, over the pixels that show another object and do not hide it.
        """

    @abstractmethod
    def reasons_to_stay(
        self,
        kept: np.ndarray,  # (M,) float32: share of each Gaussian that its object keeps, a factor of its alphas
        asked: np.ndarray,  # (M,) bool: whose reasons are wanted; only the pixels that these reach are looked at
        shown: np.ndarray,  # (H, W) int32, as `reasons_to_go` takes it
    ) -> np.ndarray:
        """Weigh what speaks for each Gaussian in its object k, were the object alone in the view.

        That is the sum of alpha T_k / (1 - T_k), (M,) float64 in px, over the pixels that show the object, whose
        transmittance is T_k; as good as 0 where the object lets no light through, and 0 for those not asked for.
        """
