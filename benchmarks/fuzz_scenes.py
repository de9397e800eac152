"""Scenes in every format that gsseg reads, to be broken: how each is written, and what can be broken inside of it."""

from __future__ import annotations

import functools
import gzip
import json
import random
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import mutations
import scene_files
from mutations import BOMB, ZEROS, Mutation

from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.scene_writers import write_scene
from gsseg_core.scene.vertices import columns

Write = Callable[[Path, GaussianScene], object]
SPZ_HEADER = struct.Struct("<4sIIBBBB")


def written(name: str, write: Write) -> Callable[[Path], None]:
    """Make a dataset that has its scene in another format, too."""

    def make(folder: Path) -> None:
        write(folder / name, GaussianScene.load(folder / "scene.ply"))

    return make


def by_gsseg(path: Path, scene: GaussianScene) -> None:
    """Write what gsseg writes by such a suffix."""
    write_scene(scene, path)


def mip_splatting(path: Path, scene: GaussianScene) -> None:
    """Write a PLY with one more property, the 3D filter."""
    _ply(path, scene, {"filter_3D": 0.01})


def two_scales(path: Path, scene: GaussianScene) -> None:
    """Write a PLY of 2DGS."""
    _ply(path, scene, {}, without="scale_2")


def _ply(path: Path, scene: GaussianScene, added: dict[str, float], without: str = "") -> None:
    import numpy as np

    names = tuple(name for name in scene.vertices.dtype.names or () if name != without)
    table = np.column_stack([columns(scene.vertices, names), *(np.full(len(scene), v) for v in added.values())])
    header = [f"property float {name}" for name in (*names, *added)]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(scene)}", *header, "end_header", ""]
    path.write_bytes("\n".join(lines).encode() + table.astype("<f4").tobytes())


def spz_inside(data: bytes, rng: random.Random) -> bytes:
    """Make an SPZ under gzip with another header or body; now and then one that inflates to gigabytes."""
    body = gzip.decompress(data)
    if rng.random() < 0.03:
        degree = rng.choice((0, 3))
        count = BOMB // (20 if degree == 0 else 65)
        return gzip.compress(SPZ_HEADER.pack(b"NGSP", 3, count, degree, 12, 0, 0), mtime=0) + _zeros_under_gzip()
    if rng.random() < 0.5:
        return gzip.compress(_other_header(body, rng), mtime=0)
    return gzip.compress(rng.choice((mutations.numbers, mutations.any_bytes))(body, rng), mtime=0)


def spz_4_inside(data: bytes, rng: random.Random) -> bytes:
    """Make an SPZ of version 4 with another header, or another table of streams."""
    if rng.random() < 0.5:
        return _other_header(data, rng)
    changed = bytearray(data)
    at = 32 + 8 * rng.randrange(12)
    odd = (0, 1, 255, 2**20, BOMB, 2**32, 2**63, 2**64 - 1, rng.randrange(10_000))
    changed[at : at + 8] = struct.pack("<Q", rng.choice(odd))
    return bytes(changed)


def _other_header(body: bytes, rng: random.Random) -> bytes:
    fields = list(SPZ_HEADER.unpack_from(body))
    at = rng.randrange(1, 7)
    counts = (0, 1, 2, fields[2] - 1, fields[2] + 1, 10**6, 2**26, 2**31 - 1, 2**32 - 1)
    fields[at] = rng.choice(counts if at == 2 else (0, 1, 2, 3, 4, 5, 99) if at == 1 else (0, 1, 2, 3, 4, 5, 24, 255))
    return SPZ_HEADER.pack(*fields) + body[SPZ_HEADER.size :]


@functools.cache
def _zeros_under_gzip() -> bytes:
    """Pack gigabytes of zeros as a member of a gzip file."""
    packer = zlib.compressobj(9, wbits=31)
    return b"".join([*map(packer.compress, ZEROS), packer.flush()])


