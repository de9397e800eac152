"""Cameras of COLMAP: the model in `sparse/0` or `sparse`, binary or text.

pycolmap reads all points along, and never returns from a truncated list of them; here, they are passed over.
"""

from __future__ import annotations

import math
import os
import re
import struct
from collections.abc import Callable, Iterator
from io import BufferedReader
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from gsseg_core.data.camera_formats.entries import Intrinsics, cameras_of, stem_of
from gsseg_core.errors import CameraFileError, IntrinsicsError, PoseError
from gsseg_core.files.input_files import UnfitError, is_there, open_expected, reason
from gsseg_core.scene.camera import Camera, rigid_motion
from gsseg_core.scene.lens import MODELS_BY_NAME
from gsseg_core.scene.quaternions import rotations
from gsseg_core.text import clipped, quoted

T = TypeVar("T")

# COLMAP's lens models in the order of their numbers in binary files, with the names of their parameters.
_PARAMETERS = {
    "SIMPLE_PINHOLE": "f cx cy", "PINHOLE": "fx fy cx cy", "SIMPLE_RADIAL": "f cx cy k1", "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2", "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6", "FOV": "fx fy cx cy omega",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1", "RADIAL_FISHEYE": "f cx cy k1 k2",
    "THIN_PRISM_FISHEYE": "fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1",
    "RAD_TAN_THIN_PRISM_FISHEYE": "fx fy cx cy k0 k1 k2 k3 k4 k5 p0 p1 s0 s1 s2 s3",
    "SIMPLE_DIVISION": "f cx cy k", "DIVISION": "fx fy cx cy k", "SIMPLE_FISHEYE": "f cx cy", "FISHEYE": "fx fy cx cy",
    "EUCM": "fx fy cx cy alpha beta", "EQUIRECTANGULAR": "w h",
}  # fmt: skip


class _Lens(NamedTuple):
    id: int
    model: str
    size: tuple[int, int]
    parameters: dict[str, float]


class _Image(NamedTuple):
    id: int
    quat: list[float]  # w, x, y, z, world to camera
    translation: list[float]
    lens: int
    name: bytes


def read_colmap(path: Path, within: Path | None) -> list[Camera]:
    """Read a COLMAP model; its poses are world-to-camera in OpenCV axes, its pixel centres at +0.5, as ours."""
    suffix = ".bin" if (path / "cameras.bin").is_file() else ".txt"
    lens_file, image_file = (path / f"{name}{suffix}" for name in ("cameras", "images"))
    if not is_there(image_file, CameraFileError):
        raise CameraFileError(f"{path}: COLMAP model has {lens_file.name} but no {image_file.name}")
    read_lenses, read_images = _READERS[suffix]
    lenses = {lens.id: lens for lens in _records(lens_file, within, read_lenses)}
    cameras = []
    for image in sorted(_records(image_file, within, read_images)):
        try:
            name = image.name.decode()
        except UnicodeDecodeError as error:
            raise CameraFileError(f"{path}, image {image.id}: its name is not UTF-8 text") from error
        where = f"{path}, image '{clipped(name)}'"
        if image.lens not in lenses:
            raise CameraFileError(f"{where}: not a readable COLMAP model (there is no camera {image.lens})")
        if not any(image.quat):
            raise PoseError(f"{where}: the pose has a quaternion of zero; expected a unit quaternion")
        with np.errstate(all="ignore"):  # A camera refuses what is NaN or too large.
            pose = rigid_motion(rotations(np.array([image.quat]))[0], image.translation)
        cameras += cameras_of(where, stem_of(name), _intrinsics(where, lenses[image.lens]), pose)
    return cameras


def _intrinsics(where: str, lens: _Lens) -> Intrinsics:
    if lens.model not in MODELS_BY_NAME:
        raise IntrinsicsError(
            f"{where}: camera is {lens.model} ({', '.join(lens.parameters)}); expected one of "
            f"{', '.join(MODELS_BY_NAME)}: undistort the images first"
        )
    model, given = MODELS_BY_NAME[lens.model], lens.parameters
    fx = given.get("f", given.get("fx", 1.0))
    focal, principal = (fx, given.get("fy", fx)), (given.get("cx", 0.0), given.get("cy", 0.0))
    coefficients = {name: given[name] for name in model.coefficients if name in given}
    return Intrinsics(model, lens.size, focal, principal, coefficients)


