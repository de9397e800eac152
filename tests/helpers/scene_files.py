"""Scene files in every format that gsseg reads, written from the definitions of the formats or by other libraries."""

from __future__ import annotations

import fcntl
import gzip
import io
import json
import struct
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from gsseg_core.scene.gaussian_scene import GaussianScene

EXTENT = 4.0
C0 = 0.28209479177387814
FLIP_SPZ, FLIP_GLTF = np.array([1, -1, -1]), np.array([-1, -1, 1])


def some_scene(n: int = 300, degree: int = 3, seed: int = 0) -> GaussianScene:
    """Gaussians in no order, with values as trained ones have them."""
    rng = np.random.default_rng(seed)
    sh = rng.uniform(-0.3, 0.3, (n, (degree + 1) ** 2, 3))
    sh[:, 0] = rng.uniform(-1.5, 1.5, (n, 3))
    means = rng.uniform(-EXTENT / 2, EXTENT / 2, (n, 3)).astype(np.float32)
    scales, opacities = np.exp(rng.uniform(-6, -1, (n, 3))), rng.uniform(0.05, 0.95, n)
    return GaussianScene.from_arrays(means, rng.normal(size=(n, 4)), scales, opacities, sh)


def half_turned(scene: GaussianScene, signs: np.ndarray) -> dict[str, np.ndarray]:
    """A scene in axes of which two point the other way: each harmonic is odd or even in x, y and z."""
    odd = [
        "", "y", "z", "x", "xy", "yz", "", "xz", "", "y", "xyz", "y", "z", "x", "z", "x",
    ]  # fmt: skip
    sh_signs = np.array([np.prod([signs["xyz".index(axis)] for axis in axes]) for axes in odd])
    return {
        "means": scene.means * signs,
        "quats": scene.quats * np.concatenate([[1], signs]),
        "scales": scene.scales,
        "opacities": scene.opacities,
        "sh": scene.sh * sh_signs[: scene.sh.shape[1], None],
    }


def by_library(kind: str, **options: int) -> Callable[[Path, GaussianScene], None]:
    """Have gaussforge write a file; it turns nothing."""

    def write(path: Path, scene: GaussianScene) -> None:
        import gaussforge

        ply = path.with_name("for_gaussforge.ply")
        scene.save(ply)
        made = gaussforge.GaussForge().convert(ply.read_bytes(), "ply", kind, **options)
        assert "error" not in made, made
        path.write_bytes(made["data"])

    return write


@contextmanager
def gsply_alone() -> Iterator[None]:
    """Keep other workers from compiling what gsply compiles here: seconds later they find it in its cache."""
    import gsply

    with open(gsply.__file__) as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def write_compressed_ply(path: Path, scene: GaussianScene) -> None:
    """Have gsply write a compressed PLY."""
    import gsply

    scene.save(path.with_name("for_gsply.ply"))
    with gsply_alone():
        gsply.plywrite(str(path), gsply.plyread(str(path.with_name("for_gsply.ply"))), compressed=True)


def spz_body(scene: GaussianScene, version: int, *, turned: bool = True) -> bytes:
    """The bytes of SPZ before they are packed, 12 fractional bits."""
    there = half_turned(scene, FLIP_SPZ if turned else np.ones(3))
    if version == 1:
        positions = there["means"].astype("<f2").tobytes()
    else:
        whole = np.round(there["means"] * 4096).astype("<i4")
        positions = whole.reshape(-1, 1).view(np.uint8)[:, :3].tobytes()
    alphas = np.round(there["opacities"] * 255).astype(np.uint8)
    colors = np.clip(np.round((there["sh"][:, 0] * 0.15 + 0.5) * 255), 0, 255).astype(np.uint8)
    scales = np.round((np.log(there["scales"]) + 10) * 16).astype(np.uint8)
    xyzw = there["quats"][:, [1, 2, 3, 0]]
    if version < 3:
        xyz = xyzw[:, :3] * np.where(xyzw[:, 3:] < 0, -1, 1)
        rotations = np.round(xyz * 127.5 + 127.5).astype(np.uint8)
    else:
        rotations = np.array([_smallest_three(q) for q in xyzw], "<u4").view(np.uint8)
    rest = np.clip(np.round(there["sh"][:, 1:] * 128 + 128), 0, 255).astype(np.uint8)
    header = struct.pack("<4sIIBBBB", b"NGSP", version, len(scene), scene.sh_degree, 12, 0, 0)
    return header + positions + b"".join(part.tobytes() for part in (alphas, colors, scales, rotations, rest))


