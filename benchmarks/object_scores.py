"""Scores of objects cut out of a scene: their silhouettes against masks, per object.

A mask shows what is visible of an object, its silhouette also what other things hide. So there are two scores. In
`whole` every pixel counts, and an object that is half hidden scores badly however well it was cut out. In `visible` a
pixel that the mask gives to another class does not count where the object's own surface lies behind that of the scene:
no view shows whether the object goes on there. Depths are those of the whole scene, whatever its labels, so a poor
segmentation hides nothing. What sticks out of an object in front or at the side counts against it in both.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from gsseg_core.errors import MaskSizeError
from gsseg_core.metrics import BOUNDARY_SHARE, boundary_band, iou
from gsseg_core.raster.backends import make_operator
from gsseg_core.raster.depth import BEHIND, COVERED, surface
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene


class Counts:
    """Pixels in both, in the truth, and in the silhouette, of areas and of boundary bands."""

    def __init__(self, num_classes: int) -> None:
        self._counts = np.zeros((2, 3, num_classes), np.int64)

    def add(self, label: int, truth: np.ndarray, silhouette: np.ndarray, width: int) -> None:
        """Count one object in one view, given as two masks (H, W) and the width of the band in px."""
        if truth.any() or silhouette.any():
            self._counts[0, :, label] += _overlap(truth, silhouette)
            self._counts[1, :, label] += _overlap(_band(truth, width), _band(silhouette, width))

    @property
    def iou(self) -> np.ndarray:
        """(K,) float64; NaN for the background and for classes that the truth never shows."""
        return self._iou(0)

    @property
    def boundary_iou(self) -> np.ndarray:
        """(K,) float64; of bands along the inside of the outlines, as wide as 2 % of the image diagonal."""
        return self._iou(1)

    def _iou(self, which: int) -> np.ndarray:
        return np.where(self._counts[0, 1] > 0, iou(*self._counts[which]), np.nan)


class ObjectScores:
    """IoU and boundary IoU of silhouettes, per object, with pixels summed over all views.

    Attributes
    ----------
    whole, visible : Counts
        Both scores; the module says what they are.
    """

    def __init__(self, num_classes: int) -> None:
        self.whole, self.visible = Counts(num_classes), Counts(num_classes)
        self._num_classes = num_classes

    def add(
        self,
        objects: Mapping[int, GaussianScene],
        camera: Camera,
        truth: np.ndarray,  # (H, W) int32, negative = unknown
        depth: np.ndarray,  # (H, W) of the whole scene, from `surface`
    ) -> None:
        """Add one view.

        Parameters
        ----------
        objects : mapping from class to GaussianScene
            The Gaussians of each object. One that is missing was not found at all.

        Raises
        ------
        MaskSizeError
            Truth or depth are not of the camera's size.
        """
        size = camera.height, camera.width
        for name, image in (("truth", truth), ("depth", depth)):
            if image.shape != size:
                raise MaskSizeError(f"view '{camera.name}': {name} has shape {image.shape}; expected {size}")
        width = max(1, round(BOUNDARY_SHARE * math.hypot(*size)))
        for label in range(1, self._num_classes):
            mask, silhouette, hidden = truth == label, np.zeros(size, bool), np.zeros(size, bool)
            if label in objects:
                alone = surface(objects[label], make_operator(objects[label], camera))
                silhouette = (alone.coverage > COVERED) & (truth >= 0)
                hidden = ~mask & (alone.depth > BEHIND * depth)
            self.whole.add(label, mask, silhouette, width)
            self.visible.add(label, mask, silhouette & ~hidden, width)


def objects_of(
    scene: GaussianScene,
    labels: np.ndarray,  # (N,) int
) -> dict[int, GaussianScene]:
    """Cut out the Gaussians of each class above 0."""
    return {k: scene.subset(labels == k) for k in np.unique(labels[labels > 0]).tolist()}


def _overlap(truth: np.ndarray, silhouette: np.ndarray) -> tuple[int, int, int]:
    return int((truth & silhouette).sum()), int(truth.sum()), int(silhouette.sum())


def _band(mask: np.ndarray, width: int) -> np.ndarray:
    return mask & boundary_band(mask.astype(np.int32), width)
