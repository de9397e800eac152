"""Binary glTF with KHR_gaussian_splatting, as Khronos ratified it: activated float32 values, y up.

One primitive of points. The centre is its POSITION; scale (linear), rotation (x, y, z, w), opacity and the coefficients
of spherical harmonics are attributes of the extension. COLOR_0 is what shows the points where the extension is unknown.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gsseg_core.errors import SceneValueError
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.writers.axes import HALF_TURN_Z, turned

EXTENSION = "KHR_gaussian_splatting"

_LARGEST = 2**32 - 1  # bytes of a file, which it says in 32 bits
_FLOAT, _BYTE, _VERTICES, _POINTS = 5126, 5121, 34962, 0
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def write_glb(path: Path, scene: GaussianScene, run: str | None) -> None:
    """Write a scene as GLB; the id of a run is in `asset.extras`.

    Raises `SceneValueError` where there are more Gaussians than a file can hold.
    """
    attributes = _attributes(scene)
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    offset = 0
    for array in attributes.values():
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": array.nbytes, "target": _VERTICES})
        kind = {"componentType": _FLOAT} if array.dtype.kind == "f" else {"componentType": _BYTE, "normalized": True}
        accessors.append({"bufferView": len(accessors), **kind, "count": len(array), "type": _TYPES[array.shape[1]]})
        offset += array.nbytes  # a multiple of four, as rows are
    means = attributes["POSITION"]
    accessors[0] |= {"min": means.min(axis=0).tolist(), "max": means.max(axis=0).tolist()}
    look = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    primitive = {"mode": _POINTS, "attributes": dict(zip(attributes, range(len(attributes)), strict=True)),
                 "extensions": {EXTENSION: look}}  # fmt: skip
    content = {
        "asset": {"version": "2.0", "generator": "gsseg", **({} if run is None else {"extras": {"gsseg_run": run}})},
        "extensionsUsed": [EXTENSION], "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}], "accessors": accessors, "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }  # fmt: skip
    header = json.dumps(content, separators=(",", ":")).encode()
    header += b" " * (-len(header) % 4)
    length = 28 + len(header) + offset
    if length > _LARGEST:
        raise SceneValueError(
            f"{len(scene):,} Gaussians of SH degree {scene.sh_degree} take {length:,} bytes; expected at most "
            f"{_LARGEST:,}, which is as large as GLB goes"
        )
    with open(path, "wb") as file:
        file.write(struct.pack("<4sII", b"glTF", 2, length))
        file.write(struct.pack("<I4s", len(header), b"JSON") + header)
        file.write(struct.pack("<I4s", offset, b"BIN\0"))
        for array in attributes.values():
            file.write(np.ascontiguousarray(array).data)


def _attributes(scene: GaussianScene) -> dict[str, npt.NDArray[Any]]:
    """All attributes by name, the position first, each (N, components) of float32 or, normalised, of bytes."""
    means, quats, sh = turned(scene, HALF_TURN_Z)
    rgba = np.concatenate([scene.colors(), scene.opacities[:, None]], axis=1)
    attributes: dict[str, npt.NDArray[Any]] = {
        "POSITION": means,
        "COLOR_0": np.rint(rgba * 255).astype(np.uint8),
        f"{EXTENSION}:ROTATION": quats[:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": scene.scales,
        f"{EXTENSION}:OPACITY": scene.opacities[:, None],
    }
    for degree in range(scene.sh_degree + 1):
        for n in range(2 * degree + 1):
            attributes[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{n}"] = sh[:, degree**2 + n]
    return attributes
