"""Niantic's SPZ, versions 1 to 4: bytes and 24-bit numbers, attribute after attribute, under gzip or zstd."""

from __future__ import annotations

import gzip
import math
import struct
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
import numpy.typing as npt

from gsseg_core.files.input_files import UnfitError
from gsseg_core.scene.moving import move
from gsseg_core.scene.quaternions import from_smallest_three
from gsseg_core.scene.scene_file import check_count, check_size, open_scene
from gsseg_core.scene.spherical_harmonics import MAX_DEGREE
from gsseg_core.scene.vertices import SH_LEFT_OUT, ReadScene, logits, pack_in_blocks, pack_vertices

_MAGIC = b"NGSP"
_GZIP = b"\x1f\x8b\x08"  # deflated, as all are
_HEADER = struct.Struct("<4sIIBBBB")  # magic, version, count, SH degree, fractional bits, flags, reserved or streams
_HEADER_4 = 32  # from version 4 on; the offset of the table of streams follows those above
_ANTIALIASED, _EXTENSIONS = 1, 2
_COORDINATE_SYSTEM = 0xADBE0003
# Deflate packs a thousand bytes into one at best. Real scenes are packed into half of their bytes, or a tenth where SH
# are all zero: what is large and far denser was made to be inflated.
_DENSEST, _SMALL, _DENSE = 1032, 1 << 26, 100
_LOGITS = logits(np.arange(256) / 255).astype(np.float32)
_COLOR_SCALE = 0.15  # of coefficients of degree 0, so that colours beyond [0, 1] fit
# The axes of the file, by the number that the extension SPZ_ADOBE_coordinate_system says; 0 and none mean RUB.
_SYSTEMS = (
    "RUB", "LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF",
    "LFD", "RFD", "LFU", "RFU", "LBD", "RBD", "LBU", "RBU",
)  # fmt: skip
# Each direction in the axes of a PLY: right, down, front.
_AXES = {"R": (1, 0, 0), "L": (-1, 0, 0), "D": (0, 1, 0), "U": (0, -1, 0), "F": (0, 0, 1), "B": (0, 0, -1)}

Read = Callable[[int], bytes]  # reads so many bytes of an attribute, or fewer where it ends


class _Header(NamedTuple):
    version: int
    gaussians: int
    degree: int
    fractional_bits: int
    flags: int

    @property
    def sizes(self) -> list[int]:
        """Bytes of the position, alpha, colour, scales, rotation and SH of a Gaussian."""
        position, rotation = (6 if self.version == 1 else 9), (4 if self.version >= 3 else 3)
        return [position, 1, 3, 3, rotation, 3 * ((self.degree + 1) ** 2 - 1)]


def is_spz(head: bytes) -> bool:
    """Whether a file begins as SPZ does; the reader refuses what is gzipped and no SPZ."""
    return head.startswith((_MAGIC, _GZIP))


def read_spz(path: Path, within: Path | None = None) -> ReadScene:
    """Read an SPZ file into the axes of a PLY, which are right, down, front.

    Those of the file are right, up, back unless it says others. SH of degree 4 are left out. Version 4 needs the
    package zstandard.
    """
    with open_scene(path, within, "an SPZ file") as file:
        return decode_spz(file)


def decode_spz(file: BinaryIO) -> ReadScene:
    """Decode SPZ from an open binary file; raises what `open_scene` takes for damage."""
    magic, length = file.read(4), file.seek(0, 2)
    file.seek(0)
    if magic.startswith(_GZIP):
        header, system, readers = _inflate(file, length)
    elif magic == _MAGIC:
        header, system, readers = _streams(file, length)
    else:
        raise ValueError("it starts neither with NGSP nor as gzip does")
    count, (*before, of_sh) = header.gaussians, header.sizes
    parts = [_rows(next(readers), count, size) for size in before]
    turn = None if system == "RDF" else np.array([_AXES[letter] for letter in system], np.float64).T
    read_sh = next(readers)

    def pack(block: slice) -> npt.NDArray[np.void]:
        # SH, two thirds of all bytes, come last and are inflated as they are packed.
        sh = _rows(read_sh, len(parts[0][block]), of_sh)
        return _pack(header, [*(part[block] for part in parts), sh], turn)

    vertices = pack_in_blocks(count, pack)
    next(readers, None)
    remarks = [SH_LEFT_OUT] if header.degree > MAX_DEGREE else []
    if header.flags & _ANTIALIASED:
        remarks.append("trained with antialiasing, which is left out")
    if system != "RUB":
        remarks.append(f"axes {system}, as the file says")
    return ReadScene(vertices, str(header.version), tuple(remarks))


