"""PlayCanvas compressed PLY, by gsply: 256 Gaussians at a time between bounds of their own, in the order given."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from gsply.writer import write_compressed

from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.writers.axes import logits_of_bytes


def write_compressed_ply(path: Path, scene: GaussianScene, run: str | None) -> None:
    """Write a scene as compressed PLY; there is no place in it for the id of a run."""
    # All of red, then green, then blue, as in a PLY; arrays of three dimensions gsply would write in another order.
    rest = scene.sh[:, 1:].transpose(0, 2, 1).reshape(len(scene), -1)
    write_compressed(
        path, scene.means, np.log(scene.scales), scene.quats, logits_of_bytes(scene),
        np.ascontiguousarray(scene.sh[:, 0]), np.ascontiguousarray(rest) if rest.size else None,
    )  # fmt: skip
