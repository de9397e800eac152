"""PlayCanvas' SOG, versions 1 and 2: WebP images of one pixel per Gaussian, in a folder or a zip, and `meta.json`."""

from __future__ import annotations

import io
import json
import os
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from gsseg_core.errors import SceneFileError
from gsseg_core.files.input_files import UnfitError, check_pixels, open_expected
from gsseg_core.files.json_files import kind_of, read_json, whole_number
from gsseg_core.files.limits import LIMITS
from gsseg_core.scene.quaternions import from_smallest_three
from gsseg_core.scene.scene_file import check_count, open_scene, size_of
from gsseg_core.scene.vertices import ReadScene, logits, pack_vertices
from gsseg_core.text import quoted

_META = "meta.json"
_EXPECTED = "a SOG scene"
PER_ROW = 64  # entries of the palette of SH in a row of its image
# Bytes of an image: of four per pixel at most, for four pixels per Gaussian, or for the palette of SH.
_PER_GAUSSIAN, _PER_IMAGE = 16, 1 << 23

Pixels = npt.NDArray[np.uint8]  # (H * W, C)
Load = Callable[[str, int], bytes]  # a file by its name, of so many bytes at most


def is_sog(head: bytes) -> bool:
    """Whether a file begins as SOG: a zip that is neither PyTorch's checkpoint nor NumPy's npz, or a `meta.json`."""
    if head.startswith(b"PK\x03\x04"):
        return not any(member in head[:256] for member in (b"data.pkl", b".npy"))
    return head.lstrip()[:1] == b"{" and b'"means"' in head and b'"quats"' in head


def read_sog(path: Path, within: Path | None = None) -> ReadScene:
    """Read a SOG scene: a zip, the `meta.json` of a folder, or that folder."""
    if os.path.isdir(path):  # Unlike `Path.is_dir`, false where one may not even look.
        path = path / _META
    with open_scene(path, within, _EXPECTED) as file:
        if file.peek(2)[:2] != b"PK":
            return _decode(
                read_json(path, SceneFileError, within), lambda name, most: _beside(path, name, most, within)
            )
        with zipfile.ZipFile(file) as archive:
            if _META not in archive.namelist():
                found = quoted(", ".join(archive.namelist()))
                raise UnfitError(f"is a zip of {found}, without SOG's {_META}: unpack it, and give the scene in it")
            content = json.loads(_member(archive, _META, LIMITS.max_json_bytes))
            return _decode(content, lambda name, most: _member(archive, name, most))


def _member(archive: zipfile.ZipFile, name: str, most: int) -> bytes:
    info = archive.getinfo(name)
    if max(info.file_size, info.compress_size) > most:
        raise UnfitError(f"claims {info.file_size:,} bytes of {quoted(name)}; expected at most {most:,}")
    return archive.read(info)


def _beside(meta: Path, name: str, most: int, within: Path | None) -> bytes:
    with open_expected(meta.parent / name, SceneFileError, f"an image, as {_META} names it", within) as file:
        if size_of(file) > most:
            raise UnfitError(f"has {size_of(file):,} bytes of {quoted(name)}; expected at most {most:,}")
        return file.read()


def _decode(meta: Any, load: Load) -> ReadScene:
    if not isinstance(meta, dict):
        raise UnfitError(f"{_META} holds {kind_of(meta)}; expected an object")
    if "lodLevels" in meta:
        raise UnfitError(
            f"lists SOG scenes in {quoted(meta['lodLevels'])} levels of detail; expected one of them, such as "
            "0_0/meta.json, or the scene that they were made of"
        )
    version = whole_number(meta.get("version", 1), "version", 1, 2)
    count = meta["count"] if version == 2 else meta["means"]["shape"][0]
    check_count(whole_number(count, "count", 0, 2**63))

    def pixels(part: str, index: int = 0) -> Pixels:
        return _pixels(meta[part]["files"][index], load, count)

    sh0 = pixels("sh0")
    dc, opacity = sh0[:, :3], sh0[:, 3:]
    vertices = pack_vertices(
        _means(meta["means"], pixels("means", 0), pixels("means", 1)),
        _rotations(pixels("quats")),
        _values(meta["scales"], pixels("scales")[:, :3]),
        # Version 1 stores logits between extremes, version 2 opacities.
        logits(opacity[:, 0] / 255) if version == 2 else _values(meta["sh0"], opacity, 3)[:, 0],
        _values(meta["sh0"], dc),
        _rest(meta["shN"], pixels("shN", 1), load) if meta.get("shN") else None,
    )
    return ReadScene(vertices, str(version))