def _header(content: bytes) -> _Header:
    check_size(len(content), _HEADER.size, "header")
    magic, version, count, degree, bits, flags, _ = _HEADER.unpack_from(content)
    if magic != _MAGIC:
        raise ValueError("its header does not start with NGSP")
    if not 1 <= version <= 4:
        raise UnfitError(f"is SPZ of version {version}; expected 1 to 4")
    if degree > 4 or bits > 24:
        raise UnfitError(f"has SH of degree {degree} and {bits} fractional bits; expected at most 4, and 24")
    check_count(count)
    return _Header(version, count, degree, bits, flags)


def _check_packed(header: _Header, size: int) -> None:
    """Raise `UnfitError`, before anything is inflated, if a file of this size cannot hold what its header claims."""
    claimed = header.gaussians * sum(header.sizes)
    check_size(size * (_DENSEST if claimed <= _SMALL else _DENSE), claimed, f"{header.gaussians:,} Gaussians")


def _rows(read: Read, count: int, size: int) -> npt.NDArray[np.uint8]:
    """Read an attribute of some Gaussians, (count, size)."""
    content = read(count * size)
    check_size(len(content), count * size, "data")
    return np.frombuffer(content, np.uint8).reshape(count, size)


def _inflate(file: BinaryIO, length: int) -> tuple[_Header, str, Iterator[Read]]:
    """Open gzip, of versions 1 to 3: header, axes, and a reader of each attribute, to be read to its end in turn."""
    stream = gzip.GzipFile(fileobj=file)
    header = _header(stream.read(_HEADER.size))
    if header.version > 3:
        raise UnfitError(f"is SPZ of version {header.version} under gzip; expected 1 to 3")
    _check_packed(header, length)
    if header.flags & _EXTENSIONS:
        raise UnfitError("has extensions under gzip; expected them in version 4 alone")

    def readers() -> Iterator[Read]:
        yield from [stream.read] * len(header.sizes)
        if stream.read(1):  # Only at the end the checksum is compared.
            raise UnfitError(f"holds more than {header.gaussians:,} Gaussians, as many as its header says")

    return header, "RUB", readers()


def _streams(file: BinaryIO, length: int) -> tuple[_Header, str, Iterator[Read]]:
    """Open the streams of version 4, as `_inflate` does; the file leaves out those of no bytes."""
    try:
        from zstandard import ZstdDecompressor, ZstdError
    except ImportError as error:
        raise UnfitError(
            "is SPZ of version 4, which takes the package zstandard: pip install 'gsseg[formats]'"
        ) from error
    content = file.read(_HEADER_4)
    header = _header(content)
    check_size(len(content), _HEADER_4, "header")
    count, table = content[15], int.from_bytes(content[16:20], "little")
    wanted = [header.gaussians * size for size in header.sizes if header.gaussians * size]
    if header.version < 4 or not _HEADER_4 <= table <= 1 << 20 or count != len(wanted):
        raise UnfitError(f"has {count} streams in version {header.version}; expected {len(wanted)}, and version 4")
    system = _axes_of(file.read(table - _HEADER_4)) if header.flags & _EXTENSIONS else "RUB"
    file.seek(table)
    sizes = struct.unpack(f"<{2 * count}Q", file.read(16 * count))
    _check_packed(header, length)
    if list(sizes[1::2]) != wanted:
        raise UnfitError(f"has streams of {sizes[1::2]} bytes; expected {wanted} for its Gaussians")

    def reader(packed: int, size: int) -> Read:
        content = file.read(min(packed, 2 * size + (1 << 20)))  # Zstd makes nothing much larger.
        stream = ZstdDecompressor().stream_reader(content)

        def read(count: int) -> bytes:
            try:
                return stream.read(count)
            except ZstdError as error:
                raise ValueError(str(error)) from error

        return read

    streams = iter(zip(sizes[::2], wanted, strict=True))
    every = (reader(*next(streams)) if header.gaussians * size else BytesIO().read for size in header.sizes)
    return header, system, every


