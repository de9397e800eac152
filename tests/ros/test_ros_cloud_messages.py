"""Clouds: every number comes out again, laid out as others read it, and fast."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from patience import PATIENCE
from ros_message_cases import HEADER, as_bytes, refusal
from sensor_msgs.msg import PointCloud2, PointField

from gsseg_core.errors import SceneValueError
from gsseg_ros.cloud_messages import arrays_from_cloud, cloud


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
        from gsseg_ros.cloud_messages import arrays_from_cloud, cloud

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
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, timeout=PATIENCE, check=True
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