@contextmanager
def _image(name: object, load: Load, count: int) -> Iterator[Image.Image]:
    if not isinstance(name, str) or not name or Path(name).name != name or "\\" in name:
        raise UnfitError(f"names the image {quoted(name)}; expected the name of a file beside {_META}")
    with Image.open(io.BytesIO(load(name, _PER_GAUSSIAN * count + _PER_IMAGE)), formats=("WEBP", "PNG")) as image:
        check_pixels(*image.size, name, UnfitError)  # type: ignore[arg-type]
        yield image


def _pixels(name: object, load: Load, count: int) -> Pixels:
    """Read the pixels (N, 4) of an image, one per Gaussian."""
    with _image(name, load, count) as image:
        size = image.width * image.height
        if not count <= size <= 4 * count + (1 << 16):
            raise UnfitError(f"has {size:,} pixels in {quoted(name)}; expected one for each of {count:,}, or few more")
        return np.asarray(image.convert("RGBA")).reshape(-1, 4)[:count]


def _numbers(
    values: Any, what: str, count: int | None = None, dtype: npt.DTypeLike = np.float32
) -> npt.NDArray[np.floating]:
    with np.errstate(over="ignore"):  # What is infinite then is reported by the scene.
        numbers: npt.NDArray[np.floating] = np.asarray(values, dtype).reshape(-1)
    if count is not None and len(numbers) != count:
        raise UnfitError(f"has {len(numbers)} numbers in {what}; expected {count}")
    return numbers


def _means(meta: Any, low: Pixels, high: Pixels) -> npt.NDArray[np.floating]:
    """Positions (N, 3), of which sign(x) ln(1 + |x|) is stored in 16 bits between extremes."""
    steps = (low[:, :3] | high[:, :3].astype(np.uint16) << 8) / 65535
    # In float32 the logarithm of what is 4,000 km away would be off by metres.
    least, most = (_numbers(meta[key], f"means.{key}", 3, np.float64) for key in ("mins", "maxs"))
    with np.errstate(all="ignore"):  # What is NaN or infinite is reported by the scene.
        logs = least + steps * (most - least)
        return np.sign(logs) * np.expm1(np.abs(logs))


def _values(meta: Any, pixels: Pixels, first: int = 0) -> npt.NDArray[np.floating]:  # (N, C)
    """Values of bytes: by a code book of 256, or in version 1 between extremes of each channel."""
    if "codebook" in meta:
        return _numbers(meta["codebook"], "codebook", 256)[pixels]
    channels = slice(first, first + pixels.shape[1])
    least, most = (_extremes(meta[key], key)[channels] for key in ("mins", "maxs"))
    return least + pixels / np.float32(255) * (most - least)


def _extremes(values: Any, what: str) -> npt.NDArray[np.floating]:
    """Take extremes of up to four channels; a single number is that of all."""
    numbers = _numbers(values, what)
    return numbers if len(numbers) > 1 else numbers.repeat(4)


def _rotations(pixels: Pixels) -> npt.NDArray[np.float32]:
    """Quaternions (N, 4) of pixels: alpha tells which of w, x, y, z is largest, the colours are the other three."""
    largest = pixels[:, 3].astype(np.int64) - 252
    if largest.min(initial=0) < 0:
        raise UnfitError(f"has rotations of kind {pixels[:, 3].min()}; expected 252 to 255 (is the image lossless?)")
    others = (pixels[:, :3] / np.float32(255) * 2 - 1) * np.float32(np.sqrt(0.5))
    return from_smallest_three(largest, others)


def _rest(meta: Any, labels: Pixels, load: Load) -> npt.NDArray[np.floating]:
    """Coefficients (N, B, 3) of SH above degree 0: each Gaussian names an entry of a palette."""
    with _image(meta["files"][0], load, len(labels)) as image:
        palette = np.asarray(image.convert("RGB"))
    coefficients = palette.shape[1] // PER_ROW
    if coefficients not in (3, 8, 15) or palette.shape[1] % PER_ROW:
        raise UnfitError(f"has a palette of SH {palette.shape[1]} pixels wide; expected 192, 512 or 960")
    entries = palette.reshape(-1, coefficients, 3)
    index = labels[:, 0].astype(np.int64) | labels[:, 1].astype(np.int64) << 8
    if index.max(initial=0) >= len(entries):
        raise UnfitError(f"names entry {index.max():,} of a palette of SH; expected at most {len(entries) - 1:,}")
    return _values(meta, entries.reshape(-1, 3)).reshape(entries.shape)[index]
