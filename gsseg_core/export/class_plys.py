"""One PLY for each object of a segmentation."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np

from gsseg_core.files.run_folder import staged_run
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.ply import write_vertices
from gsseg_core.segmentation import Segmentation


def export_classes(scene: GaussianScene, segmentation: Segmentation, folder: str | os.PathLike[str]) -> dict[int, Path]:
    """Write `<id>_<name>.ply` for every class that has Gaussians; valid 3DGS PLYs with all properties kept.

    Two properties are added: `label` (int), the class, and `confidence` (float), that of the segmentation.

    All PLYs of an earlier export are replaced in one step, as `gsseg_core.files.run_folder` says; other files stay.

    Raises
    ------
    PathTakenError
        The folder, or the name of a PLY, is taken by what is no earlier export; nothing was written.
    WriteError
        Something cannot be written; an earlier export is unchanged.
    """
    folder = Path(folder)
    with staged_run(folder, "classes") as run:
        written = write_classes(scene, segmentation, run.folder, run.id)
    return {k: folder / path.name for k, path in written.items()}


def write_classes(scene: GaussianScene, segmentation: Segmentation, folder: Path, run: str) -> dict[int, Path]:
    """Write the PLYs of `export_classes` into a folder of a run with this id."""
    confidence, paths = segmentation.confidence, {}
    for k in np.flatnonzero(segmentation.counts()).tolist():
        members = segmentation.labels == k
        vertices = _with_confidence(scene.vertices[members], k, confidence[members])
        paths[k] = folder / class_file_name(k, segmentation.class_names[k])
        write_vertices(paths[k], vertices, run)
    return paths


def _with_confidence(vertices: np.ndarray, label: int, confidence: np.ndarray) -> np.ndarray:
    """Add properties `label` (int32) and `confidence` (M,) (float32) to vertices (M,); earlier ones are replaced."""
    kept = [name for name in vertices.dtype.names or () if name not in ("label", "confidence")]
    types = [(name, vertices.dtype[name]) for name in kept]
    out = np.empty(len(vertices), [*types, ("label", np.int32), ("confidence", np.float32)])
    for name in kept:
        out[name] = vertices[name]
    out["label"], out["confidence"] = label, confidence
    return out


def class_file_name(label: int, name: str) -> str:
    """File name of a class, safe on any file system."""
    return f"{label}_{re.sub(r'[^0-9A-Za-z._-]+', '_', name)[:100].strip('._') or 'class'}.ply"
