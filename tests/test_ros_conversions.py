"""Conversions: what goes into a message comes out of it again, and what cannot be used is refused by name."""

from __future__ import annotations

import array
import math
import os
import re
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

pytest.importorskip("sensor_msgs")

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, Quaternion, Transform, Vector3
from sensor_msgs.msg import CameraInfo, Image, PointCloud2, PointField, RegionOfInterest
from std_msgs.msg import Header

from gsseg_core.cameras import Camera
from gsseg_core.errors import GssegError, IntrinsicsError, MaskFormatError, PoseError, SceneValueError
from gsseg_core.masks import UNKNOWN
from gsseg_ros.conversions import (
    array_from_point,
    arrays_from_cloud,
    camera_from_messages,
    camera_info,
    cloud,
    confidence_image,
    intrinsics_from_info,
    label_image,
    labels_from_image,
    mask_image,
    matrix_from_pose,
    matrix_from_transform,
    picture_from_image,
    pose_from_matrix,
    rgb_image,
    stamp_message,
    stamp_ns,
    topic_tokens,
    viewpoint_messages,
)
from gsseg_ros.frames import Similarity, rigid, rotation_from_quaternion

HEADER = Header(stamp=Time(sec=7, nanosec=8), frame_id="camera")
K = np.array([[100.0, 0, 31.5], [0, 120.0, 20.25], [0, 0, 1]])
IDENTITY = Similarity(np.eye(3), np.zeros(3), 1.0)

sizes = hnp.array_shapes(min_dims=2, max_dims=2, max_side=9)


def as_bytes(values: np.ndarray) -> array.array[int]:
    return array.array("B", values.tobytes())


def image(values: np.ndarray, encoding: str, padding: int = 0, big: bool = False) -> Image:
    """An image message as a driver may send it: rows padded with noise, either byte order."""
    height, width = values.shape
    raw = values.astype(values.dtype.newbyteorder(">" if big else "<")).view(np.uint8).reshape(height, -1)
    rows = np.pad(raw, ((0, 0), (0, padding)), constant_values=0xAB)
    message = Image(header=HEADER, height=height, width=width, encoding=encoding, step=rows.shape[1])
    message.is_bigendian = int(big)
    message.data = as_bytes(rows)
    return message


def info(**changes: Any) -> CameraInfo:
    values: dict[str, Any] = {"header": HEADER, "width": 64, "height": 48, "k": K.ravel(), "d": [0.0] * 5}
    return CameraInfo(**(values | changes))


def refusal(kind: type[GssegError], call: Any, *arguments: Any) -> str:
    """Message of the error, which names its topic and says what was expected."""
    with pytest.raises(kind) as caught:
        call(*arguments)
    message = str(caught.value)
    assert type(caught.value) is kind
    assert "\n" not in message
    assert "/some/topic" in message
    assert "expected" in message
    return message


@given(st.integers(-(2**31) * 10**9, 2**31 * 10**9 - 1))
def test_a_stamp_survives_its_message(ns: int) -> None:
    assert stamp_ns(stamp_message(ns)) == ns


@pytest.mark.parametrize(
    ("encoding", "kind", "unknown"),
    [
        ("mono8", np.uint8, 255),
        ("8UC1", np.uint8, 255),
        ("mono16", np.uint16, 65535),
        ("16UC1", np.uint16, 65535),
        ("32SC1", np.int32, -1),
    ],
)
@given(data=st.data(), shape=sizes, padding=st.integers(0, 5), big=st.booleans())
def test_labels_survive_every_encoding_padding_and_byte_order(
    encoding: str, kind: type, unknown: int, data: st.DataObject, shape: tuple[int, int], padding: int, big: bool
) -> None:
    largest = 254 if kind is np.uint8 else 65534
    labels = data.draw(hnp.arrays(np.int32, shape, elements=st.integers(UNKNOWN, largest)))
    values = np.where(labels == UNKNOWN, unknown, labels).astype(kind)
    read = labels_from_image(image(values, encoding, padding, big), "/some/topic")
    assert read.dtype == np.int32
    assert np.array_equal(read, labels)
    read[:] = 0  # Not a view of the message, which is read-only where it is shared.


