"""Label images: read from PNG, written, and kept in memory compressed.

In memory labels are int32, 0 the background and `UNKNOWN` (-1) "no evidence here"; in files the largest number of the
encoding, 255 or 65535, stands for unknown.
"""

from __future__ import annotations

import hashlib
import os
import struct
import zlib
from collections.abc import Callable
from functools import cached_property
from io import BufferedReader
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from gsseg_core.errors import MaskFormatError, SettingsError
from gsseg_core.files.atomic import write_atomically
from gsseg_core.files.input_files import check_pixels, decode_image, open_expected

UNKNOWN = -1

DIGEST_BYTES = 16  # of a mask, or a view: no two of a fleet will ever share them by chance

EXPECTED_IDS = (
    "expected ids from 1, as 1 and not 255 for a single object: 0 is the background and 255 (in masks of 16 bits "
    "65535) unknown; detections of 8 bits are 0 to 255, not 0 and 1"
)
"""What messages say where masks name no object."""

GLOBAL = "global"
PER_VIEW = "per-view"
IDS = (GLOBAL, PER_VIEW)
"""Whether an id means the same in every view, or the objects are to be found."""

_PNG_KINDS = {0: "gray", 2: "RGB", 3: "palette", 4: "gray + alpha", 6: "RGBA"}


class PngHeader(NamedTuple):
    """What the header of a PNG says: gray, RGB, palette, gray + alpha or RGBA; bits per channel; size in pixels."""

    kind: str
    depth: int
    width: int
    height: int

    @property
    def bits(self) -> int:
        """Bits per label, 8 or 16, if it is a label image."""
        return 8 if self.kind == "palette" else self.depth


class Mask(NamedTuple):
    """A label image and how many bits a pixel had in its file."""

    labels: npt.NDArray[np.int32]  # (H, W)
    bits: int


def read_mask(
    path: str | os.PathLike[str],
    within: Path | None = None,
    check_size: Callable[[int, int], None] = lambda width, height: None,
) -> Mask:
    """Read a label image: a PNG with 8- or 16-bit gray values, or palette indices, as labels.

    Its labels (H, W) int32 are `UNKNOWN` where the file has 255 (8 bits) or 65535 (16 bits). With `within`, it must lie
    below that folder, links followed (else `PathNotAllowedError`). Raises `MaskFormatError` where it is missing or
    broken, or another kind of image (RGB, alpha, 1-bit, not a PNG), and what `check_size` raises of its width and
    height, before any pixel is read.
    """
    # Once for header and pixels: in between, another file may take its name.
    with open_expected(path, MaskFormatError, "a label image", within) as file:
        header = _read_header(file, str(path))
        check_size(header.width, header.height)
        # Other formats are lossy or ambiguous about integers, whatever the file is named.
        with decode_image(file, str(path), MaskFormatError, "PNG", "a whole label image", ("PNG",)) as image:
            labels = np.array(image).astype(np.int32)
    labels[labels == 2**header.bits - 1] = UNKNOWN
    return Mask(labels, header.bits)


def mask_header(path: str | os.PathLike[str], within: Path | None = None) -> PngHeader:
    """Read the header of a label image; raises as `read_mask` does."""
    with open_expected(path, MaskFormatError, "a label image", within) as file:
        return _read_header(file, str(path))


def _read_header(file: BufferedReader, source: str) -> PngHeader:
    header = png_header(file.read(26), source)
    kind, depth, width, height = header
    if kind != "palette" and (kind != "gray" or depth not in (8, 16)):
        colours = "write the ids themselves, not colours (a palette made for each image renumbers them)"
        fix = f"; a photo is not a mask; {colours}" if "RGB" in kind else ""
        raise MaskFormatError(
            f"{source}: is {kind} of {depth} bits per channel; expected a one-channel 8- or 16-bit PNG of labels{fix}"
        )
    check_pixels(width, height, source, MaskFormatError)
    file.seek(0)
    return header


