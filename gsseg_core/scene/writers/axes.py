"""Scenes turned to the axes that a format defines, and opacities bounded for formats of eight bits.

The y axis of a 3DGS PLY points down by custom, as cameras' do. Formats that define y as up hold scenes turned by half a
turn. Half a turn about an axis of the scene changes signs and nothing else: of two coordinates, of the same two parts
of each quaternion, and of those spherical harmonics that are odd in them. So it is exact, and undone by itself.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gsseg_core.scene import spherical_harmonics
from gsseg_core.scene.gaussian_scene import GaussianScene

HALF_TURN_X, HALF_TURN_Z = (1, -1, -1), (-1, -1, 1)  # signs of x, y, z after half a turn about x or z


def turned(scene: GaussianScene, signs: tuple[int, int, int]) -> tuple[npt.NDArray[np.float32], ...]:
    """Turn a scene by half a turn, whose `signs` are those of x, y, z after it.

    Returns centres (N, 3), quaternions w, x, y, z (N, 4) and harmonics (N, (d + 1)^2, 3), all float32.
    """
    xyz = np.array(signs, np.float32)
    parity = np.diag(spherical_harmonics.turned(np.diag(signs), scene.sh_degree)).astype(np.float32)
    return scene.means * xyz, scene.quats * np.array((1, *signs), np.float32), scene.sh * parity[:, None]


def logits_of_bytes(scene: GaussianScene) -> npt.NDArray[np.float32]:
    """Logits (N,) of opacities that eight bits round to neither 0 nor 255, so that they stay finite.

    No pixel shows the difference: alphas end at 0.99, and below 1/255 nothing is drawn.
    """
    opacities = scene.opacities.clip(1 / 255, 254 / 255)
    return np.log(opacities / (1 - opacities))