@pytest.mark.parametrize("bits", [8, 16])
@given(data=st.data(), shape=sizes)
def test_labels_survive_a_mask_image_of_our_own(bits: int, data: st.DataObject, shape: tuple[int, int]) -> None:
    labels = data.draw(hnp.arrays(np.int32, shape, elements=st.integers(UNKNOWN, 2**bits - 2)))
    message = mask_image(labels, HEADER, bits)
    assert (message.encoding, message.step) == (f"mono{bits}", shape[1] * bits // 8)
    assert (message.header, message.height, message.width) == (HEADER, *shape)
    assert np.array_equal(labels_from_image(message, "/some/topic"), labels)
    assert np.array_equal(labels_from_image(label_image(labels, HEADER), "/some/topic"), labels)


def test_a_label_that_does_not_fit_is_not_written() -> None:
    for labels, bits in (([[255]], 8), ([[65535]], 16), ([[-2]], 16)):
        with pytest.raises(MaskFormatError, match=rf"labels are {labels[0][0]} to .*{bits} bits hold -1 to"):
            mask_image(np.array(labels), HEADER, bits)


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "32FC1", "8UC3", "mono1", ""])
def test_a_mask_of_another_encoding_is_refused(encoding: str) -> None:
    message = refusal(MaskFormatError, labels_from_image, image(np.zeros((2, 3), np.uint8), encoding), "/some/topic")
    assert f"'{encoding}'" in message
    assert "mono8, 8UC1, mono16, 16UC1, 32SC1" in message


@pytest.mark.parametrize(("width", "height"), [(0, 2), (3, 0), (0, 0)])
def test_a_mask_without_pixels_is_refused(width: int, height: int) -> None:
    message = Image(width=width, height=height, encoding="mono8", step=width)
    assert f"{width} x {height}" in refusal(MaskFormatError, labels_from_image, message, "/some/topic")


def test_a_mask_with_too_few_bytes_is_refused() -> None:
    short = image(np.zeros((4, 3), np.uint16), "mono16")
    short.data = short.data[:-1]
    assert "23 bytes with a step of 6" in refusal(MaskFormatError, labels_from_image, short, "/some/topic")
    narrow = image(np.zeros((4, 3), np.uint16), "mono16")
    narrow.step = 5
    assert "step of at least 6" in refusal(MaskFormatError, labels_from_image, narrow, "/some/topic")


@pytest.mark.parametrize("label", [-2, 65535, 2**31 - 1])
def test_a_label_that_no_class_can_have_is_refused(label: int) -> None:
    mask = image(np.array([[0, label]], np.int32), "32SC1")
    assert str(label) in refusal(MaskFormatError, labels_from_image, mask, "/some/topic")


def test_intrinsics_are_taken_as_they_stand() -> None:
    matrix, width, height = intrinsics_from_info(info(), "/some/topic")
    assert np.array_equal(matrix, K)
    assert (width, height) == (64, 48)


@pytest.mark.parametrize(
    "changes",
    [{"d": []}, {"binning_x": 1, "binning_y": 1}, {"roi": RegionOfInterest(width=64, height=48, do_rectify=True)}],
)
def test_no_distortion_no_binning_and_the_full_image_can_be_said_in_several_ways(changes: dict[str, Any]) -> None:
    assert intrinsics_from_info(info(**changes), "/some/topic")[1:] == (64, 48)


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"d": [0.0, 0.0, 0.0, 0.0, 1e-9]}, "1e-09"),
        ({"d": [math.nan]}, "nan"),
        ({"width": 0}, "width is 0"),
        ({"height": 0}, "height is 0"),
        ({"binning_x": 2, "binning_y": 2}, "2 x 2"),
        ({"roi": RegionOfInterest(width=32, height=24)}, "32 x 24 at (0, 0)"),
        ({"roi": RegionOfInterest(x_offset=4)}, "at (4, 0)"),
        ({"k": np.zeros(9)}, "0 and 0"),
        ({"k": np.diag([100.0, -1.0, 1.0]).ravel()}, "-1"),
        ({"k": np.full(9, math.nan)}, "nan"),
        ({"k": np.diag([100.0, 100.0, 2.0]).ravel()}, "2.0"),
    ],
)
def test_a_camera_info_that_is_not_of_a_rectified_pinhole_image_is_refused(changes: dict[str, Any], found: str) -> None:
    assert found in refusal(IntrinsicsError, intrinsics_from_info, info(**changes), "/some/topic")


def test_distortion_is_refused_with_the_way_out() -> None:
    message = refusal(IntrinsicsError, intrinsics_from_info, info(d=[0.1] * 5), "/some/topic")
    assert "use the rectified topic" in message
    assert "image_proc" in message


