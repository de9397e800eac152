"""What a node loads of machine code, it loads before it is asked anything."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from geometry_msgs.msg import Point
from ros_fixtures import root_fixture  # noqa: F401
from ros_helpers import Ros, ros_fixture  # noqa: F401
from ros_robot import CLASSES, Robot, viewpoint
from small_scenes import clean_views


def libraries(robot: Robot) -> set[str]:
    """Names of the files with machine code that the node's process has."""
    assert robot.process is not None
    return set(re.findall(r"/\S+\.so[.\d]*$", Path(f"/proc/{robot.process.pid}/maps").read_text(), re.MULTILINE))


@pytest.mark.parametrize("ids", ["given", "per-view"])
def test_no_request_loads_machine_code_for_which_memory_may_be_short(ros: Ros, root: Path, ids: str) -> None:
    named = {"class_names": CLASSES} if ids == "given" else {}
    robot = Robot(ros).started({"scene_path": root / "data" / "scene.ply", "data_root": root, "ids": ids, **named})
    before = libraries(robot)
    views = clean_views(4)
    robot.fuse(views)
    click = viewpoint(views[0]) | {"inside": [Point(x=views[0].camera.width / 2, y=views[0].camera.height / 2)]}
    robot.done("pick", **click)
    robot.done("segment")
    robot.done("render_view", **viewpoint(views[0]))
    robot.done("export", directory=f"out {ids}", collision="hull")
    robot.done("save_state")
    robot.done("reset")
    robot.done("load_state")
    robot.learn()
    robot.done("load_scene")
    assert libraries(robot) - before == set()
