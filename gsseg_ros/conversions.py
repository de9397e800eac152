"""Converts between ROS messages and the values of `gsseg_core`; clouds, objects and cameras have files of their own.

Numbers of a message are set as `array.array`, which rclpy takes over as a whole; anything else it checks and copies
element by element, which takes seconds for a large cloud.
"""

from __future__ import annotations

import array
import math
from collections.abc import Collection
from typing import Any

import numpy as np
import numpy.typing as npt
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion, Transform, Vector3
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header

from gsseg_core.data.label_images import UNKNOWN, in_bits
from gsseg_core.errors import MaskFormatError, MaskSizeError, PoseError
from gsseg_core.files.limits import MAX_LABEL
from gsseg_core.scene.camera import Camera, rigid_motion
from gsseg_ros.errors import TooManyPixelsError
from gsseg_ros.frames import quaternion_from_rotation, rotation_from_quaternion

_NS = 1_000_000_000
_UNIT_TOLERANCE = 1e-3

# Type of a pixel, and its value for "unknown".
MASK_ENCODINGS: dict[str, tuple[npt.DTypeLike, int]] = {
    "mono8": (np.uint8, 2**8 - 1),
    "8UC1": (np.uint8, 2**8 - 1),
    "mono16": (np.uint16, 2**16 - 1),
    "16UC1": (np.uint16, 2**16 - 1),
    "16SC1": (np.int16, UNKNOWN),
    "32SC1": (np.int32, UNKNOWN),
}

# Type of a channel, and how many.
_PICTURE_ENCODINGS: dict[str, tuple[npt.DTypeLike, int]] = {
    "rgb8": (np.uint8, 3), "bgr8": (np.uint8, 3), "rgba8": (np.uint8, 4), "bgra8": (np.uint8, 4),
    "mono8": (np.uint8, 1), "16UC1": (np.uint16, 1), "32FC1": (np.float32, 1),
}  # fmt: skip

# Which channels are red, green and blue.
_CHANNELS = {"rgb8": [0, 1, 2], "rgba8": [0, 1, 2], "bgr8": [2, 1, 0], "bgra8": [2, 1, 0], "mono8": [0, 0, 0]}


def stamp_ns(stamp: Time) -> int:
    """Nanoseconds of a stamp."""
    return int(stamp.sec) * _NS + int(stamp.nanosec)


def stamp_message(ns: int) -> Time:
    """Stamp of so many nanoseconds."""
    seconds, rest = divmod(int(ns), _NS)
    return Time(sec=seconds, nanosec=rest)


def labels_from_image(message: Image, topic: str) -> npt.NDArray[np.int32]:
    """Read the labels (H, W) of a mask message, `UNKNOWN` (-1) where a pixel has none.

    Encodings are mono8 and 8UC1 (255 is unknown), mono16 and 16UC1 (65535), 16SC1 (whatever is negative) and 32SC1
    (-1), of either byte order, with rows of any `step`. Raises `MaskFormatError`: another encoding, a size of zero,
    data too short, or a label out of range.
    """
    require_encoding(message, topic, MASK_ENCODINGS, "labels as ")
    kind, unknown = MASK_ENCODINGS[message.encoding]
    labels = pixels_of(message, np.dtype(kind), topic).astype(np.int32)
    labels[labels == unknown] = UNKNOWN
    if message.encoding == "16SC1":  # semantic_inference's default_id, -1 unless configured, is of no class.
        np.maximum(labels, UNKNOWN, out=labels)
    low, high = int(labels.min()), int(labels.max())
    if low < UNKNOWN or high > MAX_LABEL:
        raise MaskFormatError(f"{topic}: labels are {low} to {high}; expected {UNKNOWN} (unknown) to {MAX_LABEL}")
    return labels


def require_size(message: Any, max_pixels: int, topic: str) -> None:
    """Refuse an Image or a CameraInfo by its size, before anything of that size is made.

    Raises `TooManyPixelsError`: it has more pixels than the parameter max_pixels allows.
    """
    if message.width * message.height > max_pixels:
        size = f"{message.width} x {message.height}"
        raise TooManyPixelsError(f"{topic}: is {size}; expected {max_pixels} pixels at most (parameter max_pixels)")


