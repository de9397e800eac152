"""Cameras of nerfstudio: `transforms.json`."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from gsseg_core.data.camera_formats.entries import Entry, camera_of, entries, inverse_pose
from gsseg_core.errors import CameraFileError, IntrinsicsError, PoseError
from gsseg_core.files.json_files import read_object
from gsseg_core.scene.camera import Camera
from gsseg_core.text import clipped

_MODELS = {"PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "PERSPECTIVE"}
_DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")


def read_nerfstudio(path: Path, within: Path | None) -> list[Camera]:
    """Read `transforms.json`: camera-to-world poses in OpenGL axes (y up, z backward), intrinsics per file or frame."""
    content = read_object(path, CameraFileError, "an object with 'frames'", within)
    shared = {key: value for key, value in content.items() if key != "frames"}
    cameras = []
    for frame in entries(path, content.get("frames"), "a list 'frames'"):
        name, where = frame.stem("file_path"), frame.where
        entry = Entry(where, {**shared, **frame.fields})
        _refuse_lens(entry)
        if "w" not in entry or "h" not in entry:
            raise IntrinsicsError(f"{where}: the image size is missing; expected 'w' and 'h', here or for all frames")
        width, height = entry.size("w"), entry.size("h")
        fx, fy = _focal(entry, "fl_x", "camera_angle_x", width), _focal(entry, "fl_y", "camera_angle_y", height)
        if fx is None:
            raise IntrinsicsError(f"{where}: the focal length is missing; expected 'fl_x' or 'camera_angle_x'")
        cx = entry.number("cx") if "cx" in entry else width / 2
        cy = entry.number("cy") if "cy" in entry else height / 2
        matrix = entry.array("transform_matrix", (4, 4), (3, 4))
        if matrix.shape == (4, 4) and not np.array_equal(matrix[3], (0, 0, 0, 1)):
            raise PoseError(f"{where}: the last row of the pose is {matrix[3].tolist()}; expected 0 0 0 1")
        pose = inverse_pose(matrix[:3, :3] * (1, -1, -1), matrix[:3, 3])
        cameras.append(camera_of(where, name, (width, height), (fx, fx if fy is None else fy), (cx, cy), pose))
    return cameras


def _refuse_lens(entry: Entry) -> None:
    model = str(entry.fields.get("camera_model", "PINHOLE")).upper()
    if model not in _MODELS or entry.fields.get("is_fisheye"):
        raise IntrinsicsError(
            f"{entry.where}: camera model is {clipped(model)}; expected a pinhole: undistort the images first"
        )
    distortion = ", ".join(f"{key} = {clipped(entry.fields[key])}" for key in _DISTORTION if entry.fields.get(key))
    if distortion:
        raise IntrinsicsError(
            f"{entry.where}: the lens has distortion ({distortion}); expected none: undistort the images first"
        )


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
