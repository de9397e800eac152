"""The `.splat` of antimatter15's viewer: 32 bytes for each Gaussian, and no header."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsseg_core.files.input_files import UnfitError
from gsseg_core.scene.scene_file import open_scene
from gsseg_core.scene.vertices import ReadScene, dc_of, log_scales, logits, pack_vertices

RECORD = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])


def read_splat(path: Path, within: Path | None = None) -> ReadScene:
    """Read a `.splat`: positions and scales as floats; colours, opacities and rotations w, x, y, z as bytes."""
    with open_scene(path, within, "a .splat file") as file:
        content = file.read()
        if len(content) % RECORD.itemsize:
            raise UnfitError(
                f"has {len(content):,} bytes; expected {RECORD.itemsize} for each Gaussian (truncated, or no .splat)"
            )
    records = np.frombuffer(content, RECORD)
    rgba = records["rgba"] / 255
    quats = (records["quat"].astype(np.float32) - 128) / 128
    return ReadScene(
        pack_vertices(
            records["mean"], quats, log_scales(records["scale"]), logits(rgba[:, 3]), dc_of(rgba[:, :3])
        )
    )  # fmt: skip
