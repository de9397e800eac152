"""ROS messages with fields of any value that their types allow, and serialised ones with damaged bytes."""

from __future__ import annotations

import array
import copy
import random
import re
from typing import Any

import numpy as np
from mutations import ODD_STRINGS

BITS = {
    "int8": (-7, 7), "uint8": (0, 8), "int16": (-15, 15), "uint16": (0, 16), "int32": (-31, 31), "uint32": (0, 32),
    "int64": (-63, 63), "uint64": (0, 64), "octet": (0, 8),
}  # fmt: skip
FLOATS = (0.0, -0.0, 1.0, -1.0, 0.5, 1e-30, 1e30, -1e30, float("nan"), float("inf"), float("-inf"))
PATHS = (
    "data", "data/scene.ply", "data/cameras.json", "data/labels", "data/mine.json", "state.npz", "other.ply",
    "other.npz", "broken.ply", "broken.npz", "link/outside.ply", "../outside.ply", "loop", "mine", "mine/notes.txt",
    "new/a/b.npz", "data/scene.ply/x", "fifo", "/", "/dev/zero", "/proc/self/mem", "~", "kept", "x" * 5000, "é.npz",
)  # fmt: skip
WORDS = (
    "em", "votes", "gradient", "EM", "red ball", "cup/mug", "background", "1", "-1", "99", "mono8", "mono16", "8UC1",
    "16UC1", "32SC1", "rgb8", "bgr8", "bayer_rggb8", "map", "camera", "odom", "plumb_bob", "rational_polynomial",
)  # fmt: skip
TEXTS = tuple(text for text in (*ODD_STRINGS, *WORDS) if "\ud800" not in text)


def broken(message: Any, rng: random.Random) -> Any:
    """Copy a message and change some of its fields."""
    message = copy.deepcopy(message)
    if rng.random() < 0.2 and hasattr(message, "encoding"):
        return _other_image(message, rng)
    for _ in range(rng.choice((1, 1, 1, 2, 8))):
        holder, name, kind = rng.choice(list(_leaves(message)))
        value = _value(kind, getattr(holder, name), rng, is_path=name in ("path", "directory", "dataset_path"))
        setattr(holder, name, value)
    return message


def _leaves(message: Any) -> list[tuple[Any, str, str]]:
    found = []
    for name, kind in message.get_fields_and_field_types().items():
        value = getattr(message, name)
        if hasattr(value, "get_fields_and_field_types"):
            found += _leaves(value)
        else:
            found.append((message, name, kind))
    return found


def _value(kind: str, old: Any, rng: random.Random, is_path: bool) -> Any:
    if fixed := re.fullmatch(r"(\w+)\[(\d+)\]", kind):
        return _numbers(fixed[1], np.array(old), rng)
    if several := re.fullmatch(r"sequence<(\w+)(?:, \d+)?>", kind):
        return _sequence(several[1], old, rng)
    return _single(kind, rng, is_path)


def _single(kind: str, rng: random.Random, is_path: bool = False) -> Any:
    if kind == "boolean":
        return rng.random() < 0.5
    if kind in ("float", "double"):
        return rng.choice((*FLOATS, 1e300, -1e300) if kind == "double" else FLOATS)
    if kind in BITS:
        low, high = BITS[kind]
        limits = (-(2**-low) if low else 0, 2**high - 1)
        value = rng.choice((*limits, 0, 1, 2, 255, 1500, 60_000, 999_999_999, 1_000_000_000, rng.randint(*limits)))
        return min(max(value, limits[0]), limits[1])
    if kind == "string":
        return rng.choice((*PATHS, *PATHS, *TEXTS) if is_path else TEXTS)
    raise TypeError(f"no values for {kind}")


def _numbers(kind: str, values: np.ndarray, rng: random.Random) -> np.ndarray:
    for at in rng.sample(range(values.size), rng.choice((1, 1, values.size))):
        values[at] = _single(kind, rng)
    return values


def _sequence(kind: str, old: Any, rng: random.Random) -> Any:
    if kind == "string":
        return [_single(kind, rng) for _ in range(rng.choice((0, 1, 1, 2, 300)))]
    if "/" in kind or "_" in kind:
        return []
    values = list(old)
    change = rng.choice(("cut", "more", "empty", "value", "value"))
    if change == "cut":
        values = values[: rng.randrange(len(values) + 1)]
    elif change == "more":
        values += [_single(kind, rng) for _ in range(rng.choice((1, 5, 5000)))]
    elif change == "empty":
        values = []
    else:
        for _ in range(min(len(values), rng.choice((1, 10)))):
            values[rng.randrange(len(values))] = _single(kind, rng)
    return array.array(old.typecode, values) if isinstance(old, array.array) else values


def _other_image(image: Any, rng: random.Random) -> Any:
    """Make it an image of another size or encoding, its fields in agreement or nearly so."""
    encoding, width = rng.choice(
        (("mono8", 1), ("8UC1", 1), ("mono16", 2), ("16UC1", 2), ("32SC1", 4), ("rgb8", 3), ("rgba8", 4), ("64FC1", 8))
    )
    image.encoding, image.is_bigendian = encoding, rng.choice((0, 0, 0, 1, 7))
    image.width, image.height = rng.choice(
        ((image.width, image.height), (1, 1), (64, 47), (0, 48), (640, 480), (60_000, 60_000), (2**32 - 1, 2**32 - 1))
    )
    size = width * image.width * image.height
    image.step = min(width * image.width + rng.choice((0, 0, 0, 1, -1, 64)), 2**32 - 1) if image.width else 0
    filled = rng.choice((0, 1, 254, 255)) if rng.random() < 0.3 else None
    length = size if size < 1 << 22 else 4096
    data = bytes([filled]) * length if filled is not None else rng.randbytes(min(length, 4096)) * (length // 4096 + 1)
    image.data = array.array("B", data[:length])
    return image
