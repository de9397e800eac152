"""Rasterisers of others on one small scene. These jobs run in an environment that holds the libraries, without gsseg.

The scene is an npz: means, quats (w, x, y, z), scales, opacities, colors, viewmat, K, size (width, height); all of its
Gaussians are in view.
"""

from __future__ import annotations

import importlib
import json
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from machine import once, version

TILE = 16


def gsplat(scene: str, runs: int) -> dict[str, Any]:
    """Run the reference that gsplat has in PyTorch: projection, tiles and, where it can, the blending."""
    # Where it tries to compile its kernels: not where an interrupted try may have left a lock.
    os.environ["TORCH_EXTENSIONS_DIR"] = str(Path(scene).parent / "extensions")
    import torch
    from gsplat.cuda import _torch_impl as reference

    data = {name: torch.from_numpy(array) for name, array in np.load(scene).items()}
    width, height = data["size"].tolist()
    columns, rows = -(-width // TILE), -(-height // TILE)

    def project() -> Any:
        covariances, _ = reference._quat_scale_to_covar_preci(data["quats"], data["scales"], True, False)
        return reference._fully_fused_projection(
            data["means"], covariances, data["viewmat"][None], data["K"][None], width, height, eps2d=0.3
        )

    radii, centres, depths, conics, _ = project()

    def assign() -> Any:
        _, ids, entries = reference._isect_tiles(centres, radii, depths, TILE, columns, rows)
        return entries, reference._isect_offset_encode(ids, 1, columns, rows)

    entries, offsets = assign()
    answer = {"version": version("gsplat"), "project": [once(project) for _ in range(runs)], "bin": [once(assign)]}

    def blend() -> Any:
        colors, opacities = data["colors"][None], data["opacities"][None]
        return reference._rasterize_to_pixels(centres, conics, colors, opacities, width, height, TILE, offsets, entries)

    return answer | attempt(blend, runs)


def litesplat(scene: str, runs: int) -> dict[str, Any]:
    """Render with LiteSplat, which evaluates every Gaussian in every pixel; Keras runs it on PyTorch."""
    os.environ["KERAS_BACKEND"] = "torch"
    import torch
    from litesplat.core import CameraLayer, GaussianParameterLayer

    data = dict(np.load(scene))
    width, height = data["size"].tolist()
    (fx, _, cx), (_, fy, cy) = data["K"][:2].tolist()
    gaussians = [
        {"position": p, "translation": p, "rotation": q, "scale": s, "opacity": o, "color": c}
        for p, q, s, o, c in zip(
            *(data[name].tolist() for name in ("means", "quats", "scales", "opacities", "colors")), strict=True
        )
    ]
    pose = data["viewmat"]
    camera = {
        "camera_id": 0, "model": "PINHOLE", "image_name": "view", "width": width, "height": height,
        "fx": fx, "fy": fy, "cx": cx, "cy": cy, "rotation": pose[:3, :3].tolist(), "translation": pose[:3, 3].tolist(),
    }  # fmt: skip
    with tempfile.TemporaryDirectory() as name:
        (Path(name) / "gaussians.json").write_text(json.dumps(gaussians))
        (Path(name) / "camera.json").write_text(json.dumps([camera]))
        layer = CameraLayer(name, GaussianParameterLayer(name, trainable=False))
    with torch.no_grad():
        return {"version": version("litesplat"), **attempt(lambda: layer(inputs=(height, width), render=False), runs)}


def importable(module: str, package: str, needs: str) -> dict[str, Any]:
    """Import a library that is known to render only with something that this machine may not have."""
    answer = {"failed": f"can be imported, but renders by {needs} only"}
    return {"version": version(package), **answer, **attempt(lambda: importlib.import_module(module), 0)}


def attempt(job: Callable[[], object], runs: int) -> dict[str, Any]:
    """Seconds of a job, or why it cannot be done."""
    try:
        job()
        return {"render": [once(job) for _ in range(runs)]} if runs else {}
    except Exception as error:
        return {"failed": f"{type(error).__name__}: {error}"}
