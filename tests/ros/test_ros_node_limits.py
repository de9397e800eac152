"""What peers may ask of the segmentation node: how much at once, how large, and which files."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gsseg_msgs.srv import RenderView, Segment
from patience import PATIENCE
from ros_fixtures import node_fixture, parameters_fixture, root_fixture, spun  # noqa: F401
from ros_helpers import Ros, ros_fixture  # noqa: F401
from ros_robot import Robot, viewpoint
from small_scenes import clean_views

from gsseg_core.data.view import View
from gsseg_core.scene.camera import Camera
from gsseg_ros.node import services
from gsseg_ros.node.segment_node import SegmentNode
from gsseg_ros.node.services import AT_WORK, WAITING


def test_few_requests_work_some_wait_the_rest_are_busy_and_everything_else_goes_on(
    ros: Ros, node: SegmentNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot, go_on, at_work = Robot(ros), threading.Event(), []
    draw = services.draw

    def wait_and_draw(*arguments: Any, **settings: Any) -> Any:
        at_work.append(1)
        go_on.wait(PATIENCE)
        return draw(*arguments, **settings)

    monkeypatch.setattr(services, "draw", wait_and_draw)
    with spun(node):
        robot.brought_to("inactive")
        assert robot.change("activate")
        robot.fuse(clean_views(2))
        requests = [robot.send("render_view", **viewpoint(clean_views(1)[0])) for _ in range(20)]
        try:
            refused = 20 - AT_WORK - WAITING
            ros.wait_until(lambda: sum(request.done() for request in requests) == refused, "those that are refused")
            assert robot.ask("segment").error_code == Segment.Response.BUSY
            assert robot.state == "active"
            assert robot.set("beta", 0.6) == (True, "")
            told = len(robot.received_status)
            ros.wait_until(lambda: len(robot.received_status) >= told + 3, "diagnostics beside them")
            robot.drive(clean_views(1))
            robot.wait_for_status(lambda status: status.get("views fused") == "3", "a view beside them")
            ros.wait_until(lambda: len(at_work) == AT_WORK, "those that work")
        finally:
            go_on.set()
        codes = [ros.result(request).error_code for request in requests]
        assert sorted(codes) == [0] * (AT_WORK + WAITING) + [RenderView.Response.BUSY] * refused
        assert robot.done("segment").report.num_views == 3


def test_those_that_wait_are_not_active_any_more_once_the_node_is_not(
    ros: Ros, node: SegmentNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot, go_on, at_work, draw = Robot(ros), threading.Event(), [], services.draw
    monkeypatch.setattr(services, "draw", lambda *a, **k: (at_work.append(1), go_on.wait(PATIENCE), draw(*a, **k))[2])
    with spun(node):
        robot.brought_to("inactive")
        assert robot.change("activate")
        robot.fuse(clean_views(1))
        requests = [robot.send("render_view", **viewpoint(clean_views(1)[0])) for _ in range(AT_WORK + WAITING + 1)]
        ros.wait_until(lambda: any(request.done() for request in requests), "one that is refused")
        ros.wait_until(lambda: len(at_work) == AT_WORK, "those that work")
        node.workspace.active = False
        go_on.set()
        codes = [ros.result(request).error_code for request in requests]
        assert codes.count(RenderView.Response.NOT_ACTIVE) == WAITING


def test_masks_and_viewpoints_of_too_many_pixels_are_refused(ros: Ros, parameters: dict[str, Any]) -> None:
    robot = Robot(ros).started({**parameters, "max_pixels": 64 * 48})
    robot.fuse(clean_views(1))
    usual = clean_views(1)[0]
    camera = Camera("large", 64, 49, usual.camera.K, usual.camera.world_to_camera)
    large = View.from_arrays(camera, np.ones((49, 64), np.int32))
    robot.drive([large])
    robot.wait_for_status(lambda status: status.get("rejected too_large") == "1", "the rejection")
    assert robot.process is not None
    says = "is 64 x 49; expected 3072 pixels at most (parameter max_pixels)"
    robot.process.wait_for(f"a view was rejected (too_large): /mask: {says}")
    for service in ("segment", "render_view"):
        response = robot.ask(service, **viewpoint(large))
        assert response.error_code == type(response).INVALID_VIEWPOINT
        assert response.error_msg == f"viewpoint_camera: {says}"
        assert robot.done(service, **viewpoint(usual)).label_image.width == 64
    report = robot.done("segment").report
    assert dict(zip(report.rejection_reasons, report.rejection_counts, strict=True)) == {"too_large": 1}


def test_what_peers_may_reach_is_fixed_at_the_start_in_every_state(ros: Ros, node: SegmentNode, root: Path) -> None:
    robot = Robot(ros)
    with spun(node):
        for state in ("unconfigured", "inactive", "active"):
            while robot.state != state:
                assert robot.change({"unconfigured": "configure", "inactive": "activate"}[robot.state])
            for name, value in (("data_root", "/"), ("data_root", ""), ("max_pixels", 1 << 30)):
                taken, reason = robot.set(name, value)
                assert not taken and "read-only" in reason
        assert robot.get("data_root") == str(root)


def test_a_scene_that_a_peer_names_by_the_parameter_lies_below_data_root(
    ros: Ros, node: SegmentNode, root: Path
) -> None:
    robot, at_start = Robot(ros), str(root / "data" / "scene.ply")
    outside = root.parent / "outside.ply"
    with spun(node):
        for path in (outside, root / "link" / "outside.ply", root / ".." / "outside.ply", "~/scene.ply"):
            taken, reason = robot.set("scene_path", str(path))
            assert not taken and "parameter scene_path, set after the start: path" in reason, path
        assert robot.set("scene_path", str(root / "other.ply")) == (True, "")
        # What is below when it is set may be a link to elsewhere when it is loaded.
        (root / "other.ply").rename(root / "kept.ply")
        (root / "other.ply").symlink_to(outside)
        assert not robot.change("configure") and robot.state == "unconfigured"
        (root / "other.ply").unlink()
        (root / "kept.ply").rename(root / "other.ply")
        assert robot.change("configure")
        assert robot.change("cleanup") and robot.set("scene_path", at_start) == (True, "")
        assert robot.change("configure")


def test_without_data_root_no_peer_names_a_scene_but_that_of_the_start_may_lie_anywhere(
    ros: Ros, root: Path, tmp_path: Path
) -> None:
    robot = Robot(ros).started({"scene_path": root.parent / "outside.ply"})
    assert robot.change("deactivate") and robot.change("cleanup")
    taken, reason = robot.set("scene_path", str(root / "other.ply"))
    assert not taken and "the parameter data_root is empty, so no path is allowed" in reason
    assert robot.set("scene_path", "") == (True, "")
    assert robot.set("scene_path", str(root.parent / "outside.ply")) == (True, "")
    assert robot.change("configure")