def _records(path: Path, within: Path | None, read: Callable[[BufferedReader], Iterator[T]]) -> list[T]:
    """Read all records of a file; `CameraFileError` where it ends too early, or holds something else."""
    with open_expected(path, CameraFileError, within=within) as file:
        try:
            return list(read(file))
        except UnfitError as error:
            raise CameraFileError(f"{path}: {error}") from error
        except (struct.error, EOFError) as error:
            raise CameraFileError(f"{path}: is truncated; expected a whole COLMAP model") from error
        except (ValueError, KeyError) as error:
            raise CameraFileError(f"{path}: not a readable COLMAP model ({reason(error)})") from error


def _binary_lenses(file: BufferedReader) -> Iterator[_Lens]:
    (count,) = struct.unpack("<Q", file.read(8))
    for _ in range(count):
        number, model, width, height = struct.unpack("<IIQQ", file.read(24))
        if model >= len(_PARAMETERS):
            raise UnfitError(f"has a camera of the model {model}; expected one of 0 to {len(_PARAMETERS) - 1}")
        name = list(_PARAMETERS)[model]
        parameters = _PARAMETERS[name].split()
        values = struct.unpack(f"<{len(parameters)}d", file.read(8 * len(parameters)))
        yield _Lens(number, name, (width, height), dict(zip(parameters, values, strict=True)))


def _binary_images(file: BufferedReader) -> Iterator[_Image]:
    size = os.fstat(file.fileno()).st_size
    (count,) = struct.unpack("<Q", file.read(8))
    for _ in range(count):
        number, *pose, lens = struct.unpack("<I7dI", file.read(64))
        name = bytearray()
        while (letter := file.read(1)) != b"\0":
            if not letter:
                raise EOFError
            name += letter
        (points,) = struct.unpack("<Q", file.read(8))
        if file.tell() + 24 * points > size:
            raise EOFError
        file.seek(24 * points, os.SEEK_CUR)
        yield _Image(number, pose[:4], pose[4:], lens, bytes(name))


def _text_lenses(file: BufferedReader) -> Iterator[_Lens]:
    for line in _lines(file):
        number, model, width, height, *values = line.split()
        parameters = dict(zip(_PARAMETERS[model.decode()].split(), _numbers(values), strict=True))
        yield _Lens(int(number), model.decode(), (int(width), int(height)), parameters)


def _text_images(file: BufferedReader) -> Iterator[_Image]:
    """Read images, each in two lines, the second of which, its points, may be empty; `UnfitError` where that lacks."""
    for line in _lines(file):
        number, qw, qx, qy, qz, tx, ty, tz, lens, name = line.split(None, 9)
        points = next(file, b"")
        if (last := points.rsplit(None, 1)[-1:]) and not re.fullmatch(rb"[-+.0-9eE]+", last[0]):
            image_name, found = (quoted(text[:60].decode(errors="replace")) for text in (name, points))
            raise UnfitError(
                f"after image {image_name} comes {found}; expected its points, or an empty line if there are none"
            )
        yield _Image(int(number), _numbers([qw, qx, qy, qz]), _numbers([tx, ty, tz]), int(lens), name)


def _lines(file: BufferedReader) -> Iterator[bytes]:
    """Give the lines that are neither empty nor comments."""
    return (line.strip() for line in file if line.strip() and not line.strip().startswith(b"#"))


def _numbers(texts: list[bytes]) -> list[float]:
    numbers = [float(text) for text in texts]
    if not all(map(math.isfinite, numbers)):
        raise ValueError(f"{numbers} are no numbers")
    return numbers


_READERS = {".bin": (_binary_lenses, _binary_images), ".txt": (_text_lenses, _text_images)}
