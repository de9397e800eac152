"""A scene with the colours to show it in, as splats for a browser or drawn as an image."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from gsseg_core.raster.view_operator import ViewOperator
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.viewer.splat_chunks import Key, Node, paint


@dataclass(frozen=True, eq=False)
class Picture:
    """A scene with the visibility and the colour of every Gaussian.

    Attributes
    ----------
    scene : GaussianScene
        N Gaussians.
    parts : mapping of Key to (M,) int64
        How the scene is cut into nodes.
    shown : (N,) bool
        Which of them are to be seen.
    colors : (N, 3) uint8
        In which colours.
    """

    scene: GaussianScene
    parts: Mapping[Key, np.ndarray]
    shown: np.ndarray
    colors: np.ndarray

    @cached_property
    def nodes(self) -> dict[Key, Node]:
        """Nodes that a browser draws, by label and band."""
        opacities = np.rint(self.scene.opacities * 255).astype(np.uint8)
        return paint(self.parts, self.shown, self.colors, opacities)

    def draw(
        self,
        operator: ViewOperator,  # of the scene
    ) -> np.ndarray:
        """Render the picture before a black background: (H, W, 3) uint8."""
        image = operator.without(~self.shown).render(self._rgb)
        drawn: np.ndarray = (image * 255 + 0.5).clip(0, 255).astype(np.uint8)
        return drawn

    @cached_property
    def _rgb(self) -> np.ndarray:
        rgb: np.ndarray = self.colors.astype(np.float32) / 255
        return rgb