def require_proportions(size: tuple[int, int], expected: tuple[int, int], topic: str, who: str) -> None:
    """Refuse an image with `MaskSizeError` unless it is larger or smaller by a scale; sizes are width and height."""
    (width, height), (across, down) = size, expected
    if min(abs(width - height * across / down), abs(height - width * down / across)) >= 1:
        raise MaskSizeError(
            f"{topic}: image is {width} x {height} pixels; expected {across} x {down}, as {who}, or a size of the same "
            "proportions"
        )


def require_encoding(message: Image, topic: str, known: Collection[str], what: str = "") -> None:
    """Refuse an image whose encoding is not among those known, with `MaskFormatError`."""
    if message.encoding not in known:
        expected = f"{what}one of {', '.join(known)}"
        raise MaskFormatError(f"{topic}: encoding is '{message.encoding}'; expected {expected}")


def picture_from_image(message: Image, topic: str) -> npt.NDArray[Any]:
    """Read a picture as it is: (H, W) or (H, W, C), uint8, or uint16 and float32 as 16UC1 and 32FC1 are.

    Raises `MaskFormatError`: another encoding, a size of zero, or data too short.
    """
    require_encoding(message, topic, _PICTURE_ENCODINGS)
    kind, channels = _PICTURE_ENCODINGS[message.encoding]
    pixels = pixels_of(message, np.dtype(kind), topic, channels)
    return pixels.reshape(message.height, message.width, channels) if channels > 1 else pixels


def color_from_image(message: Image, topic: str) -> npt.NDArray[np.uint8]:
    """Read a camera's picture (H, W, 3) uint8, RGB; encodings are rgb8, bgr8, rgba8, bgra8 and mono8.

    Raises `MaskFormatError`: another encoding, a size of zero, or data too short.
    """
    require_encoding(message, topic, _CHANNELS)
    pixels = picture_from_image(message, topic).reshape(message.height, message.width, -1)
    picture: npt.NDArray[np.uint8] = pixels[..., _CHANNELS[message.encoding]]
    return picture


def pixels_of(message: Image, kind: np.dtype[Any], topic: str, channels: int = 1) -> npt.NDArray[Any]:
    """Read the numbers (H, W * channels) of an image, of either byte order, with rows of any `step`.

    Raises `MaskFormatError`: a size of zero, or data too short.
    """
    width, height, step = message.width, message.height, message.step
    if width < 1 or height < 1:
        raise MaskFormatError(f"{topic}: image is {width} x {height} pixels; expected at least 1 x 1")
    row = width * channels * kind.itemsize
    if step < row or len(message.data) < height * step:
        raise MaskFormatError(
            f"{topic}: {len(message.data)} bytes with a step of {step}; expected {height} rows of {width} pixels "
            f"of {message.encoding}, thus a step of at least {row} and height * step bytes"
        )
    rows = np.frombuffer(message.data, np.uint8, height * step).reshape(height, step)[:, :row]
    return np.ascontiguousarray(rows).view(kind.newbyteorder(">" if message.is_bigendian else "<"))


def matrix_from_pose(pose: Pose, topic: str) -> npt.NDArray[np.float64]:
    """Turn a pose into a rigid motion (4, 4), in metres.

    Raises `PoseError`: a number is NaN or infinite, or the quaternion is not of length 1.
    """
    return _matrix(pose.position, pose.orientation, topic)


def matrix_from_transform(transform: Transform, topic: str) -> npt.NDArray[np.float64]:
    """Turn a transform into a rigid motion (4, 4), in metres; raises as `matrix_from_pose` does."""
    return _matrix(transform.translation, transform.rotation, topic)


def array_from_point(point: Point | Vector3) -> npt.NDArray[np.float64]:
    """Turn a point, or a vector, into an array (3,)."""
    return np.array([point.x, point.y, point.z])


def xyz(
    values: npt.NDArray[np.floating[Any]],  # (3,)
) -> dict[str, float]:
    """Write an array as the fields of a point or a vector."""
    return dict(zip("xyz", values.tolist(), strict=True))


def pose_from_matrix(
    matrix: npt.NDArray[np.float64],  # (4, 4)
) -> Pose:
    """Turn a rigid motion (4, 4), in metres, into a pose."""
    return Pose(position=Point(**xyz(matrix[:3, 3])), orientation=_quaternion(matrix[:3, :3]))


