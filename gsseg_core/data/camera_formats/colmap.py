"""Cameras of COLMAP: the model in `sparse/0` or `sparse`, binary or text."""

from __future__ import annotations

import os
import re
import shutil
import struct
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from gsseg_core.data.camera_formats.entries import Intrinsics, cameras_of, stem_of
from gsseg_core.errors import CameraFileError, IntrinsicsError, PoseError, WriteError
from gsseg_core.files.input_files import UnfitError, is_there, open_expected, reason
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.lens import MODELS_BY_NAME
from gsseg_core.text import clipped, quoted

if TYPE_CHECKING:
    import pycolmap

_LEAST_CAMERA = 40  # bytes of a camera in a binary model, of one with two parameters
_SPACE = "\x1f"  # stands for a space in a name while pycolmap reads it


def read_colmap(path: Path, within: Path | None) -> list[Camera]:
    """Read a COLMAP model; its poses are world-to-camera in OpenCV axes, its pixel centres at +0.5, as ours."""
    model = _load(path, within)
    cameras = []
    for image_id, image in sorted(model.images.items()):
        try:
            name = image.name.replace(_SPACE, " ")
        except UnicodeDecodeError as error:
            raise CameraFileError(f"{path}, image {image_id}: its name is not UTF-8 text") from error
        where = f"{path}, image '{clipped(name)}'"
        motion = image.cam_from_world()
        if not motion.rotation.quat.any():  # pycolmap makes it the identity
            raise PoseError(f"{where}: the pose has a quaternion of zero; expected a unit quaternion")
        pose = np.vstack([motion.matrix(), (0, 0, 0, 1)])
        cameras += cameras_of(where, stem_of(name), _intrinsics(where, model.cameras[image.camera_id]), pose)
    return cameras


def _intrinsics(where: str, camera: pycolmap.Camera) -> Intrinsics:
    """Read the lens of a COLMAP camera."""
    if camera.model_name not in MODELS_BY_NAME:
        raise IntrinsicsError(
            f"{where}: camera is {clipped(camera.model_name)} ({clipped(camera.params_info)}); expected one of "
            f"{', '.join(MODELS_BY_NAME)}: undistort the images first"
        )
    params = dict(zip(camera.params_info.replace(" ", "").split(","), camera.params.tolist(), strict=True))
    fx = params.get("f", params.get("fx", 1.0))
    focal, principal = (fx, params.get("fy", fx)), (params.get("cx", 0.0), params.get("cy", 0.0))
    model = MODELS_BY_NAME[camera.model_name]
    params["k1"] = params.get("k1", params.get("k", 0.0))
    coefficients = {name: params[name] for name in model.coefficients if name in params}
    return Intrinsics(model, (camera.width, camera.height), focal, principal, coefficients)


def _load(path: Path, within: Path | None) -> pycolmap.Reconstruction:
    """Load the cameras and images of a COLMAP model, without its points.

    The points are not needed and take long to read, and pycolmap never returns from a truncated list of them. It does
    not notice either that a binary file ends too early or that a count is impossible, so both are checked here.
    """
    try:
        import pycolmap
    except ImportError as error:
        raise CameraFileError(f"{path}: to read a COLMAP model, install pycolmap") from error
    suffix = ".bin" if (path / "cameras.bin").is_file() else ".txt"
    cameras, images = (path / f"{name}{suffix}" for name in ("cameras", "images"))
    if not is_there(images, CameraFileError):
        raise CameraFileError(f"{path}: COLMAP model has {cameras.name} but no {images.name}")
    with _temporary_folder(path) as folder:
        # What was checked is what pycolmap reads, so it gets a copy.
        for file, copy in zip((cameras, images), _COPIES[suffix], strict=True):
            copied = BytesIO()
            try:
                with open_expected(file, CameraFileError, within=within) as source:
                    copy(source, copied)
            except UnfitError as error:
                raise CameraFileError(f"{file}: {error}") from error
            except (struct.error, ValueError) as error:
                raise CameraFileError(f"{file}: is truncated; expected a whole COLMAP model") from error
            (Path(folder) / file.name).write_bytes(copied.getvalue())
        (Path(folder) / f"points3D{suffix}").write_bytes(bytes(8) if suffix == ".bin" else b"")
        try:
            model = pycolmap.Reconstruction(folder)
        except Exception as error:  # whatever its C++ parser makes of a broken file
            why = clipped(str(error).strip().replace(folder, str(path)), 300)
            raise CameraFileError(f"{path}: not a readable COLMAP model ({why})") from error
        size = 8 + sum(24 + 8 * len(lens.params) for lens in model.cameras.values())
        found = (Path(folder) / cameras.name).stat().st_size
    if suffix == ".bin" and found < size:
        raise CameraFileError(f"{cameras}: is truncated; expected at least {size} bytes")
    return model