def _axes_of(extensions: bytes) -> str:
    """Find the axes in the extensions: records of a type, a length, and as many bytes."""
    place = 0
    while place + 8 <= len(extensions):
        kind, size = struct.unpack_from("<II", extensions, place)
        if kind == _COORDINATE_SYSTEM and size >= 4:
            number = int.from_bytes(extensions[place + 8 : place + 12], "little")
            if number >= len(_SYSTEMS):
                raise UnfitError(f"says that its axes are number {number}; expected 0 to {len(_SYSTEMS) - 1}")
            return _SYSTEMS[number]
        place += 8 + size
    return "RUB"


def _pack(
    header: _Header, parts: list[npt.NDArray[np.uint8]], turn: npt.NDArray[np.float64] | None
) -> npt.NDArray[np.void]:
    """Pack Gaussians of their bytes (N, ...), attribute by attribute, and turn them to the axes of a PLY."""
    position, alpha, color, scale, rotation, sh = parts
    coefficients = (min(header.degree, MAX_DEGREE) + 1) ** 2 - 1
    vertices = pack_vertices(
        _positions(position, header),
        _rotations(rotation),
        scale / np.float32(16) - np.float32(10),
        _LOGITS[alpha[:, 0]],
        (color / np.float32(255) - np.float32(0.5)) / np.float32(_COLOR_SCALE),
        _harmonics(sh, coefficients) if coefficients else None,
    )
    if turn is not None:
        move(vertices, turn)
    return vertices


def _harmonics(packed: npt.NDArray[np.uint8], coefficients: int) -> npt.NDArray[np.float32]:  # (N, 3 B)
    """Coefficients (N, B, 3) of SH above degree 0, the first B of those in the file: bytes of which 128 is 0."""
    # Sorted by colour while they are bytes, as a PLY has them: a quarter of what floats would move.
    by_color = packed.reshape(len(packed), -1, 3)[:, :coefficients].transpose(0, 2, 1) ^ np.uint8(128)
    values: npt.NDArray[np.float32] = np.ascontiguousarray(by_color).view(np.int8) * np.float32(1 / 128)
    return values.transpose(0, 2, 1)


def _positions(packed: npt.NDArray[np.uint8], header: _Header) -> npt.NDArray[np.floating]:
    """Positions (N, 3): half floats in version 1, else signed 24-bit numbers with a fixed point."""
    if header.version == 1:
        return np.ascontiguousarray(packed).view("<f2").reshape(-1, 3).astype(np.float32)
    wide = np.zeros((3 * len(packed), 4), np.uint8)
    wide[:, 1:] = packed.reshape(-1, 3)
    # Shifted down from the upper bytes, the sign comes along.
    return (wide.view("<i4").reshape(-1, 3) >> 8) * np.float32(math.ldexp(1, -header.fractional_bits))


def _rotations(packed: npt.NDArray[np.uint8]) -> npt.NDArray[np.floating]:  # (N, 3) or (N, 4)
    """Quaternions (N, 4) w, x, y, z: of three bytes x, y, z, or of three components in ten bits each, of x, y, z, w."""
    if packed.shape[1] == 3:
        others = packed / np.float32(127.5) - np.float32(1)
        return from_smallest_three(np.zeros(len(packed), int), others)
    bits = np.ascontiguousarray(packed).view("<u4")[:, 0]
    others = np.empty((len(packed), 3), np.float32)
    for i, shift in enumerate((20, 10, 0)):
        size = ((bits >> np.uint32(shift)) & np.uint32(511)).astype(np.float32) * np.float32(math.sqrt(0.5) / 511)
        others[:, i] = np.where(bits >> np.uint32(shift + 9) & np.uint32(1), -size, size)
    return from_smallest_three(bits >> np.uint32(30), others)[:, [3, 0, 1, 2]]