def transform_of(
    rotation: npt.NDArray[np.float64],  # (3, 3)
    translation: npt.NDArray[np.float64],  # (3,), in metres
) -> Transform:
    """Turn a rotation and a translation into a transform."""
    return Transform(translation=Vector3(**xyz(translation)), rotation=_quaternion(rotation))


def viewpoint_messages(
    camera: Camera,  # in the map
) -> tuple[PoseStamped, CameraInfo]:
    """Write a viewpoint for a request: pose of the optical frame in the map frame (frame_id empty), and camera."""
    camera_in_map = np.linalg.inv(camera.world_to_camera).astype(np.float64)
    return PoseStamped(pose=pose_from_matrix(camera_in_map)), camera_info(camera, Header())


def mask_image(
    labels: npt.NDArray[np.integer[Any]],  # (H, W)
    header: Header,
    bits: int,
) -> Image:
    """Write labels (H, W) as mono8 or mono16 (`bits` 8 or 16), `UNKNOWN` (-1) as 255 or 65535.

    Raises `MaskFormatError`: a label does not fit.
    """
    values = in_bits(labels, bits, "mask image").astype(f"<u{bits // 8}", copy=False)
    return plain_image(values, f"mono{bits}", header)


def rgb_image(
    pixels: npt.NDArray[np.uint8],  # (H, W, 3)
    header: Header,
) -> Image:
    """Write a picture (H, W, 3) uint8 as rgb8."""
    return plain_image(pixels, "rgb8", header)


def confidence_image(
    confidence: npt.NDArray[np.floating[Any]],  # (H, W)
    header: Header,
) -> Image:
    """Write confidences (H, W), 0 to 1, as 32FC1."""
    return plain_image(confidence.astype("<f4"), "32FC1", header)


def plain_image(
    values: npt.NDArray[Any],  # (H, W) or (H, W, C), of the type that the encoding says, in little-endian order
    encoding: str,
    header: Header,
) -> Image:
    """Write pixels as an image of an encoding."""
    height, width = values.shape[:2]
    step = values[0].nbytes if height else 0
    message = Image(header=header, height=height, width=width, encoding=encoding, is_bigendian=0, step=step)
    message.data = byte_array(values)
    return message


def camera_info(camera: Camera, header: Header) -> CameraInfo:
    """Describe a camera as that of a rectified image: no distortion, no rotation, `p` = [k | 0]."""
    return CameraInfo(
        header=header,
        width=int(camera.width),
        height=int(camera.height),
        distortion_model="plumb_bob",
        d=array.array("d", bytes(5 * 8)),
        k=camera.K.ravel(),
        r=np.eye(3).ravel(),
        p=np.c_[camera.K, np.zeros(3)].ravel(),
    )


def byte_array(*parts: npt.NDArray[Any], kind: str = "B") -> array.array[int]:
    """Copy the bytes of numbers into an `array.array` of a kind, which rclpy takes over as a whole."""
    data = array.array(kind)
    for values in parts:
        data.frombytes(np.ascontiguousarray(values).view(np.uint8).data if values.size else b"")
    return data


def _quaternion(rotation: npt.NDArray[np.float64]) -> Quaternion:  # (3, 3)
    x, y, z, w = quaternion_from_rotation(rotation)
    return Quaternion(x=x, y=y, z=z, w=w)


def _matrix(position: Any, orientation: Any, topic: str) -> npt.NDArray[np.float64]:
    place = (position.x, position.y, position.z)
    q = (orientation.x, orientation.y, orientation.z, orientation.w)
    if not np.isfinite(place + q).all():
        raise PoseError(f"{topic}: position is {place}, orientation {q}; expected finite numbers")
    norm = math.hypot(*q)
    if norm == 0:
        raise PoseError(f"{topic}: orientation is all zeros: was it filled in? expected a quaternion of length 1")
    if abs(norm - 1) > _UNIT_TOLERANCE:
        raise PoseError(f"{topic}: orientation {q} has length {norm:.6g}; expected a quaternion of length 1")
    return rigid_motion(rotation_from_quaternion(*q), place)
