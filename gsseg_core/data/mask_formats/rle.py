"""Run-length encoding of COCO: lengths of runs down the columns, by turns outside and inside of the mask."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gsseg_core.errors import MaskFormatError
from gsseg_core.files.json_files import kind_of
from gsseg_core.text import clipped

_MOST_CHARACTERS = 7  # of one number, five bits each: that is more than any image has pixels


def run_lengths(counts: object, where: str) -> npt.NDArray[np.int64]:
    """Read `counts` as COCO files have them, as a list of lengths or as text, into lengths (R,).

    In text, a character holds five bits of a number in two's complement, the lowest first, and whether more follow;
    from the fourth number on, the difference to the last but one is written (`maskApi.c` of the COCO API). Raises
    `MaskFormatError` where it is neither, or a length is negative.
    """
    if isinstance(counts, str):
        lengths = _decoded(counts, where)
    elif isinstance(counts, list) and all(type(count) is int and abs(count) < 2**62 for count in counts):
        lengths = np.array(counts, np.int64)
    else:
        found = "a list of other things" if isinstance(counts, list) else kind_of(counts)
        raise MaskFormatError(f"{where}: 'counts' is {found}; expected whole numbers, or compressed RLE as text")
    if lengths.min(initial=0) < 0:
        raise MaskFormatError(f"{where}: 'counts' has a run of {lengths.min()} pixels; expected lengths of at least 0")
    return lengths


def runs_to_mask(
    lengths: npt.NDArray[np.int64],  # (R,)
    width: int,
    height: int,
    where: str,
    order: str = "F",
) -> npt.NDArray[np.bool_]:
    """Turn lengths of runs into a mask (H, W) bool; `order` is "F" where they go down the columns, "C" along rows.

    Raises `MaskFormatError`, before memory is taken, where they do not sum to the pixels of the mask.
    """
    total = float(lengths.sum(dtype=np.float64))  # Integers may overflow to a sum that looks right.
    if total != width * height:
        raise MaskFormatError(
            f"{where}: its runs are {clipped(f'{total:.0f}', 24)} pixels long; expected {width * height:,}, "
            f"as {width} x {height} pixels have"
        )
    inside = np.arange(len(lengths)) % 2 == 1
    flat = np.repeat(inside, lengths)
    return flat.reshape(height, width) if order == "C" else flat.reshape(width, height).T


def _decoded(text: str, where: str) -> npt.NDArray[np.int64]:
    characters = np.frombuffer(text.encode("latin-1", errors="replace"), np.uint8).astype(np.int64) - ord("0")
    if not len(characters):
        return np.zeros(0, np.int64)
    more, bits = characters & 32 > 0, characters & 31
    last = np.flatnonzero(~more)
    first = np.append(0, last[:-1] + 1)
    sizes = last - first + 1 if len(last) else last
    if characters.min() < 0 or characters.max() > 63 or more[-1] or sizes.max() > _MOST_CHARACTERS:
        raise MaskFormatError(f"{where}: 'counts' is {clipped(repr(text), 40)}, which is no compressed RLE of COCO")
    place = np.arange(len(bits)) - np.repeat(first, sizes)
    numbers = np.add.reduceat(bits << (5 * place), first)
    numbers -= np.where(bits[last] & 16, np.int64(1) << (5 * sizes), 0)
    for start in (1, 2):
        numbers[start::2] = np.cumsum(numbers[start::2])
    return numbers
