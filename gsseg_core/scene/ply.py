"""PLY files in and out, as structured arrays; the only module that knows plyfile."""

from __future__ import annotations

import io
import os
from collections.abc import Iterable
from io import BufferedReader
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import plyfile

from gsseg_core.errors import SceneFileError, ScenePropertyError
from gsseg_core.files.atomic import write_atomically
from gsseg_core.scene.scene_file import open_scene, size_of
from gsseg_core.text import clipped, quoted

_MAX_HEADER = 1 << 20
_PLAIN = bytes(range(128)) + b"?" * 128  # for each byte, itself if it is ASCII


def read_vertices(path: str | os.PathLike[str], within: Path | None = None) -> npt.NDArray[np.void]:
    """Read the `vertex` element of a PLY file, ascii or binary of either byte order; others are ignored.

    The structured array (N,) has one field per property in the file's order and type, native byte order. Raises
    `SceneFileError` where the file is missing, truncated, too large for the memory, not a PLY, or has no `vertex`
    element, `ScenePropertyError` where a vertex property is a list, `PathNotAllowedError` where the file does not lie
    below `within`, links followed.
    """
    path = Path(path)
    elements = read_elements(path, within)
    if "vertex" not in elements:
        found = ", ".join(elements) or "none"
        raise SceneFileError(f"{path}: PLY has no element 'vertex' (elements found: {clipped(found)})")
    vertices = elements["vertex"]
    lists = [name for name in vertices.dtype.names or () if vertices.dtype[name].hasobject]
    if lists:
        raise ScenePropertyError(
            f"{path}: vertex properties {clipped(', '.join(lists))} are lists; expected one number each"
        )
    return vertices


def read_elements(path: Path, within: Path | None = None) -> dict[str, npt.NDArray[np.void]]:
    """Read all elements of a PLY that have properties, by name, as `read_vertices` does; lists are objects."""
    with open_scene(path, within, "a PLY file") as file:
        try:
            ply = _read_header(file)
            # Text is wrapped here, since plyfile would leave its own wrapper open.
            with io.TextIOWrapper(file, "ascii") if ply.text else file as stream:
                # gsplat's compressed PLY of SH degree 0 has an element without properties.
                return {element.name: _read_rows(element, stream, ply) for element in ply if element.properties}
        except plyfile.PlyParseError as error:
            raise ValueError(str(error)) from error


def _read_rows(element: Any, stream: Any, ply: Any) -> npt.NDArray[np.void]:
    dtype, count = element.dtype(ply.byte_order), element.count
    if dtype.hasobject or not count * dtype.itemsize:
        element._read(stream, ply.text, ply.byte_order, False)
        rows: npt.NDArray[np.void] = element.data
    elif ply.text:
        # As plyfile reads it, number for number, and several times as fast.
        rows = np.loadtxt(islice(stream, count), dtype, comments=None, ndmin=1)
        if len(rows) < count:
            raise ValueError(f"element {quoted(element.name)} ends after {len(rows):,} of {count:,} rows")
    else:
        # plyfile would map the file into memory: one that is written anew meanwhile would end the process.
        rows = np.empty(count, dtype)
        if (size := stream.readinto(rows.view(np.uint8))) < rows.nbytes:
            raise ValueError(f"element {quoted(element.name)} ends after {size:,} of {rows.nbytes:,} bytes")
    return rows.astype(dtype.newbyteorder("="), copy=False)


def is_ply(head: bytes) -> bool:
    """Whether a file begins as PLY."""
    return head.startswith((b"ply\n", b"ply\r"))


def _read_header(file: BufferedReader) -> Any:
    """Read the header of a PLY, up to the first row; raises `ValueError` if the file is too short for its counts."""
    head = file.read(_MAX_HEADER)
    if not is_ply(head):
        raise ValueError(f"begins with {head[:24]!r}, not with 'ply'" if head else "is empty")
    if b"end_header" not in head:
        raise ValueError(f"no end of its header in the first {_MAX_HEADER:,} bytes")
    # plyfile refuses comments with letters that are not ASCII, such as a user's name.
    header = io.StringIO(head.translate(_PLAIN).decode("ascii"), newline="")
    ply = plyfile.PlyData._parse_header(header)
    file.seek(header.tell())
    left = size_of(file) - header.tell()
    for element in ply:
        if ply.text and element.count and not element.properties:  # An empty line each, perhaps, or none.
            raise ValueError(f"element {quoted(element.name)} of {element.count:,} rows has no properties")
        if ply.text:
            least = 2 * len(element.properties) * element.count - 1  # a digit and what follows it
        else:
            least = element.count * sum(_least_bytes(prop) for prop in element.properties)
        if least > left:
            raise ValueError(
                f"element {quoted(element.name)} of {element.count:,} rows takes {least:,} bytes, and {left:,} are left"
            )
        left -= max(least, 0)
    return ply


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
