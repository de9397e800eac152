"""Records of mask files: JSON objects whose fields are read with errors that say where."""

from __future__ import annotations

from collections.abc import Iterator

from gsseg_core.data.mask_formats.masks import check_id, check_name
from gsseg_core.errors import MaskFormatError
from gsseg_core.files.input_files import check_pixels
from gsseg_core.files.json_files import JsonObject, kind_of
from gsseg_core.text import clipped


class Record(JsonObject):
    """A JSON object of a mask file."""

    error = MaskFormatError

    @classmethod
    def of(cls, value: object, where: str) -> Record:
        """Check that something is an object; raises `MaskFormatError`, as every method does, if it is none."""
        if not isinstance(value, dict):
            raise MaskFormatError(f"{where}: is {kind_of(value)}; expected an object")
        return cls(where, value)

    def records(self, key: str, what: str) -> Iterator[Record]:
        """Read a list of objects one by one, each of which messages call a `what`."""
        return records(self.value(key), f"{self.where}: '{key}'", f"{self.where}, {what}")

    def record(self, key: str) -> Record:
        """Read an object."""
        return Record.of(self.value(key), f"{self.where}: '{key}'")

    def text(self, key: str) -> str:
        """Read a text."""
        value = self.value(key)
        if not isinstance(value, str):
            raise MaskFormatError(f"{self.where}: '{key}' is {kind_of(value)}; expected text")
        return value

    def class_name(self, key: str) -> str:
        """Read the name of a class."""
        return check_name(self.value(key), self.where)

    def id(self, key: str) -> int:
        """Read an id of a class or an object."""
        return check_id(self.value(key), self.where)

    def number(self, key: str, default: float) -> float:
        """Read a number; the default where there is none."""
        value = self.fields.get(key)
        if value is None:
            return default
        if type(value) not in (int, float) or not abs(value) < 1e12:
            raise MaskFormatError(f"{self.where}: '{key}' is {clipped(repr(value)[:80])}; expected a number")
        return float(value)

    def size(self, width: str, height: str) -> tuple[int, int]:
        """Read the width and height of an image."""
        sizes = []
        for key in (width, height):
            value = self.value(key)
            if type(value) not in (int, float) or value < 1 or value % 1:  # What came through a table has 32.0.
                found = clipped(value) if type(value) in (int, float) else kind_of(value)
                raise MaskFormatError(f"{self.where}: '{key}' is {found}; expected a whole number of pixels")
            sizes.append(int(value))
        check_pixels(sizes[0], sizes[1], self.where, MaskFormatError)
        return sizes[0], sizes[1]


def records(value: object, where: str, each: str) -> Iterator[Record]:
    """Read a list of objects one by one, each called `each` and its number; raises as methods of `Record` do."""
    if not isinstance(value, list):
        raise MaskFormatError(f"{where} is {kind_of(value)}; expected a list")
    return (Record.of(entry, f"{each} {i}") for i, entry in enumerate(value))