def zip_members(data: bytes, rng: random.Random) -> bytes:
    """Make a zip whose members are broken one by one: JSON in its values, all else in its bytes."""
    members = mutations.unzipped(data)
    name = rng.choice(sorted(members))
    kind = rng.choice(("content", "content", "content", "drop", "rename", "swap", "bomb"))
    if kind == "content":
        is_json = name.endswith(".json")
        change = mutations.json_values if is_json else rng.choice((webp_size, mutations.any_bytes))
        members[name] = change(members[name], rng)
    elif kind == "drop":
        del members[name]
    elif kind == "rename":
        members[rng.choice(("other", "../x.webp", "meta.json/x", "/etc/passwd"))] = members.pop(name)
    elif kind == "swap":
        other = rng.choice(sorted(members))
        members[name], members[other] = members[other], members[name]
    elif rng.random() < 0.2:
        members[name] = ZEROS
    return mutations.zipped(members)


def webp_size(data: bytes, rng: random.Random) -> bytes:
    """Make a lossless WebP that says that it has another size."""
    width, height = (rng.choice((1, 2, 64, 1024, 16384)) for _ in range(2))
    if data[12:16] != b"VP8L":
        return data
    bits = int.from_bytes(data[21:25], "little") & ~((1 << 28) - 1) | (height - 1) << 14 | (width - 1)
    return data[:21] + bits.to_bytes(4, "little") + data[25:]


def glb_inside(data: bytes, rng: random.Random) -> bytes:
    """Make a GLB with other JSON, or other lengths of its chunks."""
    (length,) = struct.unpack_from("<I", data, 12)
    if rng.random() < 0.2:
        changed = bytearray(data)
        at = rng.choice((4, 8, 12, 16, 20 + length, 24 + length))
        changed[at : at + 4] = struct.pack("<I", rng.choice((0, 1, 2, 3, 2**31, 2**32 - 1, rng.randrange(len(data)))))
        return bytes(changed)
    text = mutations.json_values(data[20 : 20 + length], rng)
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    head = struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A)
    return head + text + rest


FORMATS: tuple[tuple[str, str, Write, tuple[Mutation, ...]], ...] = (
    ("compressed PLY", "scene.compressed.ply", by_gsseg, (mutations.ply_header, mutations.any_bytes)),
    ("Mip-Splatting PLY", "mip.ply", mip_splatting, (mutations.ply_header, mutations.any_bytes)),
    ("2DGS PLY", "two.ply", two_scales, (mutations.ply_header, mutations.any_bytes)),
    ("SPZ 1", "scene.spz", scene_files.write_spz(1), (spz_inside, spz_inside, mutations.any_bytes)),
    ("SPZ 2", "scene.spz", scene_files.write_spz(2), (spz_inside, spz_inside, mutations.any_bytes)),
    ("SPZ 3", "scene.spz", by_gsseg, (spz_inside, spz_inside, mutations.any_bytes)),
    ("SPZ 4", "scene.spz", scene_files.write_spz(4), (spz_4_inside, spz_4_inside, mutations.any_bytes)),
    ("SOG 1", "scene.sog", scene_files.write_sog_1, (zip_members, zip_members, mutations.any_bytes)),
    ("SOG 2", "scene.sog", by_gsseg, (zip_members, zip_members, mutations.any_bytes)),
    ("SOG meta.json", "meta.json", scene_files.unzipped, (mutations.json_values, mutations.any_bytes)),
    ("splat", "scene.splat", by_gsseg, (mutations.numbers, mutations.any_bytes)),
    ("ksplat", "scene.ksplat", scene_files.write_ksplat(1), (mutations.numbers, mutations.any_bytes)),
    ("GLB", "scene.glb", by_gsseg, (glb_inside, glb_inside, mutations.any_bytes)),
    ("glTF", "scene.gltf", scene_files.write_gltf, (mutations.json_values, mutations.any_bytes)),
    ("gsplat checkpoint", "scene.pt", scene_files.write_gsplat, (zip_members, mutations.any_bytes)),
    ("nerfstudio checkpoint", "scene.ckpt", scene_files.write_splatfacto, (zip_members, mutations.any_bytes)),
)
"""Name, file, how it is written, and what breaks it."""


def dataparser(folder: Path) -> None:
    """Write the frame of nerfstudio's training, in which nothing moves."""
    matrix = [[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0]]
    (folder / "dataparser_transforms.json").write_text(json.dumps({"transform": matrix, "scale": 1.0}))
