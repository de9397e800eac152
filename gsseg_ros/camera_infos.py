"""Cameras from camera_infos: those of rectified images, and those of raw ones, whose lens is undone."""

from __future__ import annotations

import re
from functools import lru_cache

import numpy as np
import numpy.typing as npt
from sensor_msgs.msg import CameraInfo

from gsseg_core.errors import IntrinsicsError
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.lens import LENS_MODELS, Lens
from gsseg_core.scene.undistortion import Undistortion, undistortions
from gsseg_core.text import clipped
from gsseg_ros.conversions import require_proportions
from gsseg_ros.frames import Similarity

AUTO = "auto"
RECTIFIED = (AUTO, "true", "false")
"""Values of the parameter `rectified`."""

_SAYS_RECTIFIED = re.compile(r"(?:^|[/_])rect(?:ified)?(?:[/_]|$)")
_MODELS = {model.ros: model for model in LENS_MODELS if model.ros}
_COEFFICIENTS = {"plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4}
_ROTATION_TOLERANCE = 1e-3
_lens = lru_cache(maxsize=16)(Lens)


def is_rectified(setting: str, *topics: str) -> bool:
    """Decide by the parameter `rectified`, or by "auto" and the names of topics, whether images are rectified.

    A name says so with `rect` or `rectified` as a word of its own, as in `/camera/image_rect_color`.
    """
    return setting == "true" or (setting == AUTO and any(_SAYS_RECTIFIED.search(topic) for topic in topics))


def image_size(info: CameraInfo, topic: str) -> tuple[int, int]:
    """Width and height of the images of a camera_info: its `roi`, in which `binning` makes one pixel of several.

    Raises `IntrinsicsError`: there is no pixel, or `roi` is not in the image.
    """
    _, _, width, height = _window(info, topic)
    size = width // max(info.binning_x, 1), height // max(info.binning_y, 1)
    if min(size) < 1:
        raise IntrinsicsError(f"{topic}: images are {size[0]} x {size[1]} pixels; expected at least 1 x 1")
    return size


def camera_from_messages(
    name: str,
    info: CameraInfo,
    camera_in_map: npt.NDArray[np.float64],  # (4, 4)
    similarity: Similarity,
    topic: str,
) -> Camera:
    """Build the scene's camera of an undistorted view, from its camera_info and its pose in the map, in metres.

    Raises `IntrinsicsError`, `PoseError`: the camera_info, as that of a distorted lens, or the pose cannot be used.
    """
    if np.any(info.d):
        raise IntrinsicsError(
            f"{topic}: distortion d is {list(info.d)}; expected zeros: what is drawn is what a pinhole camera sees"
        )
    K, size = _matrix_of_window(info, np.reshape(info.k, (3, 3)), topic), image_size(info, topic)
    return Camera(name, *size, _scale(info, size, topic, topic) @ K, similarity.world_to_camera(camera_in_map))


def camera_of_image(
    name: str,
    info: CameraInfo,
    size: tuple[int, int],  # width, height
    world_to_camera: npt.NDArray[np.float64],  # (4, 4)
    topic: str,
    info_topic: str,
    *,
    rectified: bool,
) -> Camera:
    """Build the camera of an image (of `topic`) of some size, which may be another than that of its camera_info.

    Of a rectified image, `p` counts, as image_proc publishes such images beside the raw camera's `d` and `k`. Of one
    with distortion it is the pinhole view that image_proc would make, by `d`, `k`, `r` and `p`; without `p`, that of
    `gsseg_core.scene.undistortion`. The optical frame is that of the rectified image, as `image_geometry` has it, and
    the fourth column of `p`, the baseline of a stereo pair, does not count. Raises `IntrinsicsError`: the camera_info
    is impossible, or of an unknown lens; `MaskSizeError`: width and height are not in the proportion of those in the
    camera_info.
    """
    projection = np.reshape(info.p, (3, 4))[:, :3]
    has_projection = projection[0, 0] != 0
    matrix = projection if rectified and has_projection else np.reshape(info.k, (3, 3))
    K, scale = _matrix_of_window(info, matrix, info_topic), _scale(info, size, topic, info_topic)
    if rectified or not np.any(info.d):
        return Camera(name, *size, scale @ K, world_to_camera)
    lens = _lens_of(info, size, scale @ K, info_topic)
    if has_projection:
        rectified_K = scale @ _matrix_of_window(info, projection, info_topic)
        view = Undistortion(lens, *size, *_focal_and_principal(rectified_K), _rotation(info, info_topic))
    else:
        view = _view_of(lens, info_topic)
    return Camera(name, view.width, view.height, view.K, world_to_camera, view)


def _scale(info: CameraInfo, size: tuple[int, int], topic: str, info_topic: str) -> npt.NDArray[np.float64]:
    """Make the matrix (3, 3) that scales intrinsics of what a camera_info cuts out to an image of another size."""
    (width, height), (across, down) = size, image_size(info, info_topic)
    require_proportions(size, (across, down), topic, f"{info_topic} says")
    # Binning leaves out what is no whole pixel.
    return np.diag([width / (across * max(info.binning_x, 1)), height / (down * max(info.binning_y, 1)), 1.0])


def _rotation(info: CameraInfo, topic: str) -> tuple[float, ...]:
    """Read the rotation from the rectified image's axes to the lens's, the inverse of `r`; none where `r` is zeros."""
    turn = np.reshape(info.r, (3, 3)) if np.any(info.r) else np.eye(3)
    if not np.abs(turn @ turn.T - np.eye(3)).max() < _ROTATION_TOLERANCE:
        raise IntrinsicsError(f"{topic}: r is {clipped(turn.tolist(), 160)}; expected a rotation, or zeros")
    return tuple(turn.T.ravel().tolist())


def _matrix_of_window(
    info: CameraInfo,
    matrix: npt.NDArray[np.float64],  # (3, 3)
    topic: str,
) -> npt.NDArray[np.float64]:
    """Return an intrinsic matrix (3, 3) of a camera_info, if it is one, for what is cut out of the full image."""
    # Camera checks it; the message names the topic in the camera's place.
    K = Camera(topic, info.width, info.height, matrix, np.eye(4)).K.copy()
    K[:2, 2] -= _window(info, topic)[:2]
    return K


def _window(info: CameraInfo, topic: str) -> tuple[int, int, int, int]:
    """Corner x, y, width and height of what a camera_info cuts out of the full image: all, where `roi` is zeros."""
    roi = info.roi
    window = int(roi.x_offset), int(roi.y_offset), int(roi.width), int(roi.height)
    if not any(window):
        return 0, 0, int(info.width), int(info.height)
    x, y, width, height = window
    if not (0 < width <= info.width - x and 0 < height <= info.height - y):
        raise IntrinsicsError(
            f"{topic}: roi is {width} x {height} at ({x}, {y}); expected a part of the full image of {info.width} x "
            f"{info.height}, or zeros"
        )
    return window


def _lens_of(
    info: CameraInfo,
    size: tuple[int, int],
    K: npt.NDArray[np.float64],  # (3, 3)
    topic: str,
) -> Lens:
    model, given = _MODELS.get(info.distortion_model), tuple(info.d)
    if model is None:
        raise IntrinsicsError(
            f"{topic}: distortion_model is '{info.distortion_model}'; expected {', '.join(_MODELS)}, or a rectified "
            "image and the parameter rectified"
        )
    known = given[: _COEFFICIENTS[info.distortion_model]]
    if any(given[len(known) :]):
        expected = f"the {len(known)} of {model.ros}, or zeros after these"
        raise IntrinsicsError(f"{topic}: distortion d has {len(given)} coefficients; expected {expected}")
    try:
        return _lens(model, *size, *_focal_and_principal(K), known)
    except IntrinsicsError as error:
        raise IntrinsicsError(f"{topic}: {error}") from None


def _view_of(lens: Lens, topic: str) -> Undistortion:
    try:
        return undistortions(lens)[0]
    except IntrinsicsError as error:
        raise IntrinsicsError(f"{topic}: {error}") from None


def _focal_and_principal(
    K: npt.NDArray[np.float64],  # (3, 3)
) -> tuple[tuple[float, float], tuple[float, float]]:
    return (float(K[0, 0]), float(K[1, 1])), (float(K[0, 2]), float(K[1, 2]))
