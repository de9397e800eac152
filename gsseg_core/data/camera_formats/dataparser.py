"""The frame in which nerfstudio trains: `dataparser_transforms.json` and the two fields that go with it.

nerfstudio knows three frames. *Original* is that of COLMAP or of the capturing app. `ns-process-data` turns it to that
of `transforms.json`, in which the poses of that file are: `applied_transform` (and `applied_scale`) say what has been
done to them already. The dataparser then turns, centres and scales all cameras, and trains there; `ns-export` writes
Gaussians as they were trained. The file beside the trained config leads from the original frame to that of training,

    transform = T applied_transform,    scale = s applied_scale,

as matrices, where x -> s (T x) is what was done to poses of `transforms.json`. So for these, both fields are undone
first; cameras of COLMAP's own files are in the original frame. (nerfstudio, `nerfstudio_dataparser.py`.)
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from gsseg_core.data.camera_formats.entries import Entry
from gsseg_core.errors import CameraFileError, PoseError
from gsseg_core.files.json_files import read_object
from gsseg_core.files.limits import LIMITS
from gsseg_core.scene.camera import RIGID_TOLERANCE
from gsseg_core.scene.similarity import Similarity

DATAPARSER = "dataparser_transforms.json"
_COLMAP_TRANSFORM = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])
"""What nerfstudio takes for `applied_transform` where the field is missing and COLMAP's model lies beside the file."""


def original_to_trained(cameras: Path, path: Path) -> Similarity:
    """Read `dataparser_transforms.json`: from the frame of a COLMAP model to that of nerfstudio's Gaussians.

    Raises `CameraFileError` or `PoseError` where it is missing or broken, its transform not rigid, or its scale not
    positive.
    """
    return _similarity(path, *_read(path, "transform", "scale"))


def saved_to_trained(transforms: Path, path: Path) -> Similarity:
    """Read both files: from the frame of `transforms.json` to that of the Gaussians; raises what the other one does."""
    matrix, scale = _read(path, "transform", "scale")
    default = _COLMAP_TRANSFORM if (transforms.parent / "colmap/sparse/0").is_dir() else np.eye(4)
    applied, applied_scale = _read(transforms, "applied_transform", "applied_scale", default)
    if abs(np.linalg.det(applied)) < 1e-9:
        raise PoseError(f"{transforms}: 'applied_transform' is not invertible; expected a rigid motion")
    return _similarity(path, matrix @ np.linalg.inv(applied), scale / applied_scale)


def _similarity(path: Path, matrix: npt.NDArray[np.float64], scale: float) -> Similarity:  # (4, 4)
    """Make the similarity x -> scale * (matrix x), which scales the translation of the matrix, too."""
    left, _, right = np.linalg.svd(matrix[:3, :3])
    rotation = left @ right  # the nearest; files are of single precision
    if np.abs(rotation - matrix[:3, :3]).max() > RIGID_TOLERANCE or np.linalg.det(rotation) < 0:
        raise PoseError(f"{path}: 'transform' is no rigid motion after what was applied before it; expected one")
    return Similarity(scale, rotation, scale * matrix[:3, 3])


def _read(
    path: Path, transform: str, scale: str, default: npt.NDArray[np.float64] | None = None
) -> tuple[npt.NDArray[np.float64], float]:
    """Read a matrix (4, 4) and a positive scale; with a default matrix, either may be missing, the scale being 1."""
    entry = Entry(str(path), read_object(path, CameraFileError, f"an object with '{transform}'"))
    if transform in entry or default is None:
        matrix = np.vstack([entry.array(transform, (3, 4), (4, 4))[:3], (0, 0, 0, 1)])
    else:
        matrix = default
    number = entry.number(scale) if scale in entry or default is None else 1.0
    if not 0 < number <= LIMITS.max_value:
        raise CameraFileError(f"{path}: '{scale}' is {number:g}; expected a positive number")
    if not (np.abs(matrix) <= LIMITS.max_value).all():
        raise PoseError(f"{path}: '{transform}' holds NaN or too large numbers; expected a rigid motion")
    return matrix, number
