"""Arrays of an npz that anybody may have written: each is checked by its header before it is inflated."""

from __future__ import annotations

import json
import math
import os
import sys
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, NamedTuple

import numba as nb
import numpy as np
import numpy.typing as npt

from gsseg_core.csr_rows import CSRRows, slices, starts
from gsseg_core.errors import GssegError, StateFileError, StateMismatchError
from gsseg_core.files.atomic import write_atomically
from gsseg_core.files.input_files import DAMAGED, UnfitError, open_input, reason
from gsseg_core.files.json_files import whole_number
from gsseg_core.files.limits import LIMITS, MAX_LABEL
from gsseg_core.kernels.compiler import kernel
from gsseg_core.text import clipped, quoted

SHARES_TOLERANCE = 0.01
"""By how much probabilities of a row may sum to more or less than 1."""

COLDEST = 1e-3
"""Lowest temperature of probabilities; the highest is one over it."""

_SUFFIX = ".npy"
_LEVEL = 2  # of compression
_MOST_WITH_ZEROS = 1 << 28  # bytes of an array of which most is zero: to inflate and scan more takes too long
_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


class Header(NamedTuple):
    """Shape and type that an array of an npz claims to have."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]

    @classmethod
    def of(cls, array: npt.NDArray[Any] | Header) -> Header:
        """Take shape and type of an array."""
        return cls(array.shape, array.dtype)

    def require(self, name: str, dtype: npt.DTypeLike, shape: tuple[int | None, ...]) -> None:
        """Raise `UnfitError` unless the array of this name has a type and a shape, None being any length."""
        matches = len(self.shape) == len(shape) and all(
            want in (None, size) for want, size in zip(shape, self.shape, strict=True)
        )
        if self.dtype != np.dtype(dtype) or not matches:
            sizes = ", ".join("any" if size is None else str(size) for size in shape) + "," * (len(shape) == 1)
            raise UnfitError(f"array {name} is {self}; expected {np.dtype(dtype)} of shape ({sizes})")

    def __str__(self) -> str:
        """Type and shape, for messages."""
        return clipped(f"{self.dtype} of shape {self.shape}")


class NpzArrays:
    """The arrays of an open npz, and their `names`, read one by one.

    Raises `UnfitError` where they claim more than `Limits.max_npz_bytes` together.
    """

    def __init__(self, archive: zipfile.ZipFile) -> None:
        self._archive = archive
        self.names = [name[: -len(_SUFFIX)] for name in archive.namelist() if name.endswith(_SUFFIX)]
        total = sum(member.file_size for member in archive.infolist())
        if total > LIMITS.max_npz_bytes:
            raise UnfitError(
                f"claims {total:,} bytes of arrays; expected at most {LIMITS.max_npz_bytes:,} (limit max_npz_bytes)"
            )

    def header(self, name: str) -> Header:
        """Read shape and type of an array from its header; `ValueError` if it is missing or its header broken."""
        with self._open(name) as member:
            return _read_header(member, name)[0]

    def expect(self, name: str, dtype: npt.DTypeLike, shape: tuple[int | None, ...]) -> npt.NDArray[Any]:
        """Read an array of a type and shape, None being any length; `UnfitError` if it is another."""
        self.header(name).require(name, dtype, shape)
        return self.read(name)

    def expect_rows(self, name: str, dtype: npt.DTypeLike, shape: tuple[int | None, int | None]) -> CSRRows:
        """Read an array of which most is zero, as `expect` does; its zeros are never in memory all at once."""
        with self._open(name) as member:
            header, by_column = _read_header(member, name)
            header.require(name, dtype, shape)
            if by_column:
                return CSRRows.from_dense(self.read(name))
            (num_rows, num_columns), parts = header.shape, [CSRRows.empty(0, dtype)]
            for some in slices(num_rows, num_columns):
                size = (some.stop - some.start) * num_columns * header.dtype.itemsize
                if len(content := member.read(size)) < size:
                    raise ValueError(f"array {name!r} is shorter than its header says")
                parts.append(CSRRows.from_dense(np.frombuffer(bytearray(content), dtype).reshape(-1, num_columns)))
            _check_end(member, name)
        return CSRRows.vstack(parts)

    def expect_sparse(self, name: str, dtype: npt.DTypeLike, shape: tuple[int, int]) -> CSRRows:
        """Read the arrays that `sparse_arrays` has made of rows, none of whose entries is zero."""
        num_rows, num_columns = shape
        counts = self.expect(f"{name}_counts", np.uint16, (num_rows,))
        if counts.max(initial=0) > num_columns:
            raise UnfitError(f"array {name}_counts holds {counts.max()}; expected at most {num_columns}")
        indptr = starts(counts.astype(np.int64))
        indices = self.expect(f"{name}_indices", np.uint16, (int(indptr[-1]),))
        if indices.max(initial=0) >= num_columns:
            raise UnfitError(f"array {name}_indices holds {indices.max()}; expected below {num_columns}")
        begins = np.zeros(len(indices) + 1, bool)
        begins[indptr] = True
        if not np.all((indices[1:] > indices[:-1]) | begins[1:-1]):
            raise UnfitError(f"array {name}_indices does not rise in a row; expected ascending columns")
        data = self.expect(f"{name}_data", dtype, indices.shape)
        if not data.all():
            raise UnfitError(f"array {name}_data holds 0; expected entries that are not zero only")
        return CSRRows(indptr, indices.astype(np.uint32), data)

    def read(self, name: str) -> npt.NDArray[Any]:
        """Read an array, whose `header` the caller has checked."""
        with self._open(name) as member:
            array: npt.NDArray[Any] = np.lib.format.read_array(member, allow_pickle=False)
            _check_end(member, name)
            return array

    def _open(self, name: str) -> IO[bytes]:
        if name not in self.names:
            raise ValueError(f"there is no array {name!r}")
        return self._archive.open(name + _SUFFIX)

    def json_header(self) -> dict[str, Any]:
        """Read the JSON header, the array `header` that is one text, of `Limits.max_json_bytes` at most."""
        found = self.header("header")
        if found.dtype.kind != "U" or found.shape != () or found.dtype.itemsize > 4 * LIMITS.max_json_bytes:
            raise ValueError(f"array 'header' is {found}; expected one text")
        text = self.read("header")
        if text.reshape(1).view(text.dtype.byteorder + "u4").max(initial=0) > sys.maxunicode:
            raise ValueError("array 'header' holds what is no character")
        header = json.loads(str(text))
        if not isinstance(header, dict):
            raise ValueError("its header is no JSON object")
        return header


def _check_end(member: IO[bytes], name: str) -> None:
    if member.read(1):  # and so the checksum has been compared, too
        raise ValueError(f"array {name!r} is longer than its header says")


def _read_header(member: Any, name: str) -> tuple[Header, bool]:
    """Read shape and type of an array, and whether it lies in its file column after column."""
    try:
        version = np.lib.format.read_magic(member)
        if version not in _HEADERS:
            raise ValueError(f"version {version}")
        shape, by_column, dtype = _HEADERS[version](member)
    except (ValueError, SyntaxError, TypeError, tokenize.TokenError) as error:
        raise ValueError(f"array {name!r} is none of NumPy's ({clipped(error)})") from error
    header = Header(shape, dtype)
    # Of Python objects, NumPy would say how to load them all the same, which is what an attacker wants.
    if header.dtype.hasobject or header.dtype.kind == "V" or any(size < 0 for size in header.shape):
        raise ValueError(f"array {name!r} is {header}; expected numbers")
    if math.prod(header.shape) * header.dtype.itemsize > LIMITS.max_npz_bytes:
        raise ValueError(f"array {name!r} is {header}; expected at most {LIMITS.max_npz_bytes:,} bytes")
    return header, by_column


def temperature_of(header: dict[str, Any]) -> float:
    """Read the temperature of probabilities from a JSON header; 1 where there is none, as in files of old."""
    return check_temperature(header.get("temperature", 1.0))


def check_temperature(value: Any, unfit: type[Exception] = UnfitError) -> float:
    """Return a temperature of probabilities; raise `unfit` unless it is a number that files hold as one."""
    is_number = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    if not is_number or not COLDEST <= value <= 1 / COLDEST:
        raise unfit(f"temperature is {quoted(value)}; expected a number from {COLDEST:g} to {1 / COLDEST:g}")
    return float(value)


def class_names_of(header: dict[str, Any]) -> dict[int, str]:
    """Read the names of classes by id from a JSON header, ascending."""
    names = header["class_names"]
    if not isinstance(names, dict) or not all(isinstance(name, str) for name in names.values()):
        raise UnfitError(f"class_names are {quoted(names)}; expected names by id")
    by_id = {whole_number(int(k), "id of a class", 0, MAX_LABEL): name for k, name in names.items()}
    return dict(sorted(by_id.items()))


def check_shares(name: str, rows: CSRRows, unfit: type[Exception] = UnfitError) -> None:  # of float32
    """Raise `unfit` unless every row holds probabilities that sum to 1, or zeros."""
    sums, low = _sums_and_least(rows)
    bad = np.flatnonzero(~((low >= 0) & ((sums == 0) | (np.abs(sums - 1) <= SHARES_TOLERANCE))))
    if bad.size:
        i = int(bad[0])
        found = f"sum to {sums[i]:.4g}" if low[i] >= 0 and np.isfinite(sums[i]) else "are NaN, infinite or negative"
        raise unfit(
            f"values of array {name} {found} in row {i} ({bad.size:,} of {rows.num_rows:,} rows are unusable); "
            "expected probabilities that sum to 1, or zeros"
        )


@kernel(parallel=True)
def _sums_and_least(rows: CSRRows) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float32]]:
    """Sum up each row, (N,), and find the least of its entries and 0, (N,); one with NaN has NaN for the sum."""
    indptr, _, data = rows
    sums, low = np.zeros(indptr.shape[0] - 1, np.float64), np.zeros(indptr.shape[0] - 1, np.float32)
    for i in nb.prange(indptr.shape[0] - 1):
        for z in range(indptr[i], indptr[i + 1]):
            sums[i] += data[z]
            low[i] = min(low[i], data[z])
    return sums, low


def check_evidence(px: npt.NDArray[np.float32], unfit: type[Exception] = UnfitError) -> None:  # (N,)
    """Raise `unfit` unless the evidence of every row is a number of pixels: finite, 0 or more."""
    bad = np.flatnonzero(~((px >= 0) & (px < np.inf)))
    if bad.size:
        found = f"array evidence holds {px[bad[0]]:g} in row {bad[0]} ({bad.size:,} of {len(px):,} rows are unusable)"
        raise unfit(f"{found}; expected finite numbers of px, 0 or more")


def arrays_of_rows(name: str, rows: CSRRows, num_columns: int) -> dict[str, npt.NDArray[Any] | WithZeros]:
    """Make of N rows of K columns one array with its zeros, or, where that is large, those of `sparse_arrays`."""
    is_large = rows.num_rows * num_columns * rows.data.itemsize > _MOST_WITH_ZEROS
    return {**sparse_arrays(name, rows)} if is_large else {name: WithZeros(rows, num_columns)}


def sparse_arrays(name: str, rows: CSRRows) -> dict[str, npt.NDArray[Any]]:
    """Make arrays of those entries of N rows that are not zero: `{name}_counts`, `{name}_indices` and `{name}_data`.

    Counts of each row, (N,) uint16, take half of the space of `indptr`, and cannot run backwards.
    """
    kept = rows.nonzero()
    arrays = np.diff(kept.indptr).astype(np.uint16), kept.indices.astype(np.uint16), kept.data
    return dict(zip((f"{name}_counts", f"{name}_indices", f"{name}_data"), arrays, strict=True))


class WithZeros(NamedTuple):
    """A sparse array, N rows of K columns, that a file holds with its zeros, as NumPy's own."""

    rows: CSRRows
    num_columns: int

    def write(self, file: IO[bytes]) -> None:
        """Write it as `np.lib.format.write_array` does, some rows at a time."""
        descr = np.lib.format.dtype_to_descr(self.rows.data.dtype)
        shape = self.rows.num_rows, self.num_columns
        np.lib.format.write_array_header_1_0(file, {"descr": descr, "fortran_order": False, "shape": shape})
        for block in self.rows.blocks(self.num_columns):
            file.write(block.data)


