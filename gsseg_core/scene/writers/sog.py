"""PlayCanvas SOG, by gaussforge: images in a zip, with Gaussians in another order and a palette of harmonics."""

from __future__ import annotations

import io
from pathlib import Path

import gaussforge
import plyfile

from gsseg_core.errors import SceneValueError
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.text import one_line


def write_sog(path: Path, scene: GaussianScene, run: str | None) -> None:
    """Write a scene as SOG, all in one file; there is no place in it for the id of a run.

    Raises
    ------
    SceneValueError
        gaussforge cannot write it.
    """
    # Of the vertices, it understands none but those of float32, with nothing besides what 3DGS has.
    plain = GaussianScene.from_arrays(scene.means, scene.quats, scene.scales, scene.opacities, scene.sh)
    ply = io.BytesIO()
    plyfile.PlyData([plyfile.PlyElement.describe(plain.vertices, "vertex")], byte_order="<").write(ply)
    made = gaussforge.GaussForge().convert(ply.getvalue(), "ply", "sog")
    if "error" in made:
        raise SceneValueError(f"gaussforge cannot write this scene as SOG ({one_line(str(made['error']))})")
    path.write_bytes(made["data"])
