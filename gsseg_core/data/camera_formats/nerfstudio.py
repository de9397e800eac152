"""Cameras of nerfstudio, instant-ngp and NeRF's synthetic scenes: `transforms.json`."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from gsseg_core.data.camera_formats.entries import Entry, Intrinsics, cameras_of, entries, inverse_pose
from gsseg_core.errors import CameraFileError, IntrinsicsError, PoseError
from gsseg_core.files.input_files import READABLE_IMAGES, open_image
from gsseg_core.files.json_files import read_object
from gsseg_core.scene.camera import RIGID_TOLERANCE, Camera
from gsseg_core.scene.lens import LENS_MODELS, MODELS_BY_NAME, Projection
from gsseg_core.text import clipped

_BROWN = MODELS_BY_NAME["OPENCV"]
_COEFFICIENTS = sorted({name for model in LENS_MODELS for name in model.coefficients})


def read_nerfstudio(path: Path, within: Path | None) -> list[Camera]:
    """Read `transforms.json`: camera-to-world poses in OpenGL axes (y up, z backward), intrinsics per file or frame.

    Where it does not say how large the images are, as those of NeRF's synthetic scenes do not, these are asked.
    """
    content = read_object(path, CameraFileError, "an object with 'frames'", within)
    shared = {key: value for key, value in content.items() if key != "frames"}
    cameras = []
    for frame in entries(path, content.get("frames"), "a list 'frames'"):
        name, where = frame.stem("file_path"), frame.where
        entry = Entry(where, {**shared, **frame.fields})
        matrix = entry.array("transform_matrix", (4, 4), (3, 4))
        if matrix.shape == (4, 4) and not np.allclose(matrix[3], (0, 0, 0, 1), 0, RIGID_TOLERANCE):
            raise PoseError(f"{where}: the last row of the pose is {matrix[3].tolist()}; expected 0 0 0 1")
        pose = inverse_pose(matrix[:3, :3] * (1, -1, -1), matrix[:3, 3])
        cameras += cameras_of(where, name, _intrinsics(entry, path.parent, within), pose)
    return cameras


def _intrinsics(entry: Entry, folder: Path, within: Path | None) -> Intrinsics:
    """Read the lens of a frame, whose image is named from `folder`.

    As in nerfstudio, a camera model without distortion may have it all the same.
    """
    where, name = entry.where, str(entry.fields.get("camera_model") or "OPENCV").upper()
    model = MODELS_BY_NAME.get("OPENCV_FISHEYE" if entry.fields.get("is_fisheye") else name, _BROWN)
    if name not in MODELS_BY_NAME and name != "PERSPECTIVE":
        known = ", ".join(MODELS_BY_NAME)
        raise IntrinsicsError(f"{where}: camera model is {clipped(name)}; expected {known}: undistort the images first")
    if model.projection is Projection.PERSPECTIVE and not model.rational:
        model = _BROWN
    sized = "w" in entry and "h" in entry
    width, height = (entry.size("w"), entry.size("h")) if sized else _size_of_image(entry, folder, within)
    if model.projection is Projection.PANORAMA:
        return Intrinsics(model, (width, height), (1.0, 1.0), (0.0, 0.0))
    fx, fy = _focal(entry, "fl_x", "camera_angle_x", width), _focal(entry, "fl_y", "camera_angle_y", height)
    if fx is None:
        raise IntrinsicsError(f"{where}: the focal length is missing; expected 'fl_x' or 'camera_angle_x'")
    cx = entry.number("cx") if "cx" in entry else width / 2
    cy = entry.number("cy") if "cy" in entry else height / 2
    coefficients = {name: entry.number(name) for name in _COEFFICIENTS if name in entry}
    return Intrinsics(model, (width, height), (fx, fx if fy is None else fy), (cx, cy), coefficients)


def _size_of_image(entry: Entry, folder: Path, within: Path | None) -> tuple[int, int]:
    """Ask the image of a frame for its width and height; PNG is its suffix where the file leaves that out."""
    image = folder / entry.fields["file_path"]
    image = image if image.suffix.lower() in READABLE_IMAGES else Path(f"{image}.png")
    try:
        with open_image(image, IntrinsicsError, "image", "a photo", within=within) as photo:
            return photo.size
    except IntrinsicsError as error:
        expected = "'w' and 'h', here or for all frames, or an image to take it from"
        raise IntrinsicsError(f"{entry.where}: the image size is missing; expected {expected}: {error}") from None


def _focal(entry: Entry, key: str, angle_key: str, size: int) -> float | None:
    """Focal length in pixels, from itself or from the field of view in radians; None if there is neither."""
    if key in entry:
        return entry.number(key)
    if angle_key not in entry:
        return None
    angle = entry.number(angle_key)
    if not 0 < angle < math.pi:
        raise IntrinsicsError(f"{entry.where}: '{angle_key}' is {angle:g}; expected radians between 0 and pi")
    return size / 2 / math.tan(angle / 2)
