"""Cameras of a dataset folder: 3DGS `cameras.json`, nerfstudio `transforms.json`, or a COLMAP model."""

from __future__ import annotations

import math
import os
import shutil
import struct
import tempfile
from collections import Counter
from pathlib import Path, PureWindowsPath
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
import numpy.typing as npt

from gsseg_core.data.hints import camera_hint
from gsseg_core.data.names import flaw_of_view_name
from gsseg_core.errors import CameraFileError, IntrinsicsError, PoseError
from gsseg_core.files.input_files import is_there, open_input, reason
from gsseg_core.files.json_files import kind_of, read_json
from gsseg_core.scene.camera import Camera
from gsseg_core.text import clipped, quoted

if TYPE_CHECKING:
    import pycolmap

_IMAGE_SUFFIXES = {".bmp", ".exr", ".heic", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp"}
# COLMAP models that are a pinhole once their distortion is zero; a fisheye is not.
_COLMAP_MODELS = {"SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"}
_LEAST_CAMERA = 48
"""Bytes of a camera in a binary model, of three parameters."""
_NERFSTUDIO_MODELS = {"PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "PERSPECTIVE"}
_NERFSTUDIO_DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")


def read_cameras(folder: str | os.PathLike[str], within: Path | None = None) -> list[Camera]:
    """Read the cameras of a dataset folder.

    They come from the first that is there of `cameras.json` (3DGS), `transforms.json` (nerfstudio), `sparse/0` and
    `sparse` (COLMAP, bin or txt).

    Parameters
    ----------
    folder : path
        The dataset.
    within : pathlib.Path, optional
        A folder below which the files must lie, links followed.

    Returns
    -------
    list of Camera
        In the order of the file. Names are the stems of the image names.

    Raises
    ------
    CameraFileError
        No cameras are there, or a file is broken, or two images share a stem.
    PoseError, IntrinsicsError
        A camera is unusable; only undistorted images are supported.
    PathNotAllowedError
        A file lies outside `within`.
    """
    folder = Path(folder)
    if is_there(folder / "cameras.json", CameraFileError):
        path = folder / "cameras.json"
        cameras = _read_3dgs(path, within)
    elif is_there(folder / "transforms.json", CameraFileError):
        path = folder / "transforms.json"
        cameras = _read_nerfstudio(path, within)
    else:
        models = [
            model
            for model in (folder / "sparse" / "0", folder / "sparse")
            if is_there(model / "cameras.bin", CameraFileError) or is_there(model / "cameras.txt", CameraFileError)
        ]
        if not models:
            hint = camera_hint(folder) if within is None else ""  # It looks around, wherever links lead.
            what = "has no cameras" if folder.is_dir() else "is not a folder"
            raise CameraFileError(
                f"{folder}: {what}; looked for cameras.json (3DGS), transforms.json (nerfstudio), and cameras.bin or "
                f"cameras.txt in sparse/0 or sparse (COLMAP){hint}"
            )
        path = models[0]
        cameras = _read_colmap(path, within)
    if not cameras:
        raise CameraFileError(f"{path}: holds no camera; expected at least one")
    for camera in cameras:
        if flaw := flaw_of_view_name(camera.name):
            raise CameraFileError(f"{path}: an image has the name {flaw}")
    stem, count = Counter(camera.name for camera in cameras).most_common(1)[0]
    if count > 1:
        raise CameraFileError(
            f"{path}: {count} images have the stem {quoted(stem)}; expected another stem for each image"
        )
    return cameras


def _read_3dgs(path: Path, within: Path | None) -> list[Camera]:
    """Read camera-to-world poses in OpenCV axes; the principal point is the image's centre."""
    cameras = []
    for where, entry in _entries(path, read_json(path, CameraFileError, within), "a list of cameras"):
        width, height = _size(where, entry, "width"), _size(where, entry, "height")
        K = _intrinsics(_number(where, entry, "fx"), _number(where, entry, "fy"), width / 2, height / 2)
        pose = _inverse(_array(where, entry, "rotation", (3, 3)), _array(where, entry, "position", (3,)))
        cameras.append(_camera(where, _stem(where, entry, "img_name"), width, height, K, pose))
    return cameras


def _read_nerfstudio(path: Path, within: Path | None) -> list[Camera]:
    """Read camera-to-world poses in OpenGL axes (y up, z backward), intrinsics per file or per frame."""
    content = read_json(path, CameraFileError, within)
    if not isinstance(content, dict):
        raise CameraFileError(f"{path}: holds {kind_of(content)}; expected an object with 'frames'")
    shared = {key: value for key, value in content.items() if key != "frames"}
    cameras = []
    for where, frame in _entries(path, content.get("frames"), "a list 'frames'"):
        name = _stem(where, frame, "file_path")
        entry = {**shared, **frame}
        _refuse_nerfstudio_lens(where, entry)
        if "w" not in entry or "h" not in entry:
            raise IntrinsicsError(f"{where}: the image size is missing; expected 'w' and 'h', here or for all frames")
        width, height = _size(where, entry, "w"), _size(where, entry, "h")
        fx = _focal(where, entry, "fl_x", "camera_angle_x", width)
        fy = _focal(where, entry, "fl_y", "camera_angle_y", height)
        if fx is None:
            raise IntrinsicsError(f"{where}: the focal length is missing; expected 'fl_x' or 'camera_angle_x'")
        K = _intrinsics(
            fx,
            fx if fy is None else fy,
            _number(where, entry, "cx") if "cx" in entry else width / 2,
            _number(where, entry, "cy") if "cy" in entry else height / 2,
        )
        matrix = _array(where, entry, "transform_matrix", (4, 4), (3, 4))
        if matrix.shape == (4, 4) and not np.array_equal(matrix[3], (0, 0, 0, 1)):
            raise PoseError(f"{where}: the last row of the pose is {matrix[3].tolist()}; expected 0 0 0 1")
        pose = _inverse(matrix[:3, :3] * (1, -1, -1), matrix[:3, 3])
        cameras.append(_camera(where, name, width, height, K, pose))
    return cameras


def _refuse_nerfstudio_lens(where: str, entry: dict[str, Any]) -> None:
    model = str(entry.get("camera_model", "PINHOLE")).upper()
    if model not in _NERFSTUDIO_MODELS or entry.get("is_fisheye"):
        raise IntrinsicsError(
            f"{where}: camera model is {clipped(model)}; expected a pinhole: undistort the images first"
        )
    bent = [key for key in _NERFSTUDIO_DISTORTION if entry.get(key)]
    if bent:
        raise IntrinsicsError(
            f"{where}: the lens has distortion ({', '.join(f'{key} = {clipped(entry[key])}' for key in bent)}); "
            "expected none: undistort the images first"
        )


def _focal(where: str, entry: dict[str, Any], key: str, angle_key: str, size: int) -> float | None:
    """Focal length in pixels, from itself or from the field of view in radians."""
    if key in entry:
        return _number(where, entry, key)
    if angle_key in entry:
        angle = _number(where, entry, angle_key)
        if not 0 < angle < math.pi:
            raise IntrinsicsError(f"{where}: '{angle_key}' is {angle:g}; expected radians between 0 and pi")
        return size / 2 / math.tan(angle / 2)
    return None


def _read_colmap(path: Path, within: Path | None) -> list[Camera]:
    """Read a COLMAP model; its poses are world-to-camera in OpenCV axes, its pixel centres at +0.5, as ours."""
    model = _load_colmap(path, within)
    cameras = []
    for image_id, image in sorted(model.images.items()):
        try:
            name = image.name
        except UnicodeDecodeError as error:
            raise CameraFileError(f"{path}, image {image_id}: its name is not UTF-8 text") from error
        where = f"{path}, image '{clipped(name)}'"
        lens = model.cameras[image.camera_id]
        if lens.model_name not in _COLMAP_MODELS or any(lens.params[i] for i in lens.extra_params_idxs()):
            raise IntrinsicsError(
                f"{where}: camera is {lens.model_name} ({lens.params_info}: {clipped(lens.params_to_string())}); "
                "expected one without distortion: undistort the images first"
            )
        K = _intrinsics(lens.focal_length_x, lens.focal_length_y, lens.principal_point_x, lens.principal_point_y)
        motion = image.cam_from_world()
        if not motion.rotation.quat.any():  # pycolmap makes it the identity
            raise PoseError(f"{where}: the pose has a quaternion of zero; expected a unit quaternion")
        pose = np.vstack([motion.matrix(), (0, 0, 0, 1)])
        cameras.append(_camera(where, _stem_of(name), lens.width, lens.height, K, pose))
    return cameras


def _load_colmap(path: Path, within: Path | None) -> pycolmap.Reconstruction:
    """Load the cameras and images of a COLMAP model, without its points.

    The points are not needed and take long to read, and pycolmap does not return from a truncated list of them. Nor
    does it notice that a binary file ends too early, or a count is impossible, so that is found out here.
    """
    try:
        import pycolmap
    except ImportError as error:
        raise CameraFileError(f"{path}: to read a COLMAP model, install pycolmap") from error
    suffix = ".bin" if (path / "cameras.bin").is_file() else ".txt"
    cameras, images = (path / f"{name}{suffix}" for name in ("cameras", "images"))
    if not is_there(images, CameraFileError):
        raise CameraFileError(f"{path}: COLMAP model has {cameras.name} but no {images.name}")
    with tempfile.TemporaryDirectory() as folder:
        # What was checked is what pycolmap reads, so it gets a copy.
        for file, copy in ((cameras, _copy_cameras), (images, _copy_images)):
            try:
                with open_input(file, within) as source, open(Path(folder) / file.name, "wb") as target:
                    (copy if suffix == ".bin" else shutil.copyfileobj)(source, target)
            except OSError as error:
                raise CameraFileError(f"{file}: cannot be read ({reason(error)})") from error
            except (struct.error, ValueError) as error:
                raise CameraFileError(f"{file}: is truncated; expected a whole COLMAP model") from error
        (Path(folder) / f"points3D{suffix}").write_bytes(bytes(8) if suffix == ".bin" else b"")
        try:
            model = pycolmap.Reconstruction(folder)
        except Exception as error:  # whatever its C++ parser makes of a broken file
            why = clipped(str(error).strip().replace(folder, str(path)), 300)
            raise CameraFileError(f"{path}: not a readable COLMAP model ({why})") from error
    size = 8 + sum(24 + 8 * len(lens.params) for lens in model.cameras.values())
    if suffix == ".bin" and cameras.stat().st_size < size:
        raise CameraFileError(f"{cameras}: is truncated; expected at least {size} bytes")
    return model


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


def _camera(
    where: str,
    name: str,
    width: int,
    height: int,
    K: npt.NDArray[np.float64],  # (3, 3)
    pose: npt.NDArray[np.float64],  # (4, 4)
) -> Camera:
    try:
        return Camera(name, width, height, K, pose)
    except (PoseError, IntrinsicsError) as error:
        raise type(error)(f"{where}: {error}") from None


def _intrinsics(fx: float, fy: float, cx: float, cy: float) -> npt.NDArray[np.float64]:
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float64)


def _inverse(
    rotation: npt.NDArray[np.float64],  # (3, 3)
    position: npt.NDArray[np.float64],  # (3,)
) -> npt.NDArray[np.float64]:
    """World-to-camera (4, 4) of a camera-to-world rotation and position; not rigid where the rotation is none."""
    pose = np.eye(4)
    pose[:3, :3] = rotation.T
    with np.errstate(all="ignore"):  # A camera refuses what is NaN or too large.
        pose[:3, 3] = -rotation.T @ position
    return pose


def _entries(path: Path, content: object, expected: str) -> list[tuple[str, dict[str, Any]]]:
    """Objects of a JSON list, each with words that say where it stands."""
    if not isinstance(content, list) or not all(isinstance(entry, dict) for entry in content):
        found = kind_of(content) + (" with entries of other kinds" if isinstance(content, list) else "")
        raise CameraFileError(f"{path}: holds {found}; expected {expected}, each an object")
    return [(f"{path}, entry {i}", entry) for i, entry in enumerate(content)]


def _get(where: str, entry: dict[str, Any], key: str) -> Any:
    if key not in entry:
        raise CameraFileError(f"{where}: lacks '{key}' (has {clipped(', '.join(entry)) or 'nothing'})")
    return entry[key]


def _number(where: str, entry: dict[str, Any], key: str) -> float:
    return float(_array(where, entry, key, ()))


def _size(where: str, entry: dict[str, Any], key: str) -> int:
    number = _number(where, entry, key)
    if not number.is_integer():
        raise IntrinsicsError(f"{where}: '{key}' is {number:g}; expected a whole number of pixels")
    return int(number)


def _array(where: str, entry: dict[str, Any], key: str, *shapes: tuple[int, ...]) -> npt.NDArray[np.float64]:
    value = _get(where, entry, key)
    try:
        array = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        array = None
    if array is None or array.shape not in shapes:
        expected = " or ".join(" x ".join(map(str, shape)) + " numbers" if shape else "a number" for shape in shapes)
        raise CameraFileError(f"{where}: '{key}' is {clipped(value)}; expected {expected}")
    return array


def _stem(where: str, entry: dict[str, Any], key: str) -> str:
    name = _get(where, entry, key)
    if not isinstance(name, str) or not _stem_of(name):
        raise CameraFileError(f"{where}: '{key}' is {quoted(name)}; expected the name of an image")
    return _stem_of(name)


def _stem_of(name: str) -> str:
    """File name without folders and without the suffix of an image; a dot in a name that lacks one is kept."""
    path = PureWindowsPath(name)  # takes both kinds of slash
    return path.stem if path.suffix.lower() in _IMAGE_SUFFIXES else path.name
