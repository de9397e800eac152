"""What the segmentation node keeps: what a request that fails leaves as it was, states and scenes, files."""

from __future__ import annotations

import resource
from pathlib import Path
from typing import Any

import numpy as np
import plyfile
import pytest
from action_msgs.msg import GoalStatus
from gsseg_msgs.msg import SceneDelta as SceneDeltaMessage
from gsseg_msgs.msg import SegmentationReport
from ros_checks import counts, latched_clouds, limited
from ros_fixtures import parameters_fixture, root_fixture, running_fixture, scene_fixture, shared_fixture  # noqa: F401
from ros_robot import CLASSES, RELIABLE, SERVICES, Robot, assert_same, core_session, viewpoint
from small_scenes import clean_views, ring

from gsseg_core.cli import main as cli
from gsseg_core.data.dataset import Dataset
from gsseg_core.data.view import View
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.scene_delta import SceneDelta
from gsseg_core.segmentation import Segmentation
from gsseg_ros.delta_messages import message_from_delta


@pytest.fixture
def robot(running: Robot) -> Robot:
    """A node, its scene loaded anew, with six views fused; a test may do with it what it likes."""
    running.done("load_scene")
    running.fuse(clean_views(6))
    return running


def assert_untouched(robot: Robot, before: SegmentationReport, folder: Path) -> None:
    """The node knows what it knew when it gave this report."""
    found = robot.exported(folder)
    expected = Segmentation.load(folder.parent / "before" / "segmentation.npz", GaussianScene.load(before.scene_path))
    np.testing.assert_array_equal(found.probabilities, expected.probabilities)
    after = robot.done("segment").report
    assert counts(after) == counts(before)
    assert (after.scene_hash, after.learner, after.num_views) == (before.scene_hash, before.learner, before.num_views)


def test_the_topic_and_requests_of_another_process_change_the_scene_and_add_to_it(
    robot: Robot, scene: GaussianScene
) -> None:
    node = robot.ros.node
    changes = node.create_publisher(SceneDeltaMessage, f"{robot.namespace}/scene_delta", RELIABLE)
    try:
        robot.ros.wait_until(lambda: changes.get_subscription_count() > 0, "the node's subscription to changes")
        changes.publish(message_from_delta(SceneDelta(revision=1, removed=np.arange(30))))
        robot.ros.wait_until(
            lambda: robot.done("segment", publish_nothing=True).report.num_gaussians == len(scene) - 30, "the change"
        )
    finally:
        node.destroy_publisher(changes)
    answer = robot.done("update_scene", delta=message_from_delta(SceneDelta(revision=2, removed=np.arange(30, 40))))
    assert (answer.num_removed, answer.num_gaussians, answer.revision) == (10, len(scene) - 40, 2)
    robot.done("save_state", path="grown.npz")
    robot.done("reset")
    robot.fuse(clean_views(1))
    merged = robot.done("merge_states", paths=["grown.npz"])
    assert (merged.num_merged, merged.num_views) == (6, 7)


@pytest.mark.parametrize(
    ("service", "fields"),
    [
        ("load_scene", {"path": "broken.ply"}),
        ("load_scene", {"path": "no.ply"}),
        ("load_scene", {"path": "../outside.ply"}),
        ("load_state", {"path": "broken.npz"}),
        ("load_state", {"path": "other_state.npz"}),
        ("load_state", {"path": "wide_state.npz"}),
        ("save_state", {"path": "taken.npz"}),
        ("export", {"directory": "taken"}),
        ("segment", {"classes": ["sofa"]}),
    ],
)
def test_a_request_that_fails_leaves_everything_as_it_was(
    robot: Robot, root: Path, scene: GaussianScene, tmp_path_factory: pytest.TempPathFactory, service: str,
    fields: dict[str, Any],
) -> None:  # fmt: skip
    folder = robot.out(tmp_path_factory.mktemp("run").name)
    names = [*CLASSES, "more", "than", "declared"]
    core_session(scene, clean_views(1), names).save(root / "wide_state.npz")
    robot.exported(folder / "before")
    before, clouds = robot.done("segment").report, latched_clouds(robot)
    assert robot.ask(service, **fields).error_code > 0
    assert latched_clouds(robot) == clouds
    assert_untouched(robot, before, folder / "after")