def write_npz(path: str | os.PathLike[str], header: dict[str, Any], **arrays: npt.ArrayLike | WithZeros) -> None:
    """Write arrays and a JSON header as one compressed npz, atomically; raises `WriteError`."""
    with write_atomically(path) as temporary:
        write_arrays(temporary, header, **arrays)


def write_arrays(path: Path, header: dict[str, Any], **arrays: npt.ArrayLike | WithZeros) -> None:
    """Write arrays and a JSON header as one compressed npz, where nothing is."""
    # Two fifths of the time of NumPy's own level, and files 9 % larger.
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=_LEVEL) as archive:
        for name, array in {**arrays, "header": np.array(json.dumps(header, default=np.generic.item))}.items():
            with archive.open(f"{name}{_SUFFIX}", "w", force_zip64=True) as file:
                if isinstance(array, WithZeros):
                    # Only zeros come again, and who looks for nothing else takes less time and room. zipfile cannot be
                    # told; where it has no such attribute, all is as for other arrays.
                    runs = zlib.compressobj(_LEVEL, zlib.DEFLATED, -zlib.MAX_WBITS, strategy=zlib.Z_RLE)
                    file._compressor = runs  # type: ignore[attr-defined]
                    array.write(file)
                else:
                    np.lib.format.write_array(file, np.asanyarray(array), allow_pickle=False)


