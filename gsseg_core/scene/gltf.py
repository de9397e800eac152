"""glTF 2.0 with KHR_gaussian_splatting, as GLB or as JSON with buffers beside it; also with SPZ inside."""

from __future__ import annotations

import base64
import io
import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import numpy.typing as npt

from gsseg_core.errors import SceneFileError
from gsseg_core.files.input_files import UnfitError, open_expected
from gsseg_core.files.limits import LIMITS
from gsseg_core.scene.camera import rigid_motion
from gsseg_core.scene.moving import move
from gsseg_core.scene.quaternions import rotations
from gsseg_core.scene.scene_file import check_count, check_size, open_scene, size_of
from gsseg_core.scene.spz import decode_spz
from gsseg_core.scene.vertices import ReadScene, log_scales, logits, pack_vertices
from gsseg_core.text import clipped, quoted

_EXPECTED = "a glTF file with KHR_gaussian_splatting"
_SPLATS = "KHR_gaussian_splatting"
_SPZ = "KHR_gaussian_splatting_compression_spz_2"
_KNOWN = {_SPLATS, _SPZ, "KHR_mesh_quantization", "KHR_materials_unlit"}
_JSON, _BIN = 0x4E4F534A, 0x004E4942
_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
# glTF looks left, up, front; a PLY right, down, front. SPZ inside is read into the axes of a PLY as if it were alone.
_TO_PLY = np.diag([-1.0, -1.0, 1.0])
_RIGID = 1e-4  # how far the axes of a node may be from equally long and at right angles


def is_gltf(head: bytes) -> bool:
    """Whether a file begins as GLB, or as JSON with what every glTF must have."""
    return head.startswith(b"glTF") or (head.lstrip()[:1] == b"{" and b'"asset"' in head and b'"meshes"' in head)


def read_gltf(path: Path, within: Path | None = None) -> ReadScene:
    """Read all splats of a glTF scene into the axes of a PLY, node after node, each moved as its node says."""
    with open_scene(path, within, _EXPECTED) as file:
        content = file.read()
        document, binary = _chunks(memoryview(content)) if content.startswith(b"glTF") else (content, None)
        if len(document) > LIMITS.max_json_bytes:
            raise UnfitError(f"has {len(document):,} bytes of JSON; expected at most {LIMITS.max_json_bytes:,}")
        return _Reader(json.loads(bytes(document)), binary, path, within).read()


def _chunks(content: memoryview) -> tuple[memoryview, memoryview | None]:
    """Split a GLB into its JSON and its binary chunk, without copies."""
    check_size(len(content), 20, "header")
    _, version, length = struct.unpack_from("<4sII", content)
    if version != 2:
        raise UnfitError(f"is GLB of version {version}; expected 2")
    check_size(len(content), length, "file")
    chunks: dict[int, memoryview] = {}
    place = 12
    while place + 8 <= length:
        size, kind = struct.unpack_from("<II", content, place)
        check_size(length - place - 8, size, "chunk")
        chunks.setdefault(kind, content[place + 8 : place + 8 + size])
        place += 8 + size
    return chunks[_JSON], chunks.get(_BIN)