def _smallest_three(quaternion: np.ndarray) -> int:
    largest = int(np.abs(quaternion).argmax())
    word = largest
    for i in range(4):
        if i != largest:
            value = quaternion[i] * np.sign(quaternion[largest])
            word = word << 10 | int(value < 0) << 9 | round(abs(value) * np.sqrt(2) * 511)
    return word


def write_spz(version: int) -> Callable[[Path, GaussianScene], None]:
    """SPZ of a version under gzip, or 4: each attribute under zstd."""

    def write(path: Path, scene: GaussianScene) -> None:
        body = spz_body(scene, version)
        path.write_bytes(gzip.compress(body) if version < 4 else spz_4(body, scene))

    return write


def spz_4(body: bytes, scene: GaussianScene, extensions: bytes = b"") -> bytes:
    """Put a body into the container of version 4."""
    import zstandard

    n, place, streams = len(scene), 16, []
    for size in (9 * n, n, 3 * n, 3 * n, 4 * n, len(body) - 16 - 20 * n):
        if size:
            streams.append((size, zstandard.ZstdCompressor().compress(body[place : place + size])))
        place += size
    header = struct.pack(
        "<4sIIBBBBI12x", b"NGSP", 4, n, scene.sh_degree, 12, 2 * bool(extensions), len(streams), 32 + len(extensions)
    )
    table = b"".join(struct.pack("<QQ", len(packed), size) for size, packed in streams)
    return header + extensions + table + b"".join(packed for _, packed in streams)


