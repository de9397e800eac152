"""Masks whose ids hold only inside their own frame: the node finds the objects as the masks come."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from gsseg_msgs.action import Learn
from gsseg_msgs.msg import ObjectArray, SegmentationReport
from gsseg_msgs.srv import Segment
from parts_of_balls import views_in_halves
from per_view_ids import in_halves
from ros_fixtures import running_fixture, shared_fixture  # noqa: F401
from ros_helpers import Ros, ros_fixture, wait_until  # noqa: F401
from ros_node_here import node_here
from ros_robot import LATCHED, Robot
from small_scenes import balls_on_a_table, clean_views, write_dataset

from gsseg_core.data.view import View
from gsseg_core.live.per_view_session import PerViewSession
from gsseg_core.segmentation import Segmentation
from gsseg_ros.node.services import Services
from gsseg_ros.node.workspace import Run


@pytest.fixture(scope="module")
def parameters(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    data = write_dataset(tmp_path_factory.mktemp("root") / "data")
    return {"scene_path": data / "scene.ply", "data_root": data.parent, "ids": "per-view"}


@pytest.fixture
def robot(running: Robot) -> Robot:
    """A node without views, shared by the tests of this file."""
    running.done("reset")
    return running


def shuffled_views(count: int = 6) -> list[View]:
    """Views in which every object has another id, up to 250, in every view."""
    rng, views = np.random.default_rng(0), []
    for view in clean_views(count):
        ids = np.concatenate([[0], rng.choice(np.arange(1, 250), 3, replace=False)])
        views.append(View.from_arrays(view.camera, ids[view.read_labels()].astype(np.int32)))
    return views


def fused(robot: Robot, views: list[View]) -> SegmentationReport:
    robot.drive(views)
    robot.ros.wait_until(lambda: robot.ask("segment").report.num_views == len(views), f"{len(views)} views")
    return robot.done("segment").report


def test_parts_are_cut_by_the_session_that_segmented_though_a_scene_is_loaded_meanwhile() -> None:
    (scene, _), views = balls_on_a_table(), views_in_halves()[:3]
    first, second = PerViewSession(scene), PerViewSession(scene.subset(np.arange(len(scene) // 2)))
    for view in views:
        first.fuse(view)
    handed = [first]  # From then on the second.
    between = type("Between", (SimpleNamespace,), {"session": property(lambda _: handed.pop() if handed else second)})
    settings = SimpleNamespace(k=5, beta=0.5, granularity=0.9, scene_to_map=None)
    services: Any = SimpleNamespace(workspace=between(settings=settings))
    selection, _ = Services._select(services, Segment.Request(), Run("segment", None))
    assert selection.session is first and len(selection.result.labels) == len(scene)


def assert_objects_are_the_balls(result: Segmentation) -> None:
    """Each ball is one object, and each object one ball."""
    _, truth = balls_on_a_table()
    matches = []
    for ball in (1, 2, 3):
        found = result.labels[(truth == ball) & (result.labels > 0)]
        assert len(found) > 20
        values, counts = np.unique(found, return_counts=True)
        assert counts.max() / counts.sum() > 0.95
        matches.append(int(values[counts.argmax()]))
    assert len(set(matches)) == 3
    assert set(np.unique(result.labels[result.labels > 0])) == set(matches)


def test_ids_that_change_from_mask_to_mask_become_objects_that_do_not(robot: Robot) -> None:
    report = fused(robot, shuffled_views())
    assert report.num_views_rejected == 0
    filled = [summary for summary in report.classes if summary.num_gaussians]
    assert [summary.name for summary in filled] == ["background", "object_001", "object_002", "object_003"]
    assert_objects_are_the_balls(robot.exported(Path(robot.get("data_root")) / "out" / "fused"))
    assert [thing.name for thing in robot.done("segment").objects] == ["object_001", "object_002", "object_003"]


def test_learning_repairs_and_keeps_the_numbers_of_the_objects(robot: Robot) -> None:
    fused(robot, shuffled_views())
    folder = Path(robot.get("data_root")) / "out"
    before = robot.exported(folder / "before")
    status, result = robot.learn()
    assert status == GoalStatus.STATUS_SUCCEEDED, result.error_msg
    assert (result.report.num_views, result.report.learner) == (6, "em")
    after = robot.exported(folder / "after")
    assert_objects_are_the_balls(after)
    both = (before.labels > 0) & (after.labels > 0)
    assert (before.labels[both] == after.labels[both]).mean() > 0.95


def test_objects_that_a_canceled_learn_has_repaired_are_shown(ros: Ros, parameters: dict[str, Any]) -> None:
    views, heard = clean_views(8), ros.collect(ObjectArray, "/gsseg/objects", LATCHED)
    canceled: Any = SimpleNamespace(request=Learn.Goal(), is_cancel_requested=True, canceled=lambda: None)
    with node_here(ros, parameters) as here:
        wait_until(lambda: here.outputs.wants_objects, "somebody to listen")
        here.fuse([in_halves(view, 1) for view in views[:2]])
        here.fuse(views[2:])
        here.inputs.live.show_objects()
        wait_until(lambda: heard, "the objects of the views")
        successors: list[np.ndarray] = here.node.workspace.session._repairs  # type: ignore[attr-defined]
        assert here.node._learn._execute(canceled).error_code == Learn.Result.CANCELED
        assert len(successors) == 1, "two pieces have become one object"
        wait_until(lambda: len(heard) == 2, "the objects after the repair", pause=here.inputs.live.tick)
        assert here.done("segment").report.learner == "votes"


def test_a_saved_state_comes_back_and_later_masks_are_matched_to_its_objects(robot: Robot) -> None:
    views = shuffled_views()
    fused(robot, views[:5])
    robot.done("save_state")
    robot.done("reset")
    assert robot.done("load_state").num_views == 5
    robot.drive(views[5:])
    robot.ros.wait_until(lambda: robot.ask("segment").report.num_views == 6, "the last view")
    assert_objects_are_the_balls(robot.exported(Path(robot.get("data_root")) / "out" / "loaded"))


def test_parts_are_given_where_the_parameter_granularity_asks_for_them(robot: Robot) -> None:
    objects = fused(robot, views_in_halves()).classes
    assert robot.set("granularity", 0.9) == (True, "")
    try:
        answer = robot.done("segment", classes=[])
        names = [thing.name for thing in answer.objects]
        parts = [name for name in names if "." in name]
        assert len(parts) == 2 and len(names) == 4
        whole = parts[0].removesuffix(".1")
        assert parts == [f"{whole}.1", f"{whole}.2"] and whole not in names
        sizes = {summary.name: summary.num_gaussians for summary in (*objects, *answer.report.classes)}
        assert sizes[parts[0]] + sizes[parts[1]] == sizes[whole]
        alone = robot.done("segment", classes=[parts[1]], publish_nothing=True)
        assert alone.cloud.width == sizes[parts[1]]
        assert robot.ask("segment", classes=[whole]).error_code == Segment.Response.UNKNOWN_CLASS
    finally:
        assert robot.set("granularity", -1.0) == (True, "")
    assert [summary.name for summary in robot.done("segment").report.classes] == [one.name for one in objects]
    tree = robot.exported(Path(robot.get("data_root")) / "out" / "with_tree").tree
    assert tree is not None and len(tree) == len(objects) + 2


def test_one_request_may_ask_for_parts_while_others_get_the_objects(robot: Robot) -> None:
    objects = fused(robot, views_in_halves()).classes
    parts = [thing.name for thing in robot.done("segment", granularity=[0.9], publish_nothing=True).objects]
    assert len(parts) == 4 and sum("." in name for name in parts) == 2
    assert [summary.name for summary in robot.done("segment").report.classes] == [one.name for one in objects]
    assert robot.set("granularity", 0.9) == (True, "")
    try:
        assert [thing.name for thing in robot.done("segment").objects] == parts
        given = robot.done("segment", granularity=[-1.0]).report.classes
        assert [summary.name for summary in given] == [one.name for one in objects]
    finally:
        assert robot.set("granularity", -1.0) == (True, "")
    for level in (1.5, float("nan")):
        refused = robot.ask("segment", granularity=[level])
        assert refused.error_code == Segment.Response.INVALID_REQUEST
        assert refused.error_msg == f"granularity is {level:g}; expected 0 to 1, or below 0 for the objects"


def test_a_dataset_folder_cannot_be_learnt_from(robot: Robot) -> None:
    fused(robot, shuffled_views(2))
    status, result = robot.learn(dataset_path="data")
    assert status == GoalStatus.STATUS_ABORTED
    assert result.error_code == Learn.Result.INVALID_REQUEST
    assert "ids are per view; expected to learn from the views received only" in result.error_msg


def test_class_names_cannot_be_given_too(ros: Ros, parameters: dict[str, Any]) -> None:
    process = ros.start("segment_node", {**parameters, "class_names": ["background", "ball"]})
    assert process.wait() == 2
    (line,) = process.output.splitlines()
    assert "parameter class_names gives 2 names, but with ids 'per-view' the node finds the objects" in line


def test_given_ids_are_taken_for_classes_as_ever(ros: Ros, parameters: dict[str, Any]) -> None:
    robot = Robot(ros).started({**parameters, "ids": "given"})
    report = fused(robot, clean_views(2))
    assert [summary.name for summary in report.classes] == ["background", "class_01", "class_02", "class_03"]
