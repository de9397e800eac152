"""antimatter15's .splat: 32 bytes a Gaussian without view-dependent colours, in the order given."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.splat import RECORD


def write_splat(path: Path, scene: GaussianScene, run: str | None) -> None:
    """Write a scene as .splat; there is no place in it for the id of a run."""
    records = np.empty(len(scene), RECORD)
    records["mean"], records["scale"] = scene.means, scene.scales
    records["rgba"][:, :3] = np.rint(scene.colors() * 255)
    records["rgba"][:, 3] = np.rint(scene.opacities * 255).clip(1, 254)  # so that its logit is finite
    records["quat"] = np.rint(scene.quats * 128 + 128).clip(0, 255)
    records.tofile(path)