def test_a_camera_survives_its_camera_info() -> None:
    camera = Camera("view", 64, 48, K, np.eye(4))
    message = camera_info(camera, HEADER)
    assert message.header == HEADER
    assert message.distortion_model == "plumb_bob"
    assert list(message.d) == [0.0] * 5
    assert np.array_equal(message.r.reshape(3, 3), np.eye(3))
    assert np.array_equal(message.p.reshape(3, 4), np.c_[K, [0, 0, 0]])
    matrix, width, height = intrinsics_from_info(message, "/some/topic")
    assert np.array_equal(matrix, K)
    assert (width, height) == (64, 48)


components = st.floats(-1, 1)


@given(
    st.tuples(components, components, components, components).filter(lambda q: math.hypot(*q) > 1e-3),
    st.tuples(*[st.floats(-1e3, 1e3)] * 3),
)
def test_a_rigid_motion_survives_its_pose(q: tuple[float, ...], place: tuple[float, ...]) -> None:
    matrix = rigid(rotation_from_quaternion(*q), place)
    assert np.allclose(matrix_from_pose(pose_from_matrix(matrix), "/some/topic"), matrix, rtol=0, atol=1e-12)


def test_pose_and_transform_of_the_same_numbers_are_the_same_motion() -> None:
    turn = Quaternion(x=0.5, y=0.5, z=-0.5, w=0.5)
    pose = Pose(position=Point(x=1.0, y=2.0, z=3.0), orientation=turn)
    transform = Transform(translation=Vector3(x=1.0, y=2.0, z=3.0), rotation=turn)
    matrix = matrix_from_pose(pose, "/some/topic")
    assert np.array_equal(matrix, matrix_from_transform(transform, "/some/topic"))
    assert np.allclose(matrix, [[0, 1, 0, 1], [0, 0, -1, 2], [-1, 0, 0, 3], [0, 0, 0, 1]], atol=1e-15)


@pytest.mark.parametrize(
    ("position", "orientation", "found"),
    [
        ((math.nan, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), "nan"),
        ((0.0, math.inf, 0.0), (0.0, 0.0, 0.0, 1.0), "inf"),
        ((0.0, 0.0, 0.0), (0.0, math.nan, 0.0, 1.0), "nan"),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0), "all zeros: was it filled in?"),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.002), "length 1.002"),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1e300), "length 1e+300"),
    ],
)
def test_an_impossible_pose_is_refused(position: Any, orientation: Any, found: str) -> None:
    (x, y, z), (qx, qy, qz, qw) = position, orientation
    # As it comes in over the wire: rclpy checks the range of numbers only where a message is filled in.
    pose = Pose(check_fields=False)
    pose.position = Point(x=x, y=y, z=z, check_fields=False)
    pose.orientation = Quaternion(x=qx, y=qy, z=qz, w=qw, check_fields=False)
    assert found in refusal(PoseError, matrix_from_pose, pose, "/some/topic")


def test_a_quaternion_of_few_digits_still_gives_a_rotation() -> None:
    pose = Pose(orientation=Quaternion(x=0.707, y=0.0, z=0.0, w=0.707))
    rotation = matrix_from_pose(pose, "/some/topic")[:3, :3]
    assert np.allclose(rotation @ rotation.T, np.eye(3), rtol=0, atol=1e-15)


def test_a_camera_is_built_from_camera_info_pose_and_similarity() -> None:
    similarity = Similarity.from_parameters(2.0, [10.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])
    camera = camera_from_messages("view", info(), rigid(np.eye(3), [14.0, 0.0, 0.0]), similarity, "/some/topic")
    assert (camera.name, camera.width, camera.height) == ("view", 64, 48)
    assert np.allclose(camera.center, [2, 0, 0])
    refusal(IntrinsicsError, camera_from_messages, "view", info(d=[1.0]), np.eye(4), IDENTITY, "/some/topic")


def test_pictures_and_confidences_are_written_pixel_by_pixel() -> None:
    pixels = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
    message = rgb_image(pixels[:, ::-1], HEADER)  # Not contiguous.
    assert (message.encoding, message.height, message.width, message.step) == ("rgb8", 2, 4, 12)
    assert np.array_equal(np.frombuffer(message.data, np.uint8).reshape(2, 4, 3), pixels[:, ::-1])
    values = np.linspace(0, 1, 6).reshape(2, 3)
    message = confidence_image(values, HEADER)
    assert (message.encoding, message.height, message.width, message.step) == ("32FC1", 2, 3, 12)
    assert np.array_equal(np.frombuffer(message.data, "<f4").reshape(2, 3), values.astype(np.float32))


