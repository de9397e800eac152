"""Files broken on purpose: bytes, and the structure of JSON, npz, PNG and PLY with the container left valid.

Every function takes the bytes of a good file and a generator of random numbers, and returns other bytes.
"""

from __future__ import annotations

import copy
import io
import json
import random
import struct
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

Mutation = Callable[[bytes, random.Random], bytes]

ODD_NUMBERS = (
    0, -1, 1, 2, 7, 254, 255, 256, 1500, 65534, 65535, 65536, 2**31 - 1, 2**31, -(2**31), 2**32, 2**63 - 1, 2**63,
    10**400, 0.5, -0.0, 1e-300, 1e30, 1e300, -1e300, float("nan"), float("inf"), float("-inf"),
)  # fmt: skip
ODD_STRINGS = (
    "", " ", "a", "0", "-1", "7", "NaN", "background", "red ball", "../../etc/passwd", "/", ".", "..", "a/b", "a\\b",
    "a\nb", "\x1b[31mred\x1b[0m", "a\0b", "\ud800", "\u202eabc", "ü" * 200, "x" * 300, "y" * 1_000_000, "<script>",
    "![](http://x)", "{}", "%s%n", "view0", "view0.png",
)  # fmt: skip
DEEP = 5000
"""Levels of a list in lists: more than a reader that calls itself can take."""
BOMB = 3 << 30
"""Bytes to which a member of some kilobytes inflates."""
ZEROS = [bytes(1 << 22)] * (BOMB >> 22)
"""So many, in pieces that are one and the same."""


def any_bytes(data: bytes, rng: random.Random) -> bytes:
    """Damage of no particular kind: bits, ends, pieces."""
    if not data:
        return rng.randbytes(rng.randrange(1, 64))
    changed, at = bytearray(data), rng.randrange(len(data))
    length = min(rng.choice((1, 2, 4, 8, 64, 1024)), len(data) - at)
    kind = rng.choice(("flip", "flip", "cut", "repeat", "remove", "zero", "ones", "insert", "empty", "swap"))
    if kind == "flip":
        for _ in range(rng.choice((1, 1, 2, 8, 64))):
            changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    elif kind == "cut":
        del changed[at:]
    elif kind == "repeat":
        changed[at:at] = data[at : at + length] * rng.choice((1, 2, 50))
    elif kind == "remove":
        del changed[at : at + length]
    elif kind in ("zero", "ones"):
        changed[at : at + length] = (b"\0" if kind == "zero" else b"\xff") * length
    elif kind == "insert":
        changed[at:at] = rng.randbytes(length)
    elif kind == "empty":
        changed.clear()
    else:
        other = rng.randrange(len(data))
        changed[at : at + length], changed[other : other + length] = (
            data[other : other + length], data[at : at + length]
        )  # fmt: skip
    return bytes(changed)


def json_values(data: bytes, rng: random.Random) -> bytes:
    """Values and keys of a JSON text replaced; what comes out is JSON as Python writes it."""
    content = json.loads(data)
    for _ in range(rng.choice((1, 1, 1, 2, 5))):
        content = _changed_json(content, rng)
    return _dumped(content, rng)


def _changed_json(content: Any, rng: random.Random) -> Any:
    content = copy.deepcopy(content)
    places = list(_places(content))
    if not places or rng.random() < 0.03:
        return _odd(rng, content)
    holder, key = rng.choice(places)
    kind = rng.choice(("value", "value", "value", "delete", "copy", "rename"))
    if kind == "value":
        holder[key] = _odd(rng, holder[key])
    elif kind == "delete":
        del holder[key]
    elif kind == "copy":
        other, name = rng.choice(places)
        holder[key] = copy.deepcopy(other[name])
    elif isinstance(holder, dict):
        holder[str(rng.choice((*ODD_STRINGS, *ODD_NUMBERS)))] = holder.pop(key)
    else:
        holder.append(copy.deepcopy(holder[key]))
    return content


def _places(content: Any) -> list[tuple[Any, Any]]:
    keys = list(content) if isinstance(content, dict) else range(len(content)) if isinstance(content, list) else []
    below = [place for key in keys for place in _places(content[key])]
    return [*((content, key) for key in keys), *below]


