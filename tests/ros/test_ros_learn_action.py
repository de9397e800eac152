"""The action `~/learn` of the segmentation node, from another process: feedback, result, cancel, failures."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from action_msgs.srv import CancelGoal
from gsseg_msgs.action import Learn
from mask_writers import sam_json
from ros_datasets import copied, write_long_dataset
from ros_fixtures import parameters_fixture, running_fixture, scene_fixture, shared_fixture  # noqa: F401
from ros_helpers import Ros
from ros_robot import CLASSES, Goal, Robot, assert_same, renamed
from small_scenes import clean_views, taught, write_dataset, wrong_views

from gsseg_core.data.dataset import Dataset
from gsseg_core.data.view import View, spread
from gsseg_core.learn.calibrate import calibrate
from gsseg_core.learn.registry import make_learner
from gsseg_core.live.session import LiveSession
from gsseg_core.refine.settings import UNREFINED
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import REMOVED, Segmentation

LEARNERS = ("em", "votes", "gradient")


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("root")
    write_dataset(root / "data")
    write_long_dataset(root / "long")
    return root


@pytest.fixture
def robot(running: Robot) -> Iterator[Robot]:
    """A node that has received eight views, some of them wrong; shared by the tests of this file."""
    running.done("reset")
    running.fuse(wrong_views())
    yield running
    for goal in running.goals:  # Left by a test that failed.
        if not goal.future.done():
            running.cancel(goal)


def needs(learner: str) -> None:
    if learner == "gradient":
        pytest.importorskip("torch")


def codes(robot: Robot) -> np.ndarray:
    return robot.exported(Path(robot.get("data_root")) / "out" / "codes", skip_refinement=True).probabilities


def expected(scene: GaussianScene, views: list[View], learner: str = "em", **settings: Any) -> Segmentation:
    """What the core's own learner comes to, before objects are cut to their silhouettes."""
    fitted = taught(make_learner(learner, scene, len(CLASSES), **settings), views).fit()
    result = Segmentation.from_codes(scene, fitted.codes_, dict(enumerate(CLASSES)), evidence=fitted.evidence())
    return result.calibrated(calibrate(fitted).temperature)


def learnt_by(robot: Robot, **fields: Any) -> Segmentation:
    return robot.exported(Path(robot.get("data_root")) / "out" / "learnt", **fields)


def assert_learnt(robot: Robot, wanted: Segmentation) -> None:
    assert_same(learnt_by(robot, skip_filter=True), wanted)


@pytest.mark.parametrize("learner", LEARNERS)
def test_the_result_equals_that_of_the_core_on_the_same_views(robot: Robot, scene: GaussianScene, learner: str) -> None:
    needs(learner)
    status, result = robot.learn(learner=learner)
    assert (status, result.error_code, result.error_msg) == (GoalStatus.STATUS_SUCCEEDED, Learn.Result.NONE, "")
    found = learnt_by(robot, skip_filter=True)
    wanted = expected(scene, wrong_views(), learner)
    # A pose that went through a quaternion differs in the last digit, and Adam's first steps divide by tiny gradients.
    assert (found.labels == wanted.labels).mean() >= (0.99 if learner == "gradient" else 1)
    assert (result.report.job, result.report.learner, result.report.num_views) == ("learn", learner, 8)
    assert math.isfinite(result.loss) == (learner != "votes")
    assert robot.done("segment").report.learner == learner


def test_the_learner_is_em_unless_another_one_is_asked_for(robot: Robot, scene: GaussianScene) -> None:
    goal = robot.goal()
    status, result = robot.outcome(goal)
    fitted = make_learner("em", scene, len(CLASSES))
    taught(fitted, wrong_views()).fit()
    assert (status, result.report.learner) == (GoalStatus.STATUS_SUCCEEDED, "em")
    assert (result.num_steps, result.converged) == (len(fitted.history_), True)
    assert result.loss == pytest.approx(fitted.loss, abs=1e-4)
    assert_learnt(robot, expected(scene, wrong_views()))


def test_the_result_reports_the_learnt_codes_before_refinement(robot: Robot, scene: GaussianScene) -> None:
    report = robot.learn()[1].report
    fitted = taught(make_learner("em", scene, len(CLASSES)), wrong_views()).fit()
    wanted = Segmentation.from_codes(scene, fitted.codes_, dict(enumerate(CLASSES)), UNREFINED)
    assert [summary.num_gaussians for summary in report.classes] == wanted.counts().tolist()
    assert [summary.name for summary in report.classes] == CLASSES
    assert (report.k, report.filtered, report.num_removed) == (0, False, 0)
    assert {"observe", "learn"} <= {stage.name for stage in report.stages}
    assert 0 < sum(stage.seconds for stage in report.stages) <= report.total_seconds


