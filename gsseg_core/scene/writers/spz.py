"""Niantic's SPZ, version 3, by gsply: packed to bytes, in the order given, with y up and z backwards."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from gsply import GSData
from gsply import write_spz as write_packed

from gsseg_core.errors import SceneValueError
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.writers.axes import HALF_TURN_X, logits_of_bytes, turned

_LARGEST = 2**23 - 1  # positions are 24-bit numbers, with as many fractional bits as there is room for


def write_spz(path: Path, scene: GaussianScene, run: str | None) -> None:
    """Write a scene as SPZ; there is no place in it for the id of a run.

    Scales and coefficients beyond the ranges that docs/formats.md has are clipped to them. Raises `SceneValueError`
    where a Gaussian lies farther from the origin than the format can say.
    """
    farthest = float(np.abs(scene.means).max())
    bits = 24 if farthest == 0 else min(24, math.floor(math.log2(_LARGEST / farthest)))
    if bits < 1:
        raise SceneValueError(
            f"positions reach {farthest:.3g}; expected at most {_LARGEST // 2:,}, which is as far as SPZ goes"
        )
    means, quats, sh = turned(scene, HALF_TURN_X)
    packed = GSData(
        means=means, scales=np.log(scene.scales), quats=quats, opacities=logits_of_bytes(scene),
        sh0=np.ascontiguousarray(sh[:, 0]), shN=np.ascontiguousarray(sh[:, 1:]),
    )  # fmt: skip
    write_packed(path, packed, fractional_bits=bits)
