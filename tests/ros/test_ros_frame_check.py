"""Poses of another frame than the scene's are told of once the node has learnt from their views."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ros_helpers import Ros, ros_fixture  # noqa: F401
from ros_robot import CLASSES, Robot
from scipy.spatial.transform import Rotation
from small_scenes import NAMES, balls_on_a_table, clean_views, fed, write_dataset

from gsseg_core.data.dataset import Dataset
from gsseg_core.data.view import View
from gsseg_core.live.living_session import LivingSession
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.similarity import Similarity
from gsseg_ros.node.frame_check import FrameCheck


def tilted(views: Sequence[View]) -> list[View]:
    """Views with the poses of something else on the robot, which the camera looks down from by 30 degrees."""
    turn = np.eye(4)
    turn[1:3, 1:3] = [[np.sqrt(0.75), 0.5], [-0.5, np.sqrt(0.75)]]
    cameras = [replace(view.camera, world_to_camera=turn @ view.camera.world_to_camera) for view in views]
    return [replace(view, camera=camera) for view, camera in zip(views, cameras, strict=True)]


@pytest.mark.parametrize("count", [1, 2, 5])
def test_views_of_the_scenes_own_frame_are_not_complained_of(count: int) -> None:
    session = fed(LivingSession(balls_on_a_table()[0], NAMES), clean_views(count))
    assert FrameCheck().look(session, session.scene, session.learn()) == ""


def test_a_camera_that_is_mounted_a_few_degrees_off_is_told_by_its_masks(demo_run: Path) -> None:
    data, turn = Dataset(demo_run / "scene"), np.eye(4)
    turn[:3, :3] = Rotation.from_euler("x", 3, degrees=True).as_matrix()
    views = data.views("train")[:12]
    session = LivingSession(GaussianScene.load(demo_run / "scene/scene.ply"), data.class_names)
    assert FrameCheck().look(fed(session, views), session.scene, session.learn()) == ""
    session.reset()
    cameras = [replace(view.camera, world_to_camera=turn @ view.camera.world_to_camera) for view in views]
    fed(session, [replace(view, camera=camera) for view, camera in zip(views, cameras, strict=True)])
    said = FrameCheck().look(session, session.scene, session.learn())
    assert re.search(r"by 0\.\d\d if masks are moved by \d % (up|down) \(of the longer side\); expected masks", said), (
        said
    )
    assert said.endswith("poses of a calibrated camera at the stamps of its masks")


def test_what_was_found_holds_until_the_views_are_forgotten_or_others_are_learnt_from() -> None:
    session, frames = LivingSession(balls_on_a_table()[0], NAMES), FrameCheck()
    fed(session, tilted(clean_views()))
    said = frames.look(session, session.scene, session.learn())
    assert said.startswith("the scene does not look like the masks from these cameras (agreement with 5 masks 0.")
    assert "optical frame" in said and "scene_to_map" in said
    assert frames.problem(session) == said
    fed(session, clean_views())  # Under the same names: the others are gone.
    assert frames.look(session, session.scene, session.learn()) == frames.problem(session) == ""
    fed(session, tilted(clean_views()))
    frames.look(session, session.scene, session.learn())
    session.reset()
    assert frames.problem(session) == ""


def test_a_scene_too_small_to_be_drawn_whole_is_complained_of() -> None:
    scene, small = balls_on_a_table()[0], Similarity(0.002, np.eye(3), np.zeros(3))
    means, scales = small.points(scene.means), small.scale * scene.scales
    shrunk = GaussianScene.from_arrays(means, scene.quats, scales, scene.opacities, scene.sh)
    views = [replace(view, camera=small.camera(view.camera)) for view in clean_views()]
    session = fed(LivingSession(shrunk, NAMES), views)
    assert "is nearer to them than 0.01 scene units" in FrameCheck().look(session, shrunk, session.learn())


def test_the_log_and_diagnostics_say_so(ros: Ros, tmp_path: Path) -> None:
    write_dataset(tmp_path)
    robot = Robot(ros)
    node = robot.start({"scene_path": tmp_path / "scene.ply", "class_names": CLASSES})
    robot.wait_active()
    robot.fuse(tilted(clean_views()))
    robot.learn()
    robot.wait_for_status(lambda status: "optical frame" in status["message"], "the doubt")
    assert "the scene does not look like the masks from these cameras" in node.output
    robot.done("reset")
    robot.wait_for_status(lambda status: status["message"] == "fusing", "no doubt")