def test_feedback_tells_the_stages_and_how_far_they_are(running: Robot) -> None:
    goal = running.goal(dataset_path="long", num_views=100, max_steps=3)
    status, result = running.outcome(goal)
    assert status == GoalStatus.STATUS_SUCCEEDED, result.error_msg
    assert goal.stages[:2] == ["observe", "em"] and goal.stages[-1] == "calibrate"
    totals = {"observe": 100, "em": 3}
    for message in goal.feedback:
        assert 0 <= message.done <= message.total == totals.get(message.stage, message.total)
    for stage in goal.stages:
        done = [message.done for message in goal.feedback if message.stage == stage]
        assert done == sorted(done)
    assert len(goal.feedback) > 3
    assert math.isnan(goal.feedback[0].loss)
    assert goal.feedback[-1].done == goal.feedback[-1].total
    assert math.isfinite(goal.feedback[-1].loss)
    assert goal.feedback[-1].loss == pytest.approx(result.loss)


def test_it_learns_from_the_train_views_of_a_dataset_folder(robot: Robot, scene: GaussianScene, root: Path) -> None:
    robot.done("reset")
    status, result = robot.learn(dataset_path="data")
    assert status == GoalStatus.STATUS_SUCCEEDED, result.error_msg
    views = Dataset(root / "data").views("train")
    assert result.report.num_views == len(views) == 4
    assert "load" in {stage.name for stage in result.report.stages}
    assert_learnt(robot, expected(scene, views))


def test_a_goal_chooses_the_masks_which_may_be_soft_and_a_label_map(
    robot: Robot, scene: GaussianScene, root: Path
) -> None:
    robot.done("reset")
    (root / "data/soft").mkdir(exist_ok=True)
    for view in Dataset(root / "data").views("all"):
        sure = 0.9 * np.eye(len(CLASSES), dtype=np.float32)[view.read_labels()] + 0.1 / len(CLASSES)
        np.savez(root / "data/soft" / f"{view.name}.npz", probabilities=np.moveaxis(sure, -1, 0))
    (root / "no_ball.json").write_text('{"red ball": null}')
    status, result = robot.learn(dataset_path="data", labels="soft", label_map="no_ball.json")
    assert status == GoalStatus.STATUS_SUCCEEDED, result.error_msg
    views = Dataset(root / "data", "soft", label_map=root / "no_ball.json").views("train")
    assert_learnt(robot, expected(scene, views))
    assert result.report.classes[1].num_gaussians == 0 < result.report.classes[2].num_gaussians


def test_masks_whose_ids_hold_in_their_own_view_are_no_classes_to_learn(robot: Robot, root: Path) -> None:
    labels = {view.name: view.read_labels() for view in Dataset(root / "data").views("all")}
    (root / "sam").mkdir()
    masks = sam_json(root / "sam", labels, {})
    status, result = robot.learn(dataset_path="data", labels=str(masks.relative_to(root)))
    assert (status, result.error_code) == (GoalStatus.STATUS_ABORTED, Learn.Result.INVALID_REQUEST)
    assert "ids hold in their own view only" in result.error_msg


def test_views_that_come_after_a_learn_from_a_folder_are_kept_and_do_not_disturb_it(
    robot: Robot, scene: GaussianScene, root: Path
) -> None:
    robot.done("reset")
    assert robot.learn(dataset_path="data")[0] == GoalStatus.STATUS_SUCCEEDED
    before = codes(robot)
    robot.drive(clean_views(3))
    robot.wait_for_status(lambda status: status.get("views fused") == "3", "three views")
    seen = before.any(axis=1)
    np.testing.assert_array_equal(codes(robot)[seen], before[seen])
    assert robot.learn()[1].report.num_views == 3
    assert_learnt(robot, expected(scene, clean_views(3)))


def test_num_views_are_spread_over_those_there_are(robot: Robot, scene: GaussianScene) -> None:
    status, result = robot.learn(num_views=3)
    assert (status, result.report.num_views) == (GoalStatus.STATUS_SUCCEEDED, 3)
    assert_learnt(robot, expected(scene, spread(wrong_views(), 3)))
    assert robot.learn(num_views=100)[1].report.num_views == 8