@contextmanager
def _temporary_folder(path: Path) -> Iterator[str]:
    """Make a folder for a copy of a model, for as long as the context; `WriteError` if it cannot be written."""
    try:
        with tempfile.TemporaryDirectory() as folder:
            yield folder
    except OSError as error:
        raise WriteError(
            f"{tempfile.tempdir or 'temporary folder'}: cannot be written ({reason(error)}); expected space for a copy "
            f"of {path}, there or in a folder that the environment variable TMPDIR names"
        ) from error


def _copy_cameras(source: BinaryIO, target: BinaryIO) -> None:
    """Copy a binary list of cameras; `ValueError` if it is shorter than its count says."""
    content = source.read()
    (count,) = struct.unpack_from("<Q", content)
    if len(content) < 8 + _LEAST_CAMERA * count:
        raise ValueError(f"{count} cameras")
    target.write(content)


def _copy_images(source: BinaryIO, target: BinaryIO) -> None:
    """Copy a binary list of images without their points; `ValueError` or `struct.error` if it ends too early."""
    size = os.fstat(source.fileno()).st_size
    count = source.read(8)
    target.write(count)
    for _ in range(struct.unpack("<Q", count)[0]):
        # Id, quaternion, translation and camera id; the name up to its 0; the number of points, and the points.
        pose, name = source.read(64), bytearray()
        while (letter := source.read(1)) != b"\0":
            if not letter:
                raise ValueError("no end of a name")
            name += letter
        (points,) = struct.unpack("<Q", source.read(8))
        if source.tell() + 24 * points > size:
            raise ValueError(f"{points} points")
        source.seek(24 * points, os.SEEK_CUR)
        target.write(pose + bytes(name) + bytes(9))


def _copy_images_of_text(source: BinaryIO, target: BinaryIO) -> None:
    """Copy a list of images in text without their points, each in two lines; spaces in names are replaced.

    COLMAP itself writes such names, and pycolmap would end them there. Raises `UnfitError` where no line of points
    follows an image.
    """
    for line in source:
        if (image := line.strip()) and not image.startswith(b"#"):
            *pose, name = image.split(None, 9)
            points = next(source, b"\n")  # pycolmap forgets an image without this line
            if (last := points.rsplit(None, 1)[-1:]) and not re.fullmatch(rb"[-+.0-9eE]+", last[0]):
                image_name, found = (quoted(text[:60].decode(errors="replace")) for text in (name, points))
                raise UnfitError(
                    f"after image {image_name} comes {found}; expected its points, or an empty line if there are none"
                )
            line = b" ".join([*pose, name.replace(b" ", _SPACE.encode())]) + b"\n\n"  # of its points, an empty line
        target.write(line)


_COPIES: dict[str, tuple[Callable[[BinaryIO, BinaryIO], None], ...]] = {
    ".bin": (_copy_cameras, _copy_images),
    ".txt": (shutil.copyfileobj, _copy_images_of_text),
}
