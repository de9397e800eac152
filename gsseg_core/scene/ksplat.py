"""The `.ksplat` of GaussianSplats3D: sections of buckets, as floats or as 16-bit numbers about a bucket's centre."""

from __future__ import annotations

import struct
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gsseg_core.files.input_files import UnfitError
from gsseg_core.scene.scene_file import check_size, open_scene
from gsseg_core.scene.vertices import REST_COUNTS, ReadScene, dc_of, log_scales, logits, pack_vertices

_HEADER, _SECTION = 4096, 1024  # bytes of the header of the file, and of each section
_SH_RANGE = (-1.5, 1.5)  # where the header says none


class _Section(NamedTuple):
    gaussians: int
    capacity: int
    bucket_size: int
    buckets: int
    block: float
    bucket_bytes: int
    scale_range: int
    full_buckets: int
    partial_buckets: int
    degree: int


def read_ksplat(path: Path, within: Path | None = None) -> ReadScene:
    """Read a `.ksplat` of version 0.1 and compression level 0 to 2."""
    with open_scene(path, within, "a .ksplat file") as file:
        content = file.read()
        check_size(len(content), _HEADER, "header")
        major, minor = content[0], content[1]
        sections, _, _, total, level = struct.unpack_from("<4IH", content, 4)
        if (major, minor) != (0, 1) or level > 2:
            raise UnfitError(f"is ksplat of version {major}.{minor}, level {level}; expected 0.1, level 0 to 2")
        place = _HEADER + sections * _SECTION
        check_size(len(content), place, f"{sections:,} headers of sections")
        low, high = struct.unpack_from("<2f", content, 36)
        sh_range = (low or _SH_RANGE[0], high or _SH_RANGE[1])
        headers = [_section(content, _HEADER + i * _SECTION) for i in range(sections)]
        highest = max((section.degree for section in headers), default=0)
        parts: list[npt.NDArray[np.void]] = []
        for section in headers:
            part, place = _read_section(content, place, section, level, sh_range, highest)
            parts.append(part)
        found = sum(map(len, parts))
        if found != total or not parts:
            raise UnfitError(f"claims {total:,} Gaussians and has {found:,} in its sections; expected as many")
    return ReadScene(np.concatenate(parts), f"0.1, level {level}")


def _section(content: bytes, place: int) -> _Section:
    section = _Section(*struct.unpack_from("<4IfH2xI4x2IH", content, place))
    count, capacity, degree = section.gaussians, section.capacity, section.degree
    if degree >= len(REST_COUNTS) or count > capacity:
        raise UnfitError(f"has a section of {count:,} in {capacity:,} and SH degree {degree}; expected degree 0 to 3")
    return section


def _record(level: int, degree: int) -> np.dtype[np.void]:
    place, number = ("<f4", "<f4") if level == 0 else ("<u2", "<f2")
    harmonic = ("<f4", "<f2", "u1")[level]
    return np.dtype(
        [
            ("mean", place, 3), ("scale", number, 3), ("quat", number, 4), ("rgba", "u1", 4),
            ("sh", harmonic, (REST_COUNTS[degree],)),
        ]
    )  # fmt: skip


def _read_section(
    content: bytes, place: int, section: _Section, level: int, sh_range: tuple[float, float], highest: int
) -> tuple[npt.NDArray[np.void], int]:
    """Read the section at `place`: its Gaussians, with SH of the highest degree, and where the next one starts."""
    record = _record(level, section.degree)
    centers_at = place + 4 * section.partial_buckets
    records_at = centers_at + section.bucket_bytes * section.buckets
    end = records_at + record.itemsize * section.capacity
    check_size(len(content), end, f"section of {section.capacity:,} Gaussians")
    records = np.frombuffer(content, record, section.gaussians, records_at)
    means = records["mean"].astype(np.float32)
    if level:
        sizes = np.frombuffer(content, "<u4", section.partial_buckets, place)
        steps = section.scale_range or 32767
        means = (means - steps) * np.float32(section.block / 2 / steps) + _centers(content, centers_at, section, sizes)
    rgba = records["rgba"] / 255
    vertices = pack_vertices(
        means, records["quat"], log_scales(records["scale"]), logits(rgba[:, 3]), dc_of(rgba[:, :3]),
        _rest(records["sh"].astype(np.float32), section.degree, level, sh_range, highest),
    )  # fmt: skip
    return vertices, end


def _centers(
    content: bytes,
    place: int,
    section: _Section,
    sizes: npt.NDArray[np.uint32],  # (P,) Gaussians in each bucket that is not full
) -> npt.NDArray[np.float32]:
    """Centres (N, 3) of the buckets that the Gaussians of a section are in: the full ones first, then the others."""
    full = section.full_buckets
    if (
        section.bucket_bytes != 12
        or full + len(sizes) > section.buckets
        or full * section.bucket_size > section.gaussians
    ):
        raise UnfitError(f"has {full} full buckets and {len(sizes)} others in {section.buckets}; expected as many")
    centers = np.frombuffer(content, "<f4", 3 * section.buckets, place).reshape(-1, 3)[: full + len(sizes)]
    counts = np.concatenate([np.full(full, section.bucket_size), sizes]).astype(np.int64)
    if counts.sum() != section.gaussians:
        raise UnfitError(f"has buckets of {counts.sum():,} Gaussians in a section of {section.gaussians:,}")
    return centers.repeat(counts, axis=0)


def _rest(
    sh: npt.NDArray[np.float32], degree: int, level: int, sh_range: tuple[float, float], highest: int
) -> npt.NDArray[np.float32] | None:
    """Coefficients (N, B, 3) above degree 0, up to the highest of the file; those that a section has not are zero.

    In the file, each band holds all of red, then green, then blue.
    """
    if highest == 0:
        return None
    if level == 2:
        sh = sh_range[0] + sh * np.float32((sh_range[1] - sh_range[0]) / 255)
    rest = np.zeros((len(sh), REST_COUNTS[highest] // 3, 3), np.float32)
    for begin, end in pairwise(REST_COUNTS[: degree + 1]):
        rest[:, begin // 3 : end // 3] = sh[:, begin:end].reshape(len(sh), 3, -1).transpose(0, 2, 1)
    return rest
