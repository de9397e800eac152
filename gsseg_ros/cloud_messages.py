"""Point clouds as messages: of objects, with colour, label and confidence, and of points alone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header

from gsseg_core.errors import SceneValueError
from gsseg_ros.conversions import byte_array

# Field, its type in the message, its type here. RViz and PCL want 0x00RRGGBB in the bits of a float.
_CLOUD_FIELDS = (
    ("x", PointField.FLOAT32, "f4"),
    ("y", PointField.FLOAT32, "f4"),
    ("z", PointField.FLOAT32, "f4"),
    ("rgb", PointField.FLOAT32, "u4"),
    ("label", PointField.UINT32, "u4"),
    ("confidence", PointField.FLOAT32, "f4"),
)
CLOUD_POINT = np.dtype([(name, "<" + kind) for name, _, kind in _CLOUD_FIELDS])
"""A point of a cloud, as its bytes hold it."""


class CloudArrays(NamedTuple):
    """Points of a cloud with colour, label and confidence."""

    points: npt.NDArray[np.float32]  # (M, 3) metres
    rgb: npt.NDArray[np.uint8]  # (M, 3)
    labels: npt.NDArray[np.int32]  # (M,) class ids
    confidence: npt.NDArray[np.float32]  # (M,) 0 to 1


def cloud(
    header: Header,
    points: npt.NDArray[np.float32],  # (M, 3)
    rgb: npt.NDArray[np.uint8],  # (M, 3)
    labels: npt.NDArray[np.integer[Any]],  # (M,)
    confidence: npt.NDArray[np.float32],  # (M,)
) -> PointCloud2:
    """Write points (M, 3) in metres with colour, class id and confidence; M may be 0, which clears a latched cloud.

    Raises `SceneValueError`: shapes do not go together, or a label is negative.
    """
    shapes = [np.shape(values) for values in (points, rgb, labels, confidence)]
    count = len(labels)
    if shapes != [(count, 3), (count, 3), (count,), (count,)]:
        raise SceneValueError(
            f"cloud: points, rgb, labels, confidence have shapes {shapes}; expected M x 3, M x 3, M, M"
        )
    if count and labels.min() < 0:
        raise SceneValueError(f"cloud: the least label is {labels.min()}; expected class ids, which are 0 or more")
    records = np.empty(count, CLOUD_POINT)
    fill_records(records, points, rgb, labels, confidence)
    return cloud_of_records(header, records)


def fill_records(
    records: npt.NDArray[Any],  # (M,) CLOUD_POINT
    points: npt.NDArray[np.float32],  # (M, 3)
    rgb: npt.NDArray[np.uint8],  # (M, 3), or (3,) for all
    labels: npt.NDArray[np.integer[Any]] | int,  # (M,)
    confidence: npt.NDArray[np.float32],  # (M,)
) -> None:
    """Fill in points of a cloud."""
    for axis, name in enumerate("xyz"):
        records[name] = points[:, axis]
    records["rgb"] = rgb @ np.array([1 << 16, 1 << 8, 1], np.uint32)
    records["label"] = labels
    records["confidence"] = confidence


def cloud_of_records(
    header: Header,
    *parts: npt.NDArray[Any],  # (M,) CLOUD_POINT each
) -> PointCloud2:
    """Write points one part after the other, all as they are in memory."""
    return _cloud_of(header, parts, CLOUD_POINT, [datatype for _, datatype, _ in _CLOUD_FIELDS])


def points_cloud(
    header: Header,
    points: npt.NDArray[np.float32],  # (M, 3)
) -> PointCloud2:
    """Write points (M, 3) in metres, and nothing besides."""
    records = np.ascontiguousarray(points, "<f4").view([(axis, "<f4") for axis in "xyz"])[:, 0]
    return _cloud_of(header, [records], records.dtype, [PointField.FLOAT32] * 3)


def _cloud_of(
    header: Header, parts: Sequence[npt.NDArray[Any]], kind: np.dtype[Any], datatypes: list[int]
) -> PointCloud2:
    """Write records, (M,) in each part, whose fields have these types, four bytes each."""
    width = sum(map(len, parts))
    message = PointCloud2(
        header=header,
        height=1,
        width=width,
        fields=[
            PointField(name=name, offset=4 * i, datatype=datatype, count=1)
            for i, (name, datatype) in enumerate(zip(kind.names or (), datatypes, strict=True))
        ],
        is_bigendian=False,
        point_step=kind.itemsize,
        row_step=kind.itemsize * width,
        is_dense=True,
    )
    message.data = byte_array(*parts)
    return message


def arrays_from_cloud(message: PointCloud2, topic: str = "cloud") -> CloudArrays:
    """Read what `cloud` wrote; other fields, other offsets, padding and either byte order are welcome.

    Raises `SceneValueError`: a field is missing or of another type, or the data are too short.
    """
    found = {field.name: (field.datatype, field.offset) for field in message.fields}
    wanted = {name: datatype for name, datatype, _ in _CLOUD_FIELDS}
    if any(name not in found or found[name][0] != datatype for name, datatype in wanted.items()):
        types = {name: datatype for name, (datatype, _) in found.items()}
        raise SceneValueError(f"{topic}: fields and their types are {types}; expected {wanted}")
    rows, columns, step = message.height, message.width, message.point_step
    reach = max(found[name][1] for name in wanted) + 4
    if step < reach or message.row_step < columns * step or len(message.data) < rows * message.row_step:
        raise SceneValueError(
            f"{topic}: {len(message.data)} bytes with a row_step of {message.row_step} and a point_step of {step}; "
            f"expected {rows} rows of {columns} points of at least {reach} bytes"
        )
    order = ">" if message.is_bigendian else "<"
    formats, offsets = [order + kind for _, _, kind in _CLOUD_FIELDS], [found[name][1] for name in wanted]
    point = np.dtype({"names": list(wanted), "formats": formats, "offsets": offsets, "itemsize": step})
    data = np.frombuffer(message.data, np.uint8, rows * message.row_step).reshape(rows, message.row_step)
    records = np.ascontiguousarray(data[:, : columns * step]).ravel().view(point)
    return CloudArrays(
        np.stack([records[axis] for axis in "xyz"], axis=1).astype(np.float32, copy=False),
        (records["rgb"][:, None] >> np.array([16, 8, 0], np.uint32)).astype(np.uint8),
        records["label"].astype(np.int32),
        records["confidence"].astype(np.float32),
    )
