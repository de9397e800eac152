"""Where the scene lies in the map is told as a static transform."""

from __future__ import annotations

import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time

from gsseg_ros.conversions import matrix_from_transform
from gsseg_ros.frames import Similarity
from gsseg_ros.node.scene_frame import SceneFrame, transform

ASIDE = Similarity.from_parameters(1.0, [0.05, -0.02, 0.03], [0.0, 0.0, 0.02, 1.0])


def test_the_static_transform_is_the_pose_of_the_scene_without_its_scale() -> None:
    similarity = Similarity.from_parameters(2.5, [4.0, -1.0, 0.5], [0.0, 0.0, 0.6, 0.8])
    sent = transform("map", "scene", similarity, Time(sec=7))
    assert (sent.header.frame_id, sent.child_frame_id, sent.header.stamp.sec) == ("map", "scene", 7)
    matrix = matrix_from_transform(sent.transform, "tf")
    np.testing.assert_allclose(matrix[:3, :3], similarity.rotation, atol=1e-12)
    np.testing.assert_allclose(matrix[:3, 3], similarity.translation)


def test_it_is_broadcast_latched_where_tf2_msgs_is_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    sent: list[Any] = []

    class Node:
        def create_publisher(self, kind: Any, topic: str, quality: Any) -> Any:
            assert topic == "/tf_static" and quality.durability.name == "TRANSIENT_LOCAL"
            return SimpleNamespace(publish=sent.append)

        def destroy_publisher(self, publisher: Any) -> None:
            sent.clear()

    def message(transforms: list[Any]) -> list[Any]:
        return transforms

    module: Any = ModuleType("tf2_msgs.msg")
    module.TFMessage = message
    monkeypatch.setitem(sys.modules, "tf2_msgs", ModuleType("tf2_msgs"))
    monkeypatch.setitem(sys.modules, "tf2_msgs.msg", module)
    frame = SceneFrame(Node(), "map", "scene")
    frame.publish(ASIDE, Time())
    assert [one.child_frame_id for (one,) in sent] == ["scene"]
    frame.close()
    assert not sent
    SceneFrame(Node(), "map", "").publish(ASIDE, Time())
    assert not sent