@st.composite
def clouds(draw: st.DrawFn) -> tuple[np.ndarray, ...]:
    count = draw(st.integers(0, 12))
    return (
        draw(hnp.arrays(np.float32, (count, 3), elements=st.floats(-1e6, 1e6, width=32))),
        draw(hnp.arrays(np.uint8, (count, 3))),
        draw(hnp.arrays(np.int32, count, elements=st.integers(0, 2**31 - 1))),
        draw(hnp.arrays(np.float32, count, elements=st.floats(0, 1, width=32))),
    )


@given(clouds())
def test_every_number_survives_its_cloud(arrays: tuple[np.ndarray, ...]) -> None:
    message = cloud(HEADER, *arrays)
    count = len(arrays[0])
    assert (message.header, message.height, message.width, message.point_step) == (HEADER, 1, count, 24)
    assert (message.row_step, len(message.data), message.is_dense) == (24 * count, 24 * count, True)
    for read, written in zip(arrays_from_cloud(message), arrays, strict=True):
        assert read.dtype == written.dtype
        assert np.array_equal(read, written)


def test_a_cloud_is_laid_out_as_rviz_and_pcl_expect() -> None:
    message = cloud(HEADER, np.zeros((1, 3), np.float32), np.array([[1, 2, 3]], np.uint8), np.array([4]), np.ones(1))
    layout = [(f.name, f.offset, f.datatype, f.count) for f in message.fields]
    real, whole = PointField.FLOAT32, PointField.UINT32
    assert layout == [
        ("x", 0, real, 1),
        ("y", 4, real, 1),
        ("z", 8, real, 1),
        ("rgb", 12, real, 1),
        ("label", 16, whole, 1),
        ("confidence", 20, real, 1),
    ]
    assert bytes(message.data[12:16]) == bytes([3, 2, 1, 0])  # 0x00RRGGBB, little endian
    assert not message.is_bigendian


@pytest.mark.parametrize("big", [False, True])
def test_a_cloud_with_other_fields_padding_and_byte_order_is_read(big: bool) -> None:
    names = ["confidence", "label", "extra", "x", "y", "z", "rgb"]
    order = ">" if big else "<"
    kinds = {"label": "u4", "rgb": "u4", "extra": "f8"}
    point = np.dtype([(name, order + kinds.get(name, "f4")) for name in names] + [("end", "V3")])
    records = np.zeros((2, 3), point)
    records["x"], records["label"], records["rgb"] = np.arange(6).reshape(2, 3), 5, 0x0A0B0C
    types = {"label": PointField.UINT32, "extra": PointField.FLOAT64}
    fields = [
        PointField(name=name, offset=point.fields[name][1], datatype=types.get(name, PointField.FLOAT32), count=1)
        for name in names
    ]
    step = point.itemsize
    message = PointCloud2(height=2, width=3, fields=fields, is_bigendian=big, point_step=step, row_step=3 * step + 5)
    message.data = as_bytes(np.pad(records.view(np.uint8).reshape(2, -1), ((0, 0), (0, 5))))
    read = arrays_from_cloud(message)
    assert read.points[:, 0].tolist() == [0, 1, 2, 3, 4, 5]
    assert read.labels.tolist() == [5] * 6
    assert read.rgb.tolist() == [[10, 11, 12]] * 6


def test_a_million_points_are_converted_at_once_even_where_rclpy_checks_fields() -> None:
    program = """if True:
        import time
        import numpy as np
        from sensor_msgs.msg import PointCloud2
        from std_msgs.msg import Header
        from gsseg_ros.conversions import arrays_from_cloud, cloud

        points, ones = np.ones((1_000_000, 3), np.float32), np.ones(1_000_000, np.int32)
        header, rgb = Header(), np.ones((1_000_000, 3), np.uint8)
        seconds = []
        for _ in range(5):
            start = time.process_time()  # Of this process alone, however busy the machine.
            arrays_from_cloud(cloud(header, points, rgb, ones, ones))
            seconds.append(time.process_time() - start)
        print(min(seconds))
        try:
            PointCloud2(height="not a number")
        except AssertionError:
            print("checked")
        """
    environment = os.environ | {"ROS_PYTHON_CHECK_FIELDS": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, timeout=60, check=True
    )
    seconds, checked = done.stdout.split()
    assert checked == "checked"
    assert float(seconds) < 2  # Element by element it takes many; at once, a tenth of one.


