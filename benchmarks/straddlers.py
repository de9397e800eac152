"""Split Gaussians along their longest axis, so that each half can belong to another object.

With o the opacity and s the standard deviation along that axis, the halves lie at +- d s from the centre and have the
standard deviation s sqrt(v), v = 1 - d^2, which keeps the variance of the whole. Their opacity o' keeps its coverage:
seen from the side, the composite alpha a_1 + a_2 - a_1 a_2 of the halves sums over the pixels to what the alpha of the
old one did, which is

    2 o' - o'^2 exp(-d^2 / v) / sqrt(2) = o / sqrt(v)

divided by sqrt(2 pi v) s. (Halves in one place, d = 0, would have to be 1 - sqrt(1 - o) to let through what the whole
did; displaced ones of that opacity cover more than it did.) With d = 1/2 composite and old alpha differ
by less than 0.04 at any pixel for opacities up to a half, and by less than 0.17 up to 0.99: what was a plateau gets
flatter slopes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gsseg_core.errors import SceneValueError
from gsseg_core.refine.silhouette_carving import KeptShares
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.quaternions import rotations

DISTANCE = 0.5
"""Of the halves' centres from the old one, in standard deviations along the longest axis."""


class Split(NamedTuple):
    """What `split` returns.

    Attributes
    ----------
    scene : GaussianScene
        N + M Gaussians: those that went in, one half in place of each that was split, and the M other halves.
    parents : (N + M,) int64
        Which Gaussian of the old scene each one comes from.
    """

    scene: GaussianScene
    parents: np.ndarray


def split(
    scene: GaussianScene,
    which: np.ndarray,  # (N,) bool
) -> Split:
    """Put two halves in place of some Gaussians; colours and all other properties are those of the old ones.

    Raises
    ------
    SceneValueError
        `which` is not one bool per Gaussian.
    """
    if which.shape != (len(scene),) or which.dtype != bool:
        raise SceneValueError(
            f"{scene.path or 'scene'}: found a selection of shape {which.shape}, {which.dtype}; "
            f"expected ({len(scene)},), bool"
        )
    chosen = np.flatnonzero(which)
    parents = np.concatenate([np.arange(len(scene)), chosen])
    grown = scene.subset(parents)  # copies, to be changed
    axis = scene.scales[chosen].argmax(axis=1)
    longest = scene.scales[chosen, axis].astype(np.float64)
    turns = rotations(scene.quats[chosen].astype(np.float64))
    offsets = DISTANCE * longest[:, None] * turns[np.arange(len(chosen)), :, axis]
    opacity = half_opacity(scene.opacities[chosen])
    for sign, rows in ((1, chosen), (-1, len(scene) + np.arange(len(chosen)))):
        grown.means[rows] = scene.means[chosen] + sign * offsets
        grown.scales[rows, axis] = longest * np.sqrt(1 - DISTANCE**2)
        grown.opacities[rows] = opacity
        for d, name in enumerate("xyz"):
            grown.vertices[name][rows] = grown.means[rows, d]
        for d in range(3):
            along = rows[axis == d]
            grown.vertices[f"scale_{d}"][along] = np.log(grown.scales[along, d])
        grown.vertices["opacity"][rows] = np.log(opacity / (1 - opacity))
    return Split(grown, parents)


def straddlers(
    shares: KeptShares,  # of N Gaussians
    balance: float = 0.3,
    least: float = 2.0,
) -> np.ndarray:
    """Find the Gaussians with good reasons both to stay with their object and to go, (N,) bool.

    Parameters
    ----------
    shares : KeptShares
        From `gsseg_core.refine.silhouette_carving.kept_shares`.
    balance : float
        How large the weaker of the two reasons must be, as a share of the stronger one, 0 to 1.
    least : float
        How large it must be in px, over all views.
    """
    weaker, stronger = np.minimum(shares.stay, shares.go), np.maximum(shares.stay, shares.go)
    chosen: np.ndarray = (weaker >= least) & (weaker > balance * stronger)
    return chosen


def half_opacity(
    opacities: np.ndarray,  # (M,)
) -> np.ndarray:
    """Opacity of each of two halves, (M,) float64, above 0 and below 0.7; the module has the formula."""
    v = 1 - DISTANCE**2
    overlap = np.exp(-(DISTANCE**2) / v) / np.sqrt(2)
    # The smaller root, written so that nothing cancels for faint ones.
    whole = opacities.astype(np.float64) / np.sqrt(v)
    halves: np.ndarray = whole / (1 + np.sqrt(1 - overlap * whole))
    return halves
