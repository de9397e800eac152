"""Entries of camera files: JSON objects whose fields are read with errors that say where, and made into a camera."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path, PureWindowsPath
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gsseg_core.errors import CameraFileError, IntrinsicsError, PoseError
from gsseg_core.files.input_files import IMAGE_SUFFIXES
from gsseg_core.files.json_files import JsonObject, kind_of
from gsseg_core.scene.camera import Camera, rigid_motion, undistorted_camera
from gsseg_core.scene.lens import Lens, LensModel, Projection
from gsseg_core.scene.undistortion import undistortions
from gsseg_core.text import clipped, composed, quoted


class Entry(JsonObject):
    """One camera or image of a file."""

    error = CameraFileError

    def __contains__(self, key: str) -> bool:
        """Whether there is such a field."""
        return key in self.fields

    def number(self, key: str) -> float:
        """Read a number."""
        return float(self.array(key, ()))

    def size(self, key: str) -> int:
        """Read a number of pixels."""
        number = self.number(key)
        if not number.is_integer():
            raise IntrinsicsError(f"{self.where}: '{key}' is {number:g}; expected a whole number of pixels")
        return int(number)

    def array(self, key: str, *shapes: tuple[int, ...]) -> npt.NDArray[np.float64]:
        """Read numbers in one of some shapes."""
        value = self.value(key)
        try:
            array = np.array(value, np.float64)
        except (TypeError, ValueError, OverflowError):
            array = None
        if array is None or array.shape not in shapes:
            names = (" x ".join(map(str, shape)) + " numbers" if shape else "a number" for shape in shapes)
            raise CameraFileError(f"{self.where}: '{key}' is {clipped(value)}; expected {' or '.join(names)}")
        return array

    def stem(self, key: str) -> str:
        """Read the name of an image, and give its stem; see `stem_of`."""
        name = self.value(key)
        if not isinstance(name, str) or not stem_of(name):
            raise CameraFileError(f"{self.where}: '{key}' is {quoted(name)}; expected the name of an image")
        return stem_of(name)


def entries(path: Path, content: object, expected: str) -> list[Entry]:
    """Read the objects of a JSON list."""
    if not isinstance(content, list) or not all(isinstance(entry, dict) for entry in content):
        found = kind_of(content) + (" with entries of other kinds" if isinstance(content, list) else "")
        raise CameraFileError(f"{path}: holds {found}; expected {expected}, each an object")
    return [Entry(f"{path}, entry {i}", entry) for i, entry in enumerate(content)]


class Intrinsics(NamedTuple):
    """What a file says of the lens of an image; coefficients by name, those that are left out being 0."""

    model: LensModel
    size: tuple[int, int]  # width, height
    focal: tuple[float, float]
    principal: tuple[float, float]
    coefficients: Mapping[str, float] = {}


def cameras_of(
    where: str,
    name: str,
    intrinsics: Intrinsics,
    pose: npt.NDArray[np.float64],  # (4, 4) world to camera
) -> list[Camera]:
    """Make the camera of an image or, where a lens bent it, those of its pinhole views; errors begin with `where`."""
    model, size, focal, principal, coefficients = intrinsics
    try:
        if model.projection is Projection.PERSPECTIVE and not any(coefficients.values()):
            K = np.array([[focal[0], 0, principal[0]], [0, focal[1], principal[1]], [0, 0, 1]], np.float64)
            return [Camera(name, *size, K, pose)]
        views = undistortions(Lens(model, *size, focal, principal, model.order(coefficients)))
        return [undistorted_camera(name, view, pose) for view in views]
    except (PoseError, IntrinsicsError) as error:
        raise type(error)(f"{where}: {error}") from None


def inverse_pose(
    rotation: npt.NDArray[np.float64],  # (3, 3)
    position: npt.NDArray[np.float64],  # (3,)
) -> npt.NDArray[np.float64]:
    """World-to-camera (4, 4) of a camera-to-world rotation and position; not rigid where the rotation is none."""
    with np.errstate(all="ignore"):  # A camera refuses what is NaN or too large.
        return rigid_motion(rotation.T, -rotation.T @ position)


def stem_of(name: str) -> str:
    """Name of an image with its folders, without its suffix if it is one of images: `left/0001` of `left/0001.jpg`."""
    path = PureWindowsPath(composed(name))  # takes both kinds of slash
    stem = path.stem if path.suffix.lower() in IMAGE_SUFFIXES else path.name
    return "/".join([*(part for part in path.parts[:-1] if part not in (path.anchor, "..")), stem])