def test_a_cloud_of_arrays_that_do_not_go_together_is_not_written() -> None:
    points, rgb = np.zeros((2, 3), np.float32), np.zeros((2, 3), np.uint8)
    with pytest.raises(SceneValueError, match=r"\(3,\).*expected M x 3"):
        cloud(HEADER, points, rgb, np.zeros(3, int), np.zeros(2))
    with pytest.raises(SceneValueError, match="least label is -1; expected class ids"):
        cloud(HEADER, points, rgb, np.array([0, -1]), np.zeros(2))


def test_a_cloud_of_another_kind_is_refused() -> None:
    def ours() -> PointCloud2:
        return cloud(HEADER, np.zeros((2, 3), np.float32), np.zeros((2, 3), np.uint8), np.zeros(2, int), np.zeros(2))

    message = ours()
    message.fields = message.fields[:3]
    assert "{'x': 7, 'y': 7, 'z': 7}" in refusal(SceneValueError, arrays_from_cloud, message, "/some/topic")
    message = ours()
    message.fields[4].datatype = PointField.FLOAT32
    assert "'label': 7" in refusal(SceneValueError, arrays_from_cloud, message, "/some/topic")
    message = ours()
    message.data = message.data[:-1]
    assert "47 bytes" in refusal(SceneValueError, arrays_from_cloud, message, "/some/topic")
    message = ours()
    message.point_step = 20
    assert "at least 24 bytes" in refusal(SceneValueError, arrays_from_cloud, message, "/some/topic")


@given(st.dictionaries(st.integers(0, 65534), st.text(max_size=100), max_size=12))
def test_every_class_gets_a_valid_topic_token_of_its_own(names: dict[int, str]) -> None:
    tokens = topic_tokens(names)
    assert tokens.keys() == names.keys()
    assert len(set(tokens.values())) == len(names)
    for token in tokens.values():
        assert re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", token)
        assert "__" not in token
        assert not token.endswith("_")
        assert len(token) < 100


def test_topic_tokens_stay_close_to_the_names() -> None:
    names = {
        0: "background",
        1: "Chair",
        2: "potted plant!",
        3: "3d-printer",
        4: "5",
        5: "Küche",
        6: "椅子",
        7: "Chair",
    }
    assert topic_tokens(names) == {
        0: "background",
        1: "Chair",
        2: "potted_plant",
        3: "class_3d_printer",
        4: "class_5",
        5: "Kuche",
        6: "class_6",
        7: "Chair_7",
    }


def test_a_token_made_unique_does_not_meet_a_third_class() -> None:
    assert topic_tokens({1: "a", 2: "a_3", 3: "a"}) == {1: "a", 2: "a_3", 3: "a_3_3"}


def test_pictures_and_confidences_come_back_as_they_were() -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (5, 7, 3), np.uint8)
    np.testing.assert_array_equal(picture_from_image(rgb_image(pixels, HEADER), "overlay"), pixels)
    confidence = np.random.default_rng(1).random((5, 7), np.float32)
    np.testing.assert_array_equal(picture_from_image(confidence_image(confidence, HEADER), "confidence"), confidence)


def test_a_picture_of_another_kind_or_cut_short_is_refused() -> None:
    assert "'mono8'" in refusal(
        MaskFormatError, picture_from_image, mask_image(np.zeros((2, 2), int), HEADER, 8), "/some/topic"
    )
    message = rgb_image(np.zeros((2, 2, 3), np.uint8), HEADER)
    message.data = message.data[:-1]
    assert "11 bytes" in refusal(MaskFormatError, picture_from_image, message, "/some/topic")


def test_a_viewpoint_comes_back_as_the_camera_it_was() -> None:
    pose = rigid(rotation_from_quaternion(0.1, 0.7, -0.1, 0.7), (1.0, -2.0, 3.0))
    camera = Camera("viewpoint", 64, 48, K, pose)
    message, info = viewpoint_messages(camera)
    assert message.header.frame_id == ""
    back = camera_from_messages("viewpoint", info, matrix_from_pose(message.pose, "viewpoint"), IDENTITY, "viewpoint")
    np.testing.assert_allclose(back.world_to_camera, pose, atol=1e-12)
    assert (back.K == K).all() and (back.width, back.height) == (64, 48)


def test_a_point_is_an_array() -> None:
    np.testing.assert_array_equal(array_from_point(Point(x=1.0, y=2.0, z=3.0)), [1, 2, 3])