def _odd(rng: random.Random, value: Any) -> Any:
    simple = (None, True, False, [], {}, [[]], [None], {"": None}, "<deep>", [value] * 2, {"a": value}, str(value)[:99])
    return rng.choice((rng.choice(ODD_NUMBERS), rng.choice(ODD_NUMBERS), rng.choice(ODD_STRINGS), rng.choice(simple)))


def _dumped(content: Any, rng: random.Random) -> bytes:
    text = json.dumps(content, indent=rng.choice((None, 1)))
    return text.replace('"<deep>"', "[" * DEEP + "]" * DEEP).encode("utf-8", "surrogatepass")


def npz_members(data: bytes, rng: random.Random) -> bytes:
    """Members of an npz of other shapes, types and values; those that the zip names are all there, or one too few."""
    members = unzipped(data)
    if not members:
        return data
    name = rng.choice(sorted(members))
    content = members[name]
    array = np.load(io.BytesIO(content), allow_pickle=False)
    kind = rng.choice(("array", "array", "array", "array", "drop", "bytes", "raw", "claim", "rename", "bomb"))
    if kind == "array":
        members[name] = _npy(_changed_array(array, rng))
    elif kind == "drop":
        del members[name]
    elif kind == "bytes":
        members[name] = any_bytes(content, rng)
    elif kind == "raw":
        members[name] = rng.choice((b"", b"text", b"\x93NUMPY", rng.randbytes(99)))
    elif kind == "claim":
        members[name] = _claiming(array, rng)
    elif kind == "rename":
        members[rng.choice(("other.npy", "codes.npy", "../x.npy", "labels_0.npy"))] = members.pop(name)
    elif rng.random() < 0.1:
        members[name] = _bomb()
    return zipped(members)


def _changed_array(array: np.ndarray, rng: random.Random) -> np.ndarray:
    if array.dtype.kind == "U" and array.ndim == 0 and rng.random() < 0.8:
        return np.array(json_values(str(array).encode(), rng).decode("utf-8", "replace"))
    kind = rng.choice(("shape", "type", "value", "value", "value"))
    if kind == "shape":
        one = rng.randrange(max(1, len(array))) if array.ndim else 0
        shapes = (array.T, array[None], array.ravel(), array.ravel()[:1].reshape(()) if array.size else array,
                  array[:0] if array.ndim else array, array[:one] if array.ndim else array,
                  np.concatenate([array, array]) if array.ndim else array)  # fmt: skip
        return shapes[rng.randrange(len(shapes))]
    if kind == "type":
        with np.errstate(all="ignore"):
            numbers = ("?", "i1", "u8", "i8", "f2", "f8", "c16", "M8[s]")
            return array.astype(rng.choice(("S5", "U5", *(() if array.dtype.kind in "SU" else numbers))))
    if array.dtype.kind not in "iufb" or not array.size:
        return np.zeros_like(array)
    changed = array.astype(array.dtype.newbyteorder(rng.choice("=<>")), copy=True)
    flat = changed.reshape(-1)
    for at in rng.sample(range(flat.size), min(flat.size, rng.choice((1, 5, flat.size)))):
        odd = rng.choice(ODD_NUMBERS)
        with np.errstate(all="ignore"):
            if array.dtype.kind == "f":
                flat[at] = float(odd) if abs(odd) < 1e308 or odd != odd else float("inf")
            else:
                limits = np.iinfo(array.dtype) if array.dtype.kind in "iu" else None
                whole = int(odd) if odd == odd and abs(odd) < 1e300 else 0
                flat[at] = bool(whole) if limits is None else min(max(whole, limits.min), limits.max)
    return changed