def write_sog_1(path: Path, scene: GaussianScene) -> None:
    """SOG of version 1 in a zip: everything between extremes; SH of as many palette entries as Gaussians."""
    n, width = len(scene), 64
    images: dict[str, np.ndarray] = {}

    def between(values: np.ndarray, steps: int) -> tuple[np.ndarray, list[float], list[float]]:
        low, high = values.min(axis=0), values.max(axis=0)
        return np.round((values - low) / np.maximum(high - low, 1e-9) * steps).astype(int), low.tolist(), high.tolist()

    def image(pixels: np.ndarray) -> np.ndarray:
        out = np.full((-(-n // width) * width, 4), 255, np.uint8)
        out[: len(pixels), : pixels.shape[1]] = pixels
        return out.reshape(-1, width, 4)

    logs = np.sign(scene.means) * np.log1p(np.abs(scene.means))
    places, low, high = between(logs, 65535)
    images["means_l.webp"], images["means_u.webp"] = image(places & 255), image(places >> 8)
    meta = {"means": {"shape": [n, 3], "mins": low, "maxs": high, "files": ["means_l.webp", "means_u.webp"]}}
    sizes, low, high = between(np.log(scene.scales), 255)
    images["scales.webp"], meta["scales"] = image(sizes), {"mins": low, "maxs": high, "files": ["scales.webp"]}
    logits = np.log(scene.opacities / (1 - scene.opacities))[:, None]
    colors, low, high = between(np.concatenate([scene.sh[:, 0], logits], axis=1), 255)
    images["sh0.webp"], meta["sh0"] = image(colors), {"mins": low, "maxs": high, "files": ["sh0.webp"]}
    quats = np.empty((n, 4), int)
    for i, quaternion in enumerate(scene.quats):
        largest = int(np.abs(quaternion).argmax())
        others = np.delete(quaternion, largest) * np.sign(quaternion[largest])
        quats[i] = (*np.round((others * np.sqrt(2) + 1) / 2 * 255), 252 + largest)
    images["quats.webp"], meta["quats"] = image(quats), {"files": ["quats.webp"]}
    if scene.sh_degree:
        rest = scene.sh[:, 1:]
        bands, low_sh, high_sh = rest.shape[1], float(rest.min()), float(rest.max())
        palette = np.zeros((-(-n // 64) * 64, bands, 3), np.uint8)
        palette[:n] = np.round((rest - low_sh) / (high_sh - low_sh) * 255)
        images["shN_centroids.webp"] = palette.reshape(-1, 64 * bands, 3)
        labels = np.arange(n)
        images["shN_labels.webp"] = image(np.stack([labels & 255, labels >> 8, 0 * labels], axis=1))
        files = ["shN_centroids.webp", "shN_labels.webp"]
        meta["shN"] = {"mins": low_sh, "maxs": high_sh, "files": files}
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("meta.json", json.dumps(meta))
        for name, pixels in images.items():
            archive.writestr(name, webp(pixels))


def webp(pixels: np.ndarray) -> bytes:
    """A lossless WebP image."""
    out = io.BytesIO()
    Image.fromarray(pixels).save(out, "WEBP", lossless=True, exact=True)
    return out.getvalue()


def unzipped(path: Path, scene: GaussianScene) -> None:
    """SOG as a folder, by its meta.json."""
    write_sog_1(path.with_suffix(".sog"), scene)
    with zipfile.ZipFile(path.with_suffix(".sog")) as archive:
        archive.extractall(path.parent)


def write_ksplat(level: int) -> Callable[[Path, GaussianScene], None]:
    """A `.ksplat` of one section."""

    def write(path: Path, scene: GaussianScene) -> None:
        write_ksplat_sections(path, level, [scene])

    return write


def write_ksplat_sections(path: Path, level: int, scenes: list[GaussianScene]) -> None:
    """A `.ksplat` of a section for each scene, of SH degree 2 at most."""
    sections = [_ksplat_section(level, scene) for scene in scenes]
    count, total = len(sections), sum(map(len, scenes))
    head = struct.pack("<4B4IH", 0, 1, 0, 0, count, count, total, total, level).ljust(4096, b"\0")
    path.write_bytes(head + b"".join(header for header, _ in sections) + b"".join(data for _, data in sections))


def _ksplat_section(level: int, scene: GaussianScene) -> tuple[bytes, bytes]:
    """Header and data: buckets of 64 Gaussians in the order of the scene, and a last one with the rest."""
    n, size, steps, block = len(scene), 64, 32767, 2 * EXTENT
    full, rest = divmod(n, size)
    centers = np.array([scene.means[i * size : (i + 1) * size].mean(axis=0) for i in range(full + (rest > 0))])
    place, number, harmonic = (("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1"))[level]
    bands = min(scene.sh_degree, 2)
    count = 3 * ((bands + 1) ** 2 - 1)
    kinds = [("mean", place, 3), ("scale", number, 3), ("quat", number, 4), ("rgba", "u1", 4)]
    records = np.zeros(n, [*kinds, ("sh", harmonic, (count,))])
    offsets = scene.means - centers.repeat(size, axis=0)[:n]
    records["mean"] = scene.means if level == 0 else np.round(offsets / (block / 2 / steps) + steps)
    records["scale"], records["quat"] = scene.scales, scene.quats
    records["rgba"] = np.round(255 * np.c_[np.clip(scene.sh[:, 0] * C0 + 0.5, 0, 1), scene.opacities])
    sh = [scene.sh[:, d * d : (d + 1) ** 2].transpose(0, 2, 1).reshape(n, -1) for d in range(1, bands + 1)]
    values = np.concatenate(sh, axis=1) if sh else np.zeros((n, 0))
    records["sh"] = np.round((values + 1.5) / 3 * 255) if level == 2 else values
    partial = struct.pack("<I", rest) if rest else b""
    data = partial + centers.astype("<f4").tobytes() + records.tobytes()
    header = struct.pack("<4IfH2x", n, n, size, len(centers), block, 12)
    header += struct.pack("<4IH", steps, len(data), full, int(rest > 0), bands)
    return header.ljust(1024, b"\0"), data


def glb_parts(scene: GaussianScene, **node: object) -> tuple[dict[str, object], bytes]:
    """The JSON of a glTF with one node, and its buffer."""
    there = half_turned(scene, FLIP_GLTF)
    prefix = "KHR_gaussian_splatting:"
    arrays = {
        "POSITION": there["means"], f"{prefix}ROTATION": there["quats"][:, [1, 2, 3, 0]],
        f"{prefix}SCALE": there["scales"], f"{prefix}OPACITY": there["opacities"][:, None],
    }  # fmt: skip
    for degree in range(scene.sh_degree + 1):
        for i in range(2 * degree + 1):
            arrays[f"{prefix}SH_DEGREE_{degree}_COEF_{i}"] = there["sh"][:, degree * degree + i]
    buffer, views, accessors = b"", [], []
    for values in arrays.values():
        content = values.astype("<f4").tobytes()
        views.append({"buffer": 0, "byteOffset": len(buffer), "byteLength": len(content)})
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[values.shape[1]]
        accessors.append({"bufferView": len(views) - 1, "componentType": 5126, "count": len(values), "type": kind})
        buffer += content
    primitive = {
        "mode": 0, "attributes": {name: i for i, name in enumerate(arrays)},
        "extensions": {"KHR_gaussian_splatting": {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }  # fmt: skip
    document = {
        "asset": {"version": "2.0"}, "extensionsUsed": ["KHR_gaussian_splatting"], "scene": 0,
        "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0, **node}], "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": len(buffer)}], "bufferViews": views, "accessors": accessors,
    }  # fmt: skip
    return document, buffer


def glb(document: object, buffer: bytes) -> bytes:
    """A GLB of JSON and a buffer."""
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(buffer), 0x004E4942) + buffer
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def write_glb(path: Path, scene: GaussianScene) -> None:
    """A GLB of one node."""
    path.write_bytes(glb(*glb_parts(scene)))


def write_gltf(path: Path, scene: GaussianScene) -> None:
    """A glTF with its buffer in a file beside it."""
    document, buffer = glb_parts(scene)
    document["buffers"] = [{"byteLength": len(buffer), "uri": "splats.bin"}]
    path.write_text(json.dumps(document))
    path.with_name("splats.bin").write_bytes(buffer)


def stored(scene: GaussianScene) -> dict[str, torch.Tensor]:
    """What a trainer learns: logarithms of scales, logits of opacities."""
    values = {
        "means": scene.means, "quats": scene.quats, "scales": np.log(scene.scales),
        "opacities": np.log(scene.opacities / (1 - scene.opacities)), "sh0": scene.sh[:, :1], "shN": scene.sh[:, 1:],
    }  # fmt: skip
    return {name: torch.from_numpy(np.ascontiguousarray(array)) for name, array in values.items()}


def write_gsplat(path: Path, scene: GaussianScene) -> None:
    """A checkpoint of gsplat's trainer."""
    torch.save({"step": 29999, "splats": stored(scene)}, path)


def write_splatfacto(path: Path, scene: GaussianScene) -> None:
    """A checkpoint of nerfstudio."""
    named = stored(scene)
    named["features_dc"], named["features_rest"] = named.pop("sh0")[:, 0], named.pop("shN")
    named["opacities"] = named["opacities"][:, None]
    pipeline = {f"_model.gauss_params.{name}": tensor for name, tensor in named.items()}
    torch.save({"step": 29999, "pipeline": pipeline | {"_model.camera_optimizer.x": torch.zeros(3)}}, path)
