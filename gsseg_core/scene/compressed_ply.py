"""PlayCanvas' compressed PLY: blocks of 256 Gaussians, each value a few bits between the extremes of its block."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from gsseg_core.files.input_files import UnfitError
from gsseg_core.scene.ply import read_elements
from gsseg_core.scene.quaternions import from_smallest_three
from gsseg_core.scene.scene_file import refusing_damage
from gsseg_core.scene.vertices import REST_COUNTS, ReadScene, dc_of, logits, pack_in_blocks, pack_vertices, rest_names

_BLOCK = 256
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_SH_RANGE = 8.0  # coefficients lie within -4 and 4


def is_compressed_ply(head: bytes) -> bool:
    """Whether a file begins with the header of a compressed PLY."""
    header = head.partition(b"end_header")[0]
    return head.startswith(b"ply") and b"element chunk " in header and b" packed_position" in header


def read_compressed_ply(path: Path, within: Path | None = None) -> ReadScene:
    """Read a compressed PLY, with or without extremes of colours and with or without SH."""
    elements = read_elements(path, within)
    chunks, vertices, sh = (elements.get(name) for name in ("chunk", "vertex", "sh"))
    with refusing_damage(path, "a compressed PLY"):
        if chunks is None or vertices is None or not set(_PACKED).issubset(vertices.dtype.names or ()):
            raise UnfitError(f"lacks elements or properties of a compressed PLY; expected {', '.join(_PACKED)}")
        n = len(vertices)
        if len(chunks) != -(-n // _BLOCK):
            raise UnfitError(f"has {len(chunks):,} chunks for {n:,} vertices; expected {-(-n // _BLOCK):,}")
        if sh is not None and len(sh) != n:
            raise UnfitError(f"has SH of {len(sh):,} Gaussians for {n:,} vertices; expected as many")

        def pack(block: slice) -> npt.NDArray[np.void]:
            of_block = chunks[block.start // _BLOCK : block.stop // _BLOCK]
            return _pack(of_block, vertices[block], None if sh is None else sh[block])

        return ReadScene(pack_in_blocks(n, pack))


def _pack(
    chunks: npt.NDArray[np.void],  # (C,) extremes of 256 Gaussians each
    vertices: npt.NDArray[np.void],  # (N,)
    sh: npt.NDArray[np.void] | None,  # (N,)
) -> npt.NDArray[np.void]:
    position, rotation, scale, color = (vertices[name].astype(np.uint32, casting="safe") for name in _PACKED)
    rgba = np.stack([_fraction(color, shift, 8) for shift in (24, 16, 8, 0)], axis=1)
    rgb = rgba[:, :3]
    if "min_r" in (chunks.dtype.names or ()):
        rgb = _between(chunks, ("r", "g", "b"), rgb)
    return pack_vertices(
        _between(chunks, ("x", "y", "z"), _three(position)),
        _rotations(rotation),
        _between(chunks, ("scale_x", "scale_y", "scale_z"), _three(scale)),
        logits(rgba[:, 3]),
        dc_of(rgb),
        None if sh is None else _rest(sh),
    )


def _fraction(bits: npt.NDArray[np.uint32], shift: int, count: int) -> npt.NDArray[np.float32]:
    """Read `count` bits of each number as a fraction of the largest number that they hold."""
    most = (1 << count) - 1
    return ((bits >> np.uint32(shift)) & np.uint32(most)).astype(np.float32) / np.float32(most)


def _three(bits: npt.NDArray[np.uint32]) -> npt.NDArray[np.float32]:  # (N,)
    """Unpack three fractions (N, 3) of 11, 10 and 11 bits."""
    return np.stack([_fraction(bits, 21, 11), _fraction(bits, 11, 10), _fraction(bits, 0, 11)], axis=1)


def _between(
    chunks: npt.NDArray[np.void], names: tuple[str, ...], fractions: npt.NDArray[np.float32]
) -> npt.NDArray[np.float32]:  # (N, 3)
    """Place fractions between the extremes of their chunks."""
    out = np.empty_like(fractions)
    for i, name in enumerate(names):
        least, most = (chunks[f"{end}_{name}"].repeat(_BLOCK)[: len(fractions)] for end in ("min", "max"))
        with np.errstate(all="ignore"):  # What is NaN or infinite is reported by the scene.
            out[:, i] = least * (1 - fractions[:, i]) + most * fractions[:, i]
    return out


def _rotations(bits: npt.NDArray[np.uint32]) -> npt.NDArray[np.float32]:  # (N,)
    others = np.stack([_fraction(bits, shift, 10) for shift in (20, 10, 0)], axis=1)
    return from_smallest_three(bits >> np.uint32(30), (others - 0.5) * np.float32(np.sqrt(2)))


def _rest(sh: npt.NDArray[np.void]) -> npt.NDArray[np.float32]:  # (N,)
    """Coefficients (N, B, 3) of SH above degree 0; a byte is the middle of one of 256 steps, the ends are exact."""
    names = rest_names(len(sh.dtype.names or ()))
    if len(names) not in REST_COUNTS or any(sh.dtype[name] != np.uint8 for name in names):
        raise ValueError(f"{len(names)} SH coefficients, or not of bytes")
    steps = (np.arange(256, dtype=np.float32) + np.float32(0.5)) / 256
    steps[0], steps[255] = 0, 1
    levels = (steps - np.float32(0.5)) * np.float32(_SH_RANGE)
    values: npt.NDArray[np.float32] = levels[np.stack([sh[name] for name in names], axis=1)]
    return values.reshape(len(sh), 3, -1).transpose(0, 2, 1)