@contextmanager
def open_arrays(path: Path, expected: str, error: type[GssegError], within: Path | None = None) -> Iterator[NpzArrays]:
    """Open an npz that should be `expected`, such as "a saved state"; raise `error` if it is missing or damaged.

    Whatever goes wrong with its arrays in the body counts as damage to the file. With `within`, it must lie below that
    folder, links followed.
    """
    try:
        with open_input(path, within) as opened, zipfile.ZipFile(opened) as archive:
            yield NpzArrays(archive)
    except UnfitError as cause:
        raise error(f"{path}: {cause}") from cause
    except FileNotFoundError as cause:
        raise error(f"{path}: does not exist; expected {expected}") from cause
    except DAMAGED as cause:
        raise error(f"{path}: is not {expected}, or is damaged ({reason(cause)})") from cause


@contextmanager
def open_npz(
    path: Path,
    what: str,
    formats: Sequence[str],
    digest: str | None,
    within: Path | None = None,
    error: type[GssegError] = StateFileError,
) -> Iterator[tuple[NpzArrays, Any]]:
    """Open an npz whose JSON header must name one of `formats`, the newest first, and `digest`, if given, as "scene".

    Yields the arrays and the header. Raises `error` where the file is missing, damaged, also as the body finds out, or
    of another format, `StateMismatchError` where it belongs to another scene, and `PathNotAllowedError` where it lies
    outside `within`.
    """
    with open_arrays(path, what, error, within) as arrays:
        header = arrays.json_header()
        if header.get("format") not in formats:
            raise UnfitError(f"format is {quoted(header.get('format'))}; expected {formats[0]!r}")
        if digest is not None:
            check_scene(path, header, digest)
        yield arrays, header


def check_scene(path: Path, header: dict[str, Any], digest: str) -> None:
    """Raise `StateMismatchError` unless the header of an npz says that it belongs to the scene with this digest."""
    if header.get("scene") != digest:
        raise StateMismatchError(
            f"{path}: belongs to the scene {clipped(str(header.get('scene'))[:12])}; expected {digest[:12]}, the "
            "scene in use (the same scene in another format has other numbers: give the file that was segmented)"
        )


def npz_format(path: Path) -> str:
    """Read the format that the header of an npz names; "" if the file is missing, damaged or names none."""
    with suppress(GssegError), open_arrays(path, "an npz with a header", GssegError) as arrays:
        return str(arrays.json_header()["format"])
    return ""