def _claiming(array: np.ndarray, rng: random.Random) -> bytes:
    """Pack a small array as a member whose header claims a huge one."""
    shape = rng.choice(((2**40,), (60_000, 60_000), (100_000, 100_000, 4), (2**62,), (-1,), (2**70,), (0, 2**40)))
    header = f"{{'descr': '{array.dtype.str}', 'fortran_order': False, 'shape': {shape}, }}".encode()
    header += b" " * (-(len(header) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + array.tobytes()[:1024]


def _npy(array: np.ndarray) -> bytes:
    packed = io.BytesIO()
    np.lib.format.write_array(packed, array, allow_pickle=False)
    return packed.getvalue()


def unzipped(data: bytes) -> dict[str, Any]:
    """Read the members of a zip."""
    with zipfile.ZipFile(io.BytesIO(data)) as file:
        return {name: file.read(name) for name in file.namelist()}


def zipped(members: Mapping[str, bytes | Sequence[bytes]]) -> bytes:
    """Pack members, some of them in pieces, into a zip."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in members.items():
            info = zipfile.ZipInfo(name)  # With no time of its own: the same draw gives the same bytes.
            info.compress_type = zipfile.ZIP_DEFLATED
            if isinstance(content, bytes):
                file.writestr(info, content)
                continue
            with file.open(info, "w", force_zip64=True) as member:
                member.writelines(content)
    return packed.getvalue()


def _bomb() -> list[bytes]:
    """Pack an array of zeros, in pieces."""
    start = _npy(np.zeros(0))
    return [start.replace(b"(0,)", f"({BOMB // 8},)".encode())[: len(start)], *ZEROS]


def png_chunks(data: bytes, rng: random.Random) -> bytes:
    """Make a PNG with another header, other pixels, or other chunks; the check sums hold."""
    if rng.random() < 0.4:
        return _other_pixels(data, rng)
    chunks, at = [], 8
    while at + 8 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + length]))
        at += length + 12
    kind = rng.choice(("header", "header", "header", "drop", "twice", "order", "text", "content"))
    which = rng.randrange(len(chunks))
    if kind == "header":
        fields = list(struct.unpack(">IIBBBBB", chunks[0][1]))
        odd = ((0, 1, 10, 1000, 60_000, 100_000, 2**31 - 1, 2**32 - 1), (1, 2, 4, 8, 16, 3), (0, 2, 3, 4, 6, 9), (0, 1))
        at = rng.randrange(7)
        fields[at] = rng.choice(odd[0] if at < 2 else odd[1] if at == 2 else odd[2] if at == 3 else odd[3])
        if at == 0 and rng.random() < 0.5:
            fields[1] = fields[0]
        chunks[0] = (b"IHDR", struct.pack(">IIBBBBB", *fields))
    elif kind == "drop":
        del chunks[which]
    elif kind == "twice":
        chunks.insert(which, chunks[which])
    elif kind == "order":
        rng.shuffle(chunks)
    elif kind == "text":
        chunks.insert(1, (b"zTXt", b"a\0\0" + zlib.compress(b"b" * 100_000_000 if rng.random() < 0.1 else b"b")))
    else:
        chunks[which] = (chunks[which][0], any_bytes(chunks[which][1], rng))
    packed = (struct.pack(">I", len(c)) + t + c + struct.pack(">I", zlib.crc32(t + c)) for t, c in chunks)
    return data[:8] + b"".join(packed)


def _other_pixels(data: bytes, rng: random.Random) -> bytes:
    with Image.open(io.BytesIO(data)) as image:
        pixels = np.array(image)
    kind = rng.choice(("label", "label", "mode", "size"))
    packed = io.BytesIO()
    if kind == "label":
        limit = np.iinfo(pixels.dtype).max if pixels.dtype.kind in "iu" else 1
        pixels.reshape(-1)[rng.randrange(pixels.size)] = min(
            rng.choice((4, 9, 99, 254, 255, 1500, 65534, 65535)), limit
        )
        Image.fromarray(pixels).save(packed, "PNG")
    elif kind == "mode":
        mode = rng.choice(("1", "L", "LA", "P", "RGB", "RGBA", "I;16"))
        other = Image.fromarray(pixels.astype(np.uint8)).convert("I" if mode == "I;16" else mode)
        (Image.fromarray(pixels.astype(np.uint16)) if mode == "I;16" else other).save(packed, "PNG")
    else:
        size = rng.choice(((1, 1), (16, 11), (12, 16), (32, 24), (4000, 3000)))
        Image.fromarray(pixels.astype(np.uint8)).resize(size, Image.Resampling.NEAREST).save(packed, "PNG")
    return packed.getvalue()


def ply_header(data: bytes, rng: random.Random) -> bytes:
    """Make a PLY with another header, or other numbers in its body."""
    header, end, body = data.partition(b"end_header\n")
    if rng.random() < 0.4:
        return header + end + _odd_floats(body, rng)
    lines, at = header.split(b"\n")[:-1], rng.randrange(header.count(b"\n"))
    kind = rng.choice(("count", "count", "drop", "twice", "word", "order"))
    if kind == "count":
        at = next(i for i, line in enumerate(lines) if line.startswith(b"element"))
        lines[at] = b"element vertex " + str(rng.choice((*ODD_NUMBERS, "x", ""))).encode()[:400]
    elif kind == "drop":
        del lines[at]
    elif kind == "twice":
        lines.insert(at, lines[at])
    elif kind == "order":
        first = 3 if len(lines) > 3 else 0
        rest = lines[first:]
        rng.shuffle(rest)
        lines[first:] = rest
    else:
        words = lines[at].split(b" ")
        odd = (
            b"float",
            b"double",
            b"uchar",
            b"list",
            b"int",
            b"ascii",
            b"binary_big_endian",
            b"face",
            b"x",
            b"",
            b"\xff",
        )
        words[rng.randrange(len(words))] = rng.choice(odd)
        lines[at] = b" ".join(words)
    return b"\n".join(lines) + b"\n" + end + body


def _odd_floats(body: bytes, rng: random.Random) -> bytes:
    values = np.frombuffer(body[: len(body) // 4 * 4], "<f4").copy()
    for _ in range(rng.choice((1, 10, 1000))):
        odd = rng.choice((0.0, np.nan, np.inf, -np.inf, 1e38, -1e38, 1e-38, 100.0, -100.0))
        values[rng.randrange(len(values))] = odd
    return values.tobytes()


def words(data: bytes, rng: random.Random) -> bytes:
    """Make a text with words of it replaced, dropped or repeated."""
    lines = [line.split(" ") for line in data.decode().split("\n")]
    for _ in range(rng.choice((1, 1, 3))):
        line = rng.choice(lines)
        at = rng.randrange(len(line))
        odd = str(rng.choice((*ODD_NUMBERS, *ODD_STRINGS)))
        kind = rng.choice(("replace", "replace", "drop", "repeat", "line"))
        if kind == "replace":
            line[at] = odd
        elif kind == "drop" and len(line) > 1:
            del line[at]
        elif kind == "repeat":
            line.insert(at, line[at])
        else:
            lines.insert(rng.randrange(len(lines)), list(line))
    return "\n".join(" ".join(line) for line in lines).encode("utf-8", "surrogatepass")


def numbers(data: bytes, rng: random.Random) -> bytes:
    """Whole and real numbers of a binary format replaced where some may stand."""
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 3))):
        packed = rng.choice((
            struct.pack("<Q", rng.choice((0, 1, 2**31, 2**32 - 1, 2**62, 2**64 - 1))),
            struct.pack("<i", rng.choice((0, -1, 1, 5, 2**31 - 1))),
            struct.pack("<d", rng.choice((0.0, float("nan"), float("inf"), 1e300, -1.0))),
        ))  # fmt: skip
        at = rng.randrange(max(1, len(changed) - len(packed)))
        changed[at : at + len(packed)] = packed
    return bytes(changed)


def not_a_file(path: Path, rng: random.Random) -> str:
    """Put something else in the place of a file; returns what."""
    path.unlink()
    kind = rng.choice(("a folder", "a dangling link", "a link to itself", "a FIFO", "nothing", "a device"))
    if kind == "a folder":
        path.mkdir()
    elif kind == "a FIFO":
        import os

        os.mkfifo(path)
    elif kind != "nothing":
        path.symlink_to({"a dangling link": "gone", "a link to itself": path.name, "a device": "/dev/zero"}[kind])
    return kind