def png_header(start: bytes, source: str) -> PngHeader:
    """Read the header of a PNG from its first 26 bytes, or raise `MaskFormatError` if they are not those of one."""
    if len(start) < 26 or not start.startswith(b"\x89PNG\r\n\x1a\n"):
        raise MaskFormatError(f"{source}: not a PNG; expected a one-channel 8- or 16-bit PNG of labels")
    # The header chunk comes first: 8 bytes of signature, 8 of chunk, width, height, bit depth, colour type.
    width, height = struct.unpack(">II", start[16:24])
    return PngHeader(_PNG_KINDS.get(start[25], "unknown"), start[24], width, height)


def write_mask(
    path: str | os.PathLike[str],
    labels: npt.NDArray[np.integer[Any]],  # (H, W)
    bits: int,
    run: str | None = None,
) -> None:
    """Write a label image as a gray PNG of 8 or 16 bits, atomically (`WriteError`); `UNKNOWN` becomes 255 or 65535.

    `run` is the id of the run that it belongs to, for a text in the file. Raises `MaskFormatError` where the labels are
    no whole numbers or one does not fit, `SettingsError` for other bits.
    """
    if bits not in (8, 16):
        raise SettingsError(f"{path}: masks of {bits} bits were asked for; expected 8 or 16")
    values = in_bits(labels, bits, str(path))
    with write_atomically(path) as temporary:
        Image.fromarray(values).save(temporary, format="PNG", pnginfo=run_text(run))


def in_bits(
    labels: npt.NDArray[np.integer[Any]],  # (H, W)
    bits: int,
    source: str,
) -> npt.NDArray[np.unsignedinteger[Any]]:
    """Labels (H, W) in 8 or 16 bits, `UNKNOWN` as the largest number; `MaskFormatError` if one does not fit."""
    if labels.dtype.kind not in "iub":  # Of probabilities nothing but zeros would be left.
        raise MaskFormatError(f"{source}: labels are {labels.dtype}; expected whole numbers")
    unknown = 2**bits - 1
    low, high = (int(labels.min()), int(labels.max())) if labels.size else (0, 0)
    if low < UNKNOWN or high >= unknown:
        raise MaskFormatError(f"{source}: labels are {low} to {high}; {bits} bits hold {UNKNOWN} to {unknown - 1}")
    return np.where(labels == UNKNOWN, unknown, labels).astype(np.uint8 if bits == 8 else np.uint16)


def run_text(run: str | None) -> PngInfo:
    """Text for a PNG: the id of the run that it belongs to, if there is one."""
    text = PngInfo()
    if run is not None:
        text.add_text("gsseg_run", run)
    return text


def digest_of(*content: object) -> bytes:
    """Return 16 bytes that are others for other content: bytes, or what has a `repr` of its own."""
    digest = hashlib.blake2b(digest_size=DIGEST_BYTES)
    for part in content:
        packed = part if isinstance(part, bytes) else repr(part).encode(errors="surrogatepass")
        digest.update(b"%d:" % len(packed))
        digest.update(packed)
    return digest.digest()


class PackedLabels:
    """A label image (H, W) of `UNKNOWN` to `MAX_LABEL` in memory: a few bytes per outline and next to none per area."""

    def __init__(self, labels: npt.NDArray[np.integer[Any]]) -> None:
        largest = int(labels.max()) if labels.size else UNKNOWN
        self._shape, self._dtype = labels.shape, np.min_scalar_type(-largest - 2)
        self._data = zlib.compress(labels.astype(self._dtype).tobytes(), level=1)

    def unpack(self) -> npt.NDArray[np.int32]:
        """Return the labels, (H, W) int32, in memory of their own."""
        return np.frombuffer(zlib.decompress(self._data), self._dtype).reshape(self._shape).astype(np.int32)

    @cached_property
    def digest(self) -> bytes:
        """16 bytes that are others for other labels."""
        return digest_of(self._shape, zlib.decompress(self._data))