class _Reader:
    """Reader of the splats of one document: what it lacks raises Python's own errors, which `open_scene` takes."""

    def __init__(self, document: Any, binary: memoryview | None, path: Path, within: Path | None) -> None:
        self._document, self._binary, self._path, self._within = document, binary, path, within
        self._buffers: dict[int, memoryview] = {}
        self._count = 0

    def read(self) -> ReadScene:
        needed = set(self._document.get("extensionsRequired", ())) - _KNOWN
        if needed:
            raise UnfitError(f"needs the extension {clipped(', '.join(sorted(needed)))}; gsseg reads {_SPLATS} alone")
        parts = [
            self._splats(primitive, matrix)
            for mesh, matrix in self._meshes()
            for primitive in self._document["meshes"][mesh]["primitives"]
            if _SPLATS in primitive.get("extensions", {})
        ]
        if not parts:
            raise UnfitError(f"has no splats in its scene; expected {_EXPECTED}")
        if len({part.dtype for part in parts}) > 1:
            raise UnfitError("has splats of several degrees of SH; expected one")
        used = self._document.get("extensionsUsed", ())
        return ReadScene(np.concatenate(parts), "2.0", ("SPZ inside",) if _SPZ in used else ())

    def _meshes(self) -> Iterator[tuple[int, npt.NDArray[np.float64]]]:
        """Meshes of the scene, depth first, in the order of the file, with the matrices (4, 4) that place them."""
        scenes, nodes = self._document["scenes"], self._document["nodes"]
        waiting = [(node, np.eye(4)) for node in reversed(scenes[self._document.get("scene", 0)].get("nodes", ()))]
        left = len(nodes)
        while waiting:
            index, above = waiting.pop()
            left -= 1
            if left < 0:
                raise UnfitError("has nodes that are below themselves or below two others; expected a tree")
            node = nodes[index]
            matrix = above @ _matrix(node)
            if "mesh" in node:
                yield node["mesh"], matrix
            waiting += [(child, matrix) for child in reversed(node.get("children", ()))]

    def _splats(self, primitive: Any, matrix: npt.NDArray[np.float64]) -> npt.NDArray[np.void]:
        compressed = primitive["extensions"][_SPLATS].get("extensions", {}).get(_SPZ)
        if compressed is not None:
            vertices = decode_spz(io.BytesIO(self._view(compressed["bufferView"]))).vertices
            move(vertices, _TO_PLY)  # As the node moves what is in the axes of glTF.
        else:
            vertices = self._plain(primitive["attributes"])
        self._count += len(vertices)
        check_count(self._count)
        turn = matrix[:3, :3]
        scale = float(np.cbrt(abs(np.linalg.det(turn))))
        if not scale > 0 or np.abs(turn @ turn.T / scale**2 - np.eye(3)).max() > _RIGID:
            raise UnfitError("has a node that scales its axes by several factors, or by 0; expected one factor")
        move(vertices, _TO_PLY @ turn / scale, scale, _TO_PLY @ matrix[:3, 3])
        return vertices

    def _plain(self, attributes: Any) -> npt.NDArray[np.void]:
        means = self._accessor(attributes["POSITION"])
        quats, scales, opacities = (
            self._accessor(attributes[f"{_SPLATS}:{name}"]) for name in ("ROTATION", "SCALE", "OPACITY")
        )
        harmonics = []
        for degree in range(4):
            names = [f"{_SPLATS}:SH_DEGREE_{degree}_COEF_{i}" for i in range(2 * degree + 1)]
            if degree and names[0] not in attributes:
                break
            harmonics += [self._accessor(attributes[name]) for name in names]
        sh = np.stack(harmonics, axis=1)
        # A draft of the extension stored logarithms, which are negative for all that is smaller than a unit.
        logs = scales if scales.min(initial=0) < 0 else log_scales(scales)
        return pack_vertices(means, quats[:, [3, 0, 1, 2]], logs, logits(opacities[:, 0]), sh[:, 0], sh[:, 1:])

    def _accessor(self, index: int) -> npt.NDArray[np.float32]:
        """Values (N, C) of an accessor; integers that are normalised become fractions."""
        accessor = self._document["accessors"][index]
        count, kind, width = accessor["count"], _TYPES[accessor["componentType"]], _WIDTHS[accessor["type"]]
        if "sparse" in accessor or type(count) is not int:
            raise UnfitError(f"has an accessor of {quoted(count)} values, or a sparse one; expected a plain one")
        check_count(count)
        view = self._document["bufferViews"][accessor["bufferView"]]
        dtype = np.dtype(kind)
        stride = view.get("byteStride", width * dtype.itemsize)
        content = self._view(accessor["bufferView"])
        offset = accessor.get("byteOffset", 0)
        if min(stride, offset) < 0 or stride < width * dtype.itemsize:
            raise UnfitError(f"has an accessor at {offset} with a stride of {stride}; expected one within its view")
        check_size(len(content), offset + stride * (count - 1) + width * dtype.itemsize if count else 0, "view")
        values = np.ndarray((count, width), dtype, content, offset, (stride, dtype.itemsize)).astype(np.float32)
        if accessor.get("normalized") and dtype.kind != "f":
            values = np.maximum(values / np.iinfo(dtype).max, -1)
        return values

    def _view(self, index: int) -> memoryview:
        view = self._document["bufferViews"][index]
        content = self._buffer(view["buffer"])
        start, size = view.get("byteOffset", 0), view["byteLength"]
        if min(start, size) < 0:
            raise UnfitError(f"has a view of {size} bytes at {start}; expected one within its buffer")
        check_size(len(content), start + size, "buffer")
        return content[start : start + size]

    def _buffer(self, index: int) -> memoryview:
        if index not in self._buffers:
            buffer = self._document["buffers"][index]
            self._buffers[index] = memoryview(self._load(buffer.get("uri"), index, buffer["byteLength"]))
        return self._buffers[index]

    def _load(self, uri: str | None, index: int, size: int) -> bytes | memoryview:
        if uri is None:
            if index or self._binary is None:
                raise UnfitError(f"has no bytes for buffer {index}; expected the binary chunk of a GLB, or a uri")
            return self._binary
        if uri.startswith("data:"):
            return base64.b64decode(uri.partition(",")[2], validate=True)
        name = unquote(uri)
        if Path(name).name != name or "\\" in name:
            raise UnfitError(f"names the buffer {quoted(name)}; expected the name of a file beside it")
        with open_expected(self._path.parent / name, SceneFileError, within=self._within) as file:
            check_size(size_of(file), size, name)
            return file.read()


def _matrix(node: Any) -> npt.NDArray[np.float64]:
    """Matrix (4, 4) of a node: as it stands, column after column, or of translation, rotation and scale."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    x, y, z, w = np.array(node.get("rotation", (0, 0, 0, 1)), np.float64)
    axes = rotations(np.array([[w, x, y, z]]))[0] * np.array(node.get("scale", (1, 1, 1)), np.float64)
    return rigid_motion(axes, node.get("translation", (0, 0, 0)))