def test_a_full_disk_fails_the_save_and_keeps_the_earlier_file(robot: Robot, root: Path) -> None:
    saved = robot.done("save_state", path="full/state.npz")
    earlier = Path(saved.path).read_bytes()
    assert saved.num_bytes == len(earlier) and saved.num_views == 6
    robot.fuse(View.from_arrays(camera, np.full((48, 64), 2, np.int32)) for camera in ring(6, turn=0.5))
    with limited(robot, resource.RLIMIT_FSIZE, saved.num_bytes // 2):
        response = robot.ask("save_state", path="full/state.npz")
    assert response.error_code == response.WRITE_FAILED, response.error_msg
    assert f"{saved.path}: cannot be written (File too large); what was there before is unchanged" == response.error_msg
    assert [path.name for path in (root / "full").iterdir()] == ["state.npz"]
    assert (root / "full" / "state.npz").read_bytes() == earlier
    assert robot.done("save_state", path="full/state.npz").num_views == 12


def test_a_saved_state_comes_back_with_views_and_codes(robot: Robot, root: Path) -> None:
    status, _ = robot.learn()
    assert status == GoalStatus.STATUS_SUCCEEDED
    saved = robot.done("save_state")
    assert saved.path == str(root / "gsseg_state.npz")
    before = robot.exported(robot.out("saved"))
    robot.done("reset")
    loaded = robot.done("load_state")
    (root / "gsseg_state.npz").unlink()
    assert (loaded.path, list(loaded.class_names), loaded.num_views) == (saved.path, CLASSES, 6)
    after = robot.exported(robot.out("loaded"))
    np.testing.assert_array_equal(after.probabilities, before.probabilities)
    np.testing.assert_array_equal(after.labels, before.labels)
    assert robot.done("segment").report.learner == "em"
    assert robot.learn()[1].report.num_views == 6, "the views are there too"


def test_another_scene_takes_the_place_of_the_first_with_all_that_was_known(robot: Robot, root: Path) -> None:
    robot.done("segment")
    other = GaussianScene.load(root / "other.ply")
    response = robot.done("load_scene", path="other.ply")
    assert (response.path, response.scene_hash, response.num_gaussians) == (
        str(root / "other.ply"), other.digest, len(other),
    )  # fmt: skip
    box = [[getattr(corner, axis) for axis in "xyz"] for corner in (response.box_min, response.box_max)]
    np.testing.assert_allclose(box, [other.means.min(axis=0), other.means.max(axis=0)], atol=1e-5)
    assert robot.ask("segment").error_code == SERVICES["segment"].Response.NO_CODES
    assert all(cloud.width == 0 for cloud in latched_clouds(robot).values())
    robot.fuse(clean_views(2))
    assert robot.done("segment").report.scene_hash == other.digest


def test_exported_files_are_those_of_the_command_line(
    robot: Robot, root: Path, scene: GaussianScene, capsys: pytest.CaptureFixture[str]
) -> None:
    robot.done("reset")
    assert robot.learn(dataset_path="data")[0] == GoalStatus.STATUS_SUCCEEDED
    response = robot.done("export", directory="out/node")
    assert response.directory == str(root / "out" / "node")
    by_node, by_hand = root / "out" / "node", root / "out" / "command"
    assert cli.main(["segment", str(scene.path), "--data", str(root / "data"), "--out", str(by_hand), "--quiet"]) == 0
    capsys.readouterr()

    found, expected = (Segmentation.load(folder / "segmentation.npz", scene) for folder in (by_node, by_hand))
    assert_same(found, expected)
    written = sorted(str(path.relative_to(by_node)) for path in by_node.rglob("[!.]*") if path.is_file())
    assert written == sorted(response.files)
    plys = sorted(path.name for path in (by_hand / "classes").iterdir())
    assert plys == sorted(path.name for path in (by_node / "classes").iterdir()) and len(plys) == 4
    for name in plys:
        one, other = (plyfile.PlyData.read(folder / "classes" / name) for folder in (by_node, by_hand))
        np.testing.assert_array_equal(one["vertex"].data, other["vertex"].data)
    assert [summary.num_gaussians for summary in response.report.classes] == expected.counts().tolist()


def test_the_default_export_folder_is_below_data_root_and_holds_only_what_was_asked_for(
    robot: Robot, root: Path
) -> None:
    response = robot.done("export", classes=["red ball", "3"], skip_filter=True)
    assert response.directory == str(root / "gsseg_export")
    assert list(response.files) == ["segmentation.npz", "classes/1_red_ball.ply", "classes/3_box.ply", "report.json"]
    everything = counts(robot.done("segment", skip_filter=True).report)
    for name, ply in (("red ball", "1_red_ball.ply"), ("box", "3_box.ply")):
        assert len(GaussianScene.load(root / "gsseg_export" / "classes" / ply)) == everything[name]


def test_requests_are_answered_side_by_side(robot: Robot) -> None:
    futures = [robot.send("segment", skip_filter=bool(i % 2)) for i in range(3)]
    futures += [robot.send("render_view", **viewpoint(clean_views(1)[0])) for _ in range(3)]
    answers = [robot.ros.result(future) for future in futures]
    assert [answer.error_code for answer in answers] == [0] * 6
    revisions = [getattr(answer, "revision", 0) or answer.report.revision for answer in answers]
    assert len(set(revisions)) == 6


def test_the_dataset_that_a_goal_names_may_lie_behind_a_link_inside_data_root(robot: Robot, root: Path) -> None:
    (root / "inner").symlink_to(root / "data")
    status, result = robot.learn(dataset_path="inner")
    assert status == GoalStatus.STATUS_SUCCEEDED
    assert result.report.num_views == len(Dataset(root / "data").views("train"))


def test_paths_below_data_root_may_be_absolute_and_may_go_up_and_down(robot: Robot, root: Path) -> None:
    for path in (str(root / "data" / "scene.ply"), "data/../data/./scene.ply", "link/root/data/scene.ply"):
        assert robot.done("load_scene", path=path).path == str(root / "data" / "scene.ply")