@pytest.mark.parametrize(("learner", "steps"), [("em", 2), ("gradient", 3)])
def test_max_steps_ends_it_early(robot: Robot, scene: GaussianScene, learner: str, steps: int) -> None:
    needs(learner)
    status, result = robot.learn(learner=learner, max_steps=steps)
    assert (status, result.num_steps, result.converged) == (GoalStatus.STATUS_SUCCEEDED, steps, False)
    if learner == "em":
        assert_learnt(robot, expected(scene, wrong_views(), max_steps=steps))


def endless(learner: str) -> dict[str, Any]:
    """A goal that goes on until it is canceled."""
    needs(learner)
    return {"learner": "gradient", "max_steps": 1_000_000} if learner == "gradient" else {"dataset_path": "long"}


def halfway(robot: Robot, goal: Goal, stage: str, done: int) -> None:
    robot.ros.wait_until(
        lambda: any(message.stage == stage and message.done >= done for message in goal.feedback), f"{stage} {done}"
    )


@pytest.mark.parametrize(
    ("fields", "stage", "done"),
    [
        ({"dataset_path": "long"}, "observe", 0),
        ({"dataset_path": "long"}, "observe", 100),
        ({"dataset_path": "long", "learner": "votes"}, "observe", 20),
        ({"dataset_path": "long", "num_views": 400}, "em", 0),
        ({"learner": "gradient", "max_steps": 1_000_000}, "gradient", 100),
    ],
)
def test_cancel_ends_it_at_once_and_keeps_the_codes_from_before(
    robot: Robot, fields: dict[str, Any], stage: str, done: int
) -> None:
    needs(fields.get("learner", ""))
    before, report = codes(robot), robot.done("segment").report
    goal = robot.goal(**fields)
    halfway(robot, goal, stage, done)
    status, result = robot.cancel(goal)
    assert (status, result.error_code) == (GoalStatus.STATUS_CANCELED, Learn.Result.CANCELED)
    assert result.error_msg == "learn was canceled; what was known before is kept"
    np.testing.assert_array_equal(codes(robot), before)
    after = robot.done("segment").report
    assert (after.learner, after.num_views) == (report.learner, report.num_views) == ("votes", 8)
    assert robot.learn()[0] == GoalStatus.STATUS_SUCCEEDED, "the next goal is welcome"


def test_anybody_cancels_the_goal_of_a_client_that_is_gone(robot: Robot) -> None:
    goal, node = robot.begin(**endless("em")), robot.ros.node
    anybody = node.create_client(CancelGoal, f"{robot.name}/learn/_action/cancel_goal")
    robot.ros.wait_until(anybody.service_is_ready, "the service")
    assert len(robot.ros.result(anybody.call_async(CancelGoal.Request())).goals_canceling) == 1
    assert robot.outcome(goal)[0] == GoalStatus.STATUS_CANCELED
    node.destroy_client(anybody)


def test_cancel_keeps_what_an_earlier_goal_learnt(robot: Robot) -> None:
    assert robot.learn()[0] == GoalStatus.STATUS_SUCCEEDED
    before = codes(robot)
    robot.cancel(robot.begin(**endless("em")))
    np.testing.assert_array_equal(codes(robot), before)
    assert robot.done("segment").report.learner == "em"


@pytest.mark.parametrize("learner", ["em", "gradient"])
def test_while_it_learns_a_second_goal_is_busy_and_everything_else_is_answered(robot: Robot, learner: str) -> None:
    goal = robot.begin(**endless(learner))
    status, result = robot.learn()
    assert (status, result.error_code) == (GoalStatus.STATUS_ABORTED, Learn.Result.BUSY)
    assert result.error_msg == "learn is running; expected to start learn after it: cancel it, or wait"

    assert robot.done("segment").report.num_views == 8
    assert robot.get("k") == 50
    assert robot.set("beta", 0.65) == (True, "")
    assert robot.set("max_views", 5)[0] is False
    assert robot.state == "active"
    assert robot.done("save_state", path="out/busy.npz").num_views == 8
    robot.drive(clean_views(2))
    robot.wait_for_status(lambda status: status.get("views fused") == "10", "two views to be fused beside it")

    assert not goal.future.done()
    status, result = robot.cancel(goal)
    assert (status, result.error_code) == (GoalStatus.STATUS_CANCELED, Learn.Result.CANCELED)


def test_views_that_come_while_it_learns_are_not_lost_and_exports_are_cut_to_their_silhouettes(
    robot: Robot, scene: GaussianScene
) -> None:
    goal = robot.begin(dataset_path="long", num_views=150)
    robot.drive(clean_views(2))
    assert robot.outcome(goal)[0] == GoalStatus.STATUS_SUCCEEDED
    robot.wait_for_status(lambda status: status.get("views kept") == "10", "ten views")
    assert robot.learn()[1].report.num_views == 10
    session = LiveSession(scene, dict(enumerate(CLASSES)))
    for view in renamed([*wrong_views(), *clean_views(2)]):
        session.fuse(view)
    session.learn()
    assert_same(learnt_by(robot), session.segmentation())
    assert (learnt_by(robot).labels == REMOVED).any()


