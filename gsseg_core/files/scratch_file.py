"""A temporary file without a name, for what does not fit into memory; it is gone when the process ends, however."""

from __future__ import annotations

import os
import pickle
import shutil
import tempfile
from typing import IO, Any, NamedTuple

import numpy as np

SPARED = 1 << 30  # bytes of the disk that are left to others


class _Place(NamedTuple):
    """Where an object is: its arrays one after the other in the file, the rest of its pickle here."""

    offset: int
    sizes: list[int]  # of the arrays, in bytes
    rest: bytes

    @property
    def size(self) -> int:
        return sum(self.sizes)


class ScratchFile:
    """Objects made of large arrays, by name; each is read as it was written, into memory of its own.

    The file is made when it is first needed, in the folder that the environment variable TMPDIR names, or else in
    /var/tmp, which is never kept in memory, or else where Python puts temporary files.
    """

    def __init__(self) -> None:
        self._file: IO[bytes] | None = None
        self._places: dict[str, _Place] = {}
        self._holes: list[tuple[int, int]] = []  # offset and size of what was dropped

    def __reduce__(self) -> tuple[type[ScratchFile], tuple[()]]:
        """Copy and pickle as an empty file."""
        return ScratchFile, ()

    def __del__(self) -> None:
        """Close the file, with which it is gone."""
        self.clear()

    @property
    def nbytes(self) -> int:
        """Bytes of the objects in the file."""
        return sum(place.size for place in self._places.values())

    def holds(self, name: str) -> bool:
        """Tell whether there is an object of that name."""
        return name in self._places

    def put(self, name: str, value: Any) -> bool:
        """Write an object in place of an earlier one of that name; False, with neither kept, if space is lacking."""
        self.drop(name)
        buffers: list[pickle.PickleBuffer] = []
        rest = pickle.dumps(value, protocol=5, buffer_callback=buffers.append)
        arrays = [buffer.raw() for buffer in buffers]
        place = _Place(0, [array.nbytes for array in arrays], rest)
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile(dir=_folder())  # noqa: SIM115 - it lives as long as this object
            place = place._replace(offset=self._find_space(place.size))
            offset = place.offset
            for array in arrays:
                _write(self._file.fileno(), array, offset)
                offset += array.nbytes
        except OSError:
            return False
        self._places[name] = place
        return True

    def get(self, name: str) -> Any:
        """Read an object; None if there is none of that name, or the disk does not give it back."""
        place = self._places.get(name)
        if place is None or self._file is None:
            return None
        # Each array by itself: one that is kept must not keep the others.
        arrays, offset = [np.empty(size, np.uint8) for size in place.sizes], place.offset
        try:
            for array in arrays:
                _read(self._file.fileno(), array.data, offset)
                offset += array.nbytes
        except OSError:
            return None
        return pickle.loads(place.rest, buffers=arrays)

    def drop(self, name: str) -> None:
        """Forget an object, if there is one of that name; its space is used again."""
        place = self._places.pop(name, None)
        if place is not None:
            self._add_hole(place.offset, place.size)
        if not self._places:
            self.clear()

    def clear(self) -> None:
        """Forget all objects, and give the disk back."""
        self._places.clear()
        self._holes.clear()
        if self._file is not None:
            self._file.close()
            self._file = None

    def _add_hole(self, offset: int, size: int) -> None:
        """Note a hole, as one with those beside it: what is left of holes would soon fit nothing, and the file grow."""
        holes = sorted([*self._holes, (offset, size)])
        self._holes = holes[:1]
        for begin, capacity in holes[1:]:
            last, before = self._holes[-1]
            if last + before == begin:
                self._holes[-1] = (last, before + capacity)
            else:
                self._holes.append((begin, capacity))

    def _find_space(self, size: int) -> int:
        """Find the offset at which so many bytes fit: in a hole, or at the end; `OSError` if the disk has no space."""
        for number, (offset, capacity) in enumerate(self._holes):
            if capacity >= size:
                self._holes[number : number + 1] = [(offset + size, capacity - size)] * (capacity > size)
                return offset
        assert self._file is not None
        descriptor = self._file.fileno()
        if shutil.disk_usage(descriptor).free < size + SPARED:
            raise OSError("no space left for scratch")
        return os.fstat(descriptor).st_size


def _folder() -> str | None:
    """Find where the file goes; None leaves it to Python."""
    asked = os.environ.get("TMPDIR", "")
    return next((path for path in (asked, "/var/tmp") if os.path.isdir(path) and os.access(path, os.W_OK)), None)


def _write(descriptor: int, data: memoryview, offset: int) -> None:
    while len(data):
        count = os.pwrite(descriptor, data, offset)
        data, offset = data[count:], offset + count


def _read(descriptor: int, into: memoryview, offset: int) -> None:
    while len(into):
        count = os.preadv(descriptor, [into], offset)
        if not count:
            raise OSError("the scratch file ends too early")
        into, offset = into[count:], offset + count
