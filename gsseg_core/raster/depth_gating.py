"""Depth gating: a mask's pixels count only where a depth camera saw the scene, and not what stood before it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.data.view import View
from gsseg_core.errors import SettingsError
from gsseg_core.raster.backends import make_operator
from gsseg_core.raster.depth import COVERED, surface
from gsseg_core.scene.gaussian_scene import GaussianScene


@dataclass(frozen=True)
class DepthTolerance:
    """How far a measured depth may be from the scene's: `absolute + relative * depth`.

    Raises `SettingsError` where one of them is negative, NaN or infinite.
    """

    absolute: float = 0.1  # in the units of the measured depth, such as metres
    relative: float = 0.05  # share of the scene's depth

    def __post_init__(self) -> None:
        """Validate."""
        for name, value in vars(self).items():
            if not 0 <= value < np.inf:
                raise SettingsError(f"depth_tolerance.{name} is {value:g}; expected 0 or more")


class Gated(NamedTuple):
    """A view without the pixels of its mask that a measured depth contradicts."""

    view: View
    contradicted: np.ndarray  # (H, W) bool: labelled, and measured elsewhere than the scene is
    measured: np.ndarray  # (H, W) bool: where the depth says anything


def gate_view(
    scene: GaussianScene,
    view: View,  # with a mask
    depth: np.ndarray,  # (H, W) along the optical axis, in the view's own pixels
    tolerance: DepthTolerance | None = None,  # how far the two may be apart, in the units of `depth`
    *,
    scale: float = 1.0,  # units of `depth`, such as metres, per unit of the scene
    device: str = "cpu",
) -> Gated:
    """Make those pixels of a view's mask unknown in which a depth camera measured something else than the scene.

    What is nearer than the scene by more than the tolerance, as a person, hides it. What is farther shows that
    something of the scene is gone; that counts only where the scene covers more than half of the ray, for through less
    one sees what lies behind. A depth that is zero, negative, NaN or infinite was not measured, and says nothing.

    Raises `MaskSizeError` where the depth is not of the size of the view, `SettingsError` where the scale is not above
    0, or infinite, and what reading the mask raises.
    """
    camera, tolerance = view.camera, tolerance or DepthTolerance()
    camera.check_image(depth, "depth has")
    if not 0 < scale < np.inf:
        raise SettingsError(f"view '{camera.name}': scale of the depth is {scale:g}; expected a number above 0")
    seen, measured = view.read_seen(), np.isfinite(depth) & (depth > 0)
    coverage, rendered = surface(scene, make_operator(scene, camera, device))
    # Rays that meet nothing of the scene have no depth to compare with.
    compared = measured & np.isfinite(rendered) & (seen.labels != UNKNOWN)
    expected = np.where(compared, rendered, 1).astype(np.float64) * scale
    off = np.where(compared, depth, expected) - expected
    margin = tolerance.absolute + tolerance.relative * expected
    contradicted = (off < -margin) | ((off > margin) & (coverage > COVERED))
    gated = View.from_seen(camera, seen.hidden(contradicted), view.class_names)
    return Gated(replace(gated, image_path=view.image_path), contradicted, measured)
