"""A scene of few Gaussians that looks like one of many, from afar: what small pictures are rendered of."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsseg_core.scene.gaussian_scene import GaussianScene


def thinned(scene: GaussianScene, most: int) -> GaussianScene:
    """Draw `most` Gaussians of a scene at random, always the same, and make up for the others; fewer stay as they are.

    Of N Gaussians, each of those drawn stands for k = N / most. It covers sqrt(k) times its area, and within it lets
    through what sqrt(k) of its kind would let through one behind the other: 1 - (1 - opacity)^sqrt(k). Area alone would
    blur, and opacity alone leave holes.
    """
    if len(scene) <= most:
        return scene
    part = scene.subset(np.sort(np.random.default_rng(0).permutation(len(scene))[:most]))
    share = (len(scene) / most) ** 0.5
    opacities = 1 - (1 - part.opacities.astype(np.float64)) ** share
    below_one = np.minimum(opacities, np.nextafter(np.float32(1), np.float32(0))).astype(np.float32)
    return replace(part, scales=part.scales * np.float32(share**0.5), opacities=below_one)