def test_a_goal_that_was_canceled_before_is_not_confused_with_the_next(robot: Robot) -> None:
    first = robot.begin(**endless("em"))
    robot.cancel(first)
    second = robot.goal()
    assert robot.outcome(second)[0] == GoalStatus.STATUS_SUCCEEDED
    answer = robot.ros.result(
        robot.ros.run(second.handle.cancel_goal_async), "the answer to a cancel that comes too late"
    )
    assert answer.return_code != answer.ERROR_NONE and not answer.goals_canceling
    assert robot.outcome(second)[1].error_code == Learn.Result.NONE


def break_mask(folder: Path) -> str:
    mask = folder / "labels" / "view3.png"
    mask.write_bytes(mask.read_bytes()[:60])
    return "broken/labels/view3.png: broken PNG"


def break_cameras(folder: Path) -> str:
    (folder / "cameras.json").write_text("{")
    return "broken/cameras.json: "


def break_split(folder: Path) -> str:
    (folder / "split.json").write_text('{"train": ["nowhere"]}')
    return "broken/split.json: "


def break_classes(folder: Path) -> str:
    (folder / "classes.json").write_text('{"one": "ball"}')
    return "broken/classes.json: "


def take_a_class_away(folder: Path) -> str:
    (folder / "classes.json").write_text('{"1": "red ball", "2": "cup/mug"}')
    return "broken/labels/view0.png: mask holds the labels 3"


def call_a_class_otherwise(folder: Path) -> str:
    (folder / "classes.json").write_text('{"1": "red ball", "2": "box", "3": "cup/mug"}')
    return "broken: calls class 2 'box'; expected 'cup/mug'"


BROKEN = [break_mask, break_cameras, break_split, break_classes, take_a_class_away, call_a_class_otherwise]


@pytest.mark.parametrize("spoil", BROKEN)
def test_a_broken_dataset_aborts_it_and_the_message_names_the_file(
    robot: Robot, root: Path, tmp_path_factory: pytest.TempPathFactory, spoil: Any
) -> None:
    folder = root / tmp_path_factory.mktemp("run").name
    says = spoil(copied(root / "data", folder / "broken"))
    before = codes(robot)
    status, result = robot.learn(dataset_path=f"{folder.name}/broken")
    assert (status, result.error_code) == (GoalStatus.STATUS_ABORTED, Learn.Result.INVALID_FILE), result.error_msg
    assert f"{folder}/{says}" in result.error_msg and "\n" not in result.error_msg
    assert result == Learn.Result(error_code=result.error_code, error_msg=result.error_msg)
    robot.wait_for_status(
        lambda status: status.get("last job") == f"learn failed: {result.error_msg}", "the diagnostics"
    )
    np.testing.assert_array_equal(codes(robot), before)
    assert robot.learn()[0] == GoalStatus.STATUS_SUCCEEDED
    assert robot.process is not None and "Traceback" not in robot.process.output


def test_views_of_a_dataset_that_cannot_be_used_are_left_out_and_reported(
    robot: Robot, root: Path, scene: GaussianScene
) -> None:
    folder = copied(root / "data", root / "missing")
    (folder / "labels" / "view1.png").unlink()
    robot.done("reset")
    status, result = robot.learn(dataset_path="missing")
    assert status == GoalStatus.STATUS_SUCCEEDED
    report = result.report
    assert (report.num_views, report.num_views_rejected) == (3, 1)
    assert (list(report.rejection_reasons), list(report.rejection_counts)) == (["no_mask"], [1])
    assert_learnt(robot, expected(scene, [v for v in Dataset(folder).views("train") if v.name != "view1"]))


def test_without_declared_classes_those_of_the_dataset_are_taken_over(shared: Ros, root: Path) -> None:
    robot = Robot(shared, "/undeclared").started({"scene_path": root / "data" / "scene.ply", "data_root": root})
    status, result = robot.learn(dataset_path="data")
    assert status == GoalStatus.STATUS_SUCCEEDED, result.error_msg
    assert [summary.name for summary in result.report.classes] == CLASSES
    report = robot.done("segment", classes=["cup/mug"]).report
    assert [summary.topic for summary in report.classes] == ["/undeclared/gsseg/classes/cup_mug"]
