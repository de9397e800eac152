"""PLY files in and out, as structured arrays; the only module that knows plyfile."""

from __future__ import annotations

import io
import os
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt
import plyfile

from gsseg_core.errors import SceneFileError, ScenePropertyError
from gsseg_core.files.atomic import write_atomically
from gsseg_core.files.input_files import open_input, reason
from gsseg_core.text import clipped, quoted

_MAX_HEADER = 1 << 20


def read_vertices(path: str | os.PathLike[str], within: Path | None = None) -> npt.NDArray[np.void]:
    """Read the `vertex` element of a PLY file, ascii or binary of either byte order; others are ignored.

    The structured array (N,) has one field per property in the file's order and type, native byte order, in memory.
    Raises `SceneFileError` where the file is missing, truncated, not a PLY, or has no `vertex` element,
    `ScenePropertyError` where a vertex property is a list, `PathNotAllowedError` where the file does not lie below
    `within`, links followed.
    """
    path = Path(path)
    ply = _parse(path, within)
    if "vertex" not in ply:
        found = ", ".join(element.name for element in ply) or "none"
        raise SceneFileError(f"{path}: PLY has no element 'vertex' (elements found: {clipped(found)})")
    element = ply["vertex"]
    lists = [prop.name for prop in element.properties if isinstance(prop, plyfile.PlyListProperty)]
    if lists:
        raise ScenePropertyError(
            f"{path}: vertex properties {clipped(', '.join(lists))} are lists; expected one number each"
        )
    return _native(element.data)


def read_elements(path: Path, within: Path | None = None) -> dict[str, npt.NDArray[np.void]]:
    """Read all elements of a PLY by name, as `read_vertices` reads one; properties that are lists are objects."""
    return {element.name: _native(element.data) for element in _parse(path, within)}


def _native(data: npt.NDArray[np.void]) -> npt.NDArray[np.void]:
    """Copy rows in native byte order, so that a scene outlives changes to the memory-mapped file."""
    native = data.dtype.newbyteorder("=")
    if native == data.dtype and native.itemsize and not native.hasobject:
        return _copied(data.view(np.uint8)).view(native)
    return np.array(data, dtype=native, subok=False)


def _copied(data: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:  # (B,)
    """Copy bytes, as NumPy would copy records field after field; in two threads, since page faults take the time."""
    copy = np.empty(data.shape, np.uint8)
    halves = (slice(None, len(data) // 2), slice(len(data) // 2, None))
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(lambda half: np.copyto(copy[half], data[half]), halves))
    return copy


def _parse(path: Path, within: Path | None) -> Any:
    try:
        # Text is wrapped here, since plyfile would leave its own wrapper open.
        with open_input(path, within) as file, io.TextIOWrapper(file, "ascii") if _is_text(file) else file as stream:
            return plyfile.PlyData.read(stream)
    except OSError as error:
        raise SceneFileError(f"{path}: cannot be read ({reason(error)}); expected a 3DGS PLY") from error
    except (plyfile.PlyParseError, ValueError, TypeError, LookupError, ArithmeticError, MemoryError) as error:
        raise SceneFileError(
            f"{path}: truncated or not a PLY file ({reason(error)}); expected a whole 3DGS PLY"
        ) from error


def is_ply(head: bytes) -> bool:
    """Whether a file begins as PLY."""
    return head.startswith((b"ply\n", b"ply\r"))


def _is_text(file: BinaryIO) -> bool:
    """Whether a PLY is text, by its header; raises `ValueError` if the file is too short for its counts."""
    head = file.read(_MAX_HEADER)
    if not is_ply(head):
        raise ValueError(f"begins with {head[:24]!r}, not with 'ply'" if head else "is empty")
    if b"end_header" not in head:
        raise ValueError(f"no end of its header in the first {_MAX_HEADER:,} bytes")
    file.seek(0)
    ply = plyfile.PlyData._parse_header(file)
    left = os.fstat(file.fileno()).st_size - file.tell()
    for element in ply:
        if ply.text:
            least = 2 * len(element.properties) * element.count - 1  # a digit and what follows it
        else:
            least = element.count * sum(_least_bytes(prop) for prop in element.properties)
        if least > left:
            raise ValueError(
                f"element {quoted(element.name)} of {element.count:,} rows takes {least:,} bytes, and {left:,} are left"
            )
        left -= max(least, 0)
    file.seek(0)
    return bool(ply.text)


def _least_bytes(prop: Any) -> int:
    """Bytes of a property in one row; of a list, those of its length."""
    kind = prop.list_dtype("<")[0] if isinstance(prop, plyfile.PlyListProperty) else prop.dtype("<")
    return int(np.dtype(kind).itemsize)


def write_vertices(path: str | os.PathLike[str], vertices: npt.NDArray[Any], run: str | None = None) -> None:
    """Write a structured array (N,) as the `vertex` element of a binary little-endian PLY, atomically (`WriteError`).

    The id of a run, if one is given, becomes the comment `gsseg_run <id>`. It stands below the line of the element:
    some viewers count on that being the third.
    """
    write_parts(path, len(vertices), vertices.dtype, [vertices], run)


def write_parts(
    path: str | os.PathLike[str], count: int, dtype: np.dtype[Any], parts: Iterable[npt.NDArray[Any]], run: str | None
) -> None:  # fmt: skip
    """Write `count` vertices as `write_vertices` does, part by part, so that not all need to be in memory at once."""
    comments = [] if run is None else [f"gsseg_run {run}"]
    # An empty array takes no memory until it is written to.
    element = plyfile.PlyElement.describe(np.empty(count, dtype), "vertex", comments=comments)
    header = plyfile.PlyData([element], byte_order="<").header
    with write_atomically(path) as temporary, open(temporary, "wb") as file:
        file.write(f"{header}\n".encode("ascii"))
        for part in parts:
            file.write(part.astype(element.dtype("<"), copy=False).data)
