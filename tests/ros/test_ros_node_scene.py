"""Which scene the node's views and outputs belong to, when scenes, states and lifecycle change under its hands."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from gsseg_msgs.action import Learn
from gsseg_msgs.msg import ObjectArray, SegmentationReport
from patience import PATIENCE
from rclpy.parameter import Parameter
from ros_fixtures import parameters_fixture, root_fixture, scene_fixture, shared_fixture  # noqa: F401
from ros_helpers import Ros, wait_until
from ros_node_here import NodeHere, node_here
from ros_robot import IDENTITY, LATCHED, SECOND, SERVICES, Robot, core_session, messages, renamed, viewpoint
from sensor_msgs.msg import Image, PointCloud2
from small_scenes import clean_views

from gsseg_core.data.view import View
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_ros.frames import Similarity
from gsseg_ros.node import inputs, segment_node
from gsseg_ros.node.matched_subscription import MatchedSubscription

CHANGES = ("load_scene", "reset", "load_state")


@pytest.fixture
def here(shared: Ros, parameters: dict[str, Any]) -> Iterator[NodeHere]:
    with node_here(shared, parameters) as here:
        yield here


@pytest.fixture(scope="module")
def robot(shared: Ros) -> Robot:
    """Somebody who listens."""
    return Robot(shared)


def in_thread(work: Callable[[], Any]) -> tuple[threading.Thread, list[Any]]:
    answers: list[Any] = []
    thread = threading.Thread(target=lambda: answers.append(work()), daemon=True)
    thread.start()
    return thread, answers


def joined(thread: threading.Thread) -> None:
    thread.join(PATIENCE)
    assert not thread.is_alive()


# Views


@pytest.mark.parametrize("work", ["save_state", "export", "learn"])
def test_what_is_saved_exported_or_learnt_is_of_views_that_have_all_followed_the_scene(
    here: NodeHere, monkeypatch: pytest.MonkeyPatch, work: str
) -> None:
    views, found = clean_views(3), []
    here.fuse(views)
    workspace = here.node.workspace
    session, method = workspace.living_session, {"save_state": "save", "export": "segmentation", "learn": "learn"}[work]
    done = getattr(session, method)

    def noted(*arguments: Any, **settings: Any) -> Any:
        found.append([view.camera.world_to_camera for view in session.views])
        return done(*arguments, **settings)

    monkeypatch.setattr(session, method, noted)
    monkeypatch.setattr(workspace.placement, "_begin", lambda: None)  # What follows in the background comes too late.
    aside = [0.05, -0.02, 0.03]
    (result,) = here.node.set_parameters([Parameter("scene_to_map.translation", value=aside)])
    assert result.successful
    if work == "learn":
        goal = MagicMock(request=Learn.Goal(max_steps=1), is_cancel_requested=False)
        assert here.node._learn._execute(goal).error_code == 0
    else:
        here.done(work)
    place = Similarity.from_parameters(1.0, aside, [0.0, 0.0, 0.0, 1.0])
    in_map = [IDENTITY.camera_in_map(view.camera.world_to_camera) for view in views]
    np.testing.assert_allclose(found[0], [place.world_to_camera(pose) for pose in in_map], atol=1e-6)


def test_views_of_a_saved_state_stay_when_the_stamps_of_a_new_run_repeat(
    shared: Ros, parameters: dict[str, Any], scene: GaussianScene
) -> None:
    views = clean_views(10)
    with node_here(shared, parameters) as before:
        before.fuse(views[:5])
        before.done("save_state", path="restart.npz")
    with node_here(shared, parameters) as after:
        assert after.done("load_state", path="restart.npz").num_views == 5
        after.fuse(views[5:])
        session = after.node.workspace.session
        assert session.num_fused == session.num_views == 10
        assert after.done("save_state", path="restart.npz").num_views == 10
        expected = core_session(scene, renamed(views)).codes()
        np.testing.assert_allclose(session.codes(), expected, atol=1e-4)


def test_messages_that_come_while_it_still_subscribes_are_taken_in(
    shared: Ros, parameters: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    sent = messages(clean_views(1)[0], 1000 * SECOND)

    class Early(MatchedSubscription):
        def __init__(self, node: Any, kind: Any, topic: str, callback: Any, group: Any) -> None:
            super().__init__(node, kind, topic, callback, group)
            callback(sent[topic])

    monkeypatch.setattr(inputs, "MatchedSubscription", Early)
    with node_here(shared, parameters) as here:
        here.inputs._hand_over()
        wait_until(lambda: here.inputs.accepted == 1, "the view")
        assert [count for count, _ in here.inputs.arrivals.values()] == [1, 1, 1]


def test_views_stay_when_the_stamps_repeat_after_an_activation(here: NodeHere) -> None:
    views, stamp = clean_views(4), here.stamp
    here.fuse(views[:2])
    here.node.trigger_deactivate()
    here.node.trigger_activate()
    here.stamp = stamp
    here.fuse(views[2:])
    session = here.node.workspace.session
    assert session.num_fused == session.num_views == 4


@pytest.mark.parametrize("change", CHANGES)
def test_masks_that_wait_for_their_poses_are_not_fused_into_what_comes_after(here: NodeHere, change: str) -> None:
    here.fuse(clean_views(1))
    here.done("save_state")
    views = clean_views(8, "late")
    stamps = here.send(views, ["camera_info", "mask"])
    assert here.inputs.cameras[""].pairing.waiting == 8
    here.done(change)
    assert here.inputs.cameras[""].pairing.waiting == 0 and here.inputs.rejected == {"scene_changed": 8}
    here.send(views, ["pose"], stamps)
    here.fuse(clean_views(1, "new"))
    session = here.node.workspace.session
    assert session.num_fused == session.num_views == (2 if change == "load_state" else 1)
    report = here.done("segment").report
    assert (report.num_views, report.num_views_rejected) == (session.num_fused, 0)


@pytest.mark.parametrize("change", CHANGES)
def test_masks_that_are_fused_or_queued_at_that_moment_are_not_views_of_what_comes_after(
    here: NodeHere, change: str
) -> None:
    here.fuse(clean_views(1))
    here.done("save_state")
    with here.node.workspace.session._lock:
        here.send(clean_views(5, "late"))
        wait_until(lambda: here.inputs.worker.waiting == 4, "one mask to be in hand")
        asked = threading.Thread(target=here.done, args=(change,))
        if change == "load_state":  # Waits for the one in hand, which then belongs to what was known before.
            asked.start()
        else:
            here.done(change)
    if change == "load_state":
        asked.join()
    wait_until(lambda: here.inputs.accepted + here.inputs.rejected.total() == 6, "the one in hand to be done with")
    assert set(here.inputs.rejected) <= {"scene_changed"}
    assert change == "load_state" or here.inputs.accepted == 1
    session = here.node.workspace.session
    assert session.num_fused == (1 if change == "load_state" else 0) and not session.rejected


# Outputs


@pytest.mark.parametrize("change", CHANGES)
def test_what_was_latched_of_before_is_replaced_by_empty_messages(here: NodeHere, robot: Robot, change: str) -> None:
    here.fuse(clean_views(2))
    here.done("save_state")
    heard = robot.ros.collect(Image, "/gsseg/overlay", 1)
    robot.ros.wait_until(here.outputs.wants_overlay, "the node to know who looks")
    before = here.done("segment", **viewpoint(clean_views(1)[0])).report
    robot.ros.wait_until(lambda: heard, "the overlay")
    here.done(change)
    kinds = {"report": SegmentationReport, "overlay": Image, "cloud": PointCloud2, "objects": ObjectArray}
    topics = [(kind, topic) for topic, kind in kinds.items()]
    report, overlay, cloud, objects = robot.latched(*topics)
    assert report.revision > before.revision and report.job == change and not report.classes
    assert (report.scene_hash, report.num_gaussians) == (before.scene_hash, before.num_gaussians)
    assert report.num_unobserved == report.num_gaussians and report.num_views == 0
    assert (overlay.width, cloud.width, len(objects.objects)) == (0, 0, 0)
    assert objects.revision == report.revision
    assert {message.header.stamp.nanosec for message in (overlay, cloud, objects)} == {report.header.stamp.nanosec}


def test_a_request_that_began_before_a_reset_is_answered_and_publishes_nothing(here: NodeHere, robot: Robot) -> None:
    here.fuse(clean_views(2))
    selected, go_on = threading.Event(), threading.Event()
    services = here.node._requests
    select = services._select

    def slowly(*arguments: Any) -> Any:
        selection = select(*arguments)
        selected.set()
        assert go_on.wait(PATIENCE)
        return selection

    services._select = slowly  # type: ignore[method-assign]
    thread, answers = in_thread(lambda: here.ask("segment"))
    assert selected.wait(PATIENCE)
    here.done("reset")
    go_on.set()
    joined(thread)
    assert answers[0].error_code == 0 and answers[0].objects
    cloud, report = robot.latched((PointCloud2, "cloud"), (SegmentationReport, "report"))
    assert cloud.width == 0 and report.job == "reset"


def test_of_requests_at_the_same_time_one_is_published_whole_and_last_the_newest(here: NodeHere, robot: Robot) -> None:
    here.fuse(clean_views(3))
    for _ in range(10):
        threads, answers = zip(
            *(in_thread(lambda least=least: here.done("segment", min_confidence=least)) for least in (0.0, 0.9)),
            strict=True,
        )
        for thread in threads:
            joined(thread)
        newest = max((answer[0].report for answer in answers), key=lambda report: report.revision)
        topics = [f"classes/{token}" for token in ("red_ball", "box")]
        report, objects, *clouds = robot.latched(
            (SegmentationReport, "report"), (ObjectArray, "objects"), *((PointCloud2, topic) for topic in topics)
        )
        assert report.revision == objects.revision == newest.revision
        counts = {summary.class_id: summary.num_gaussians for summary in newest.classes}
        assert all(thing.num_gaussians == counts[thing.id] for thing in objects.objects)
        assert [cloud.width for cloud in clouds] == [counts[1], counts[3]]


def test_deactivate_waits_for_a_request_at_work(here: NodeHere, robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(segment_node, "STOP_SECONDS", PATIENCE)
    here.fuse(clean_views(2))
    with here.node.workspace.session._lock:
        asking, answers = in_thread(lambda: here.ask("segment"))
        wait_until(lambda: here.node.workspace.requests._count == 1, "the request to be at work")
        ending, _ = in_thread(here.node.trigger_deactivate)
        wait_until(lambda: not here.node.workspace.active, "the transition to begin")
        assert ending.is_alive() and not answers
    joined(ending)
    assert answers and answers[0].error_code == 0
    joined(asking)
    (report,) = robot.latched((SegmentationReport, "report"))
    assert report.revision == answers[0].report.revision


def test_a_request_that_outlives_cleanup_publishes_nothing_and_makes_no_topic(
    here: NodeHere, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(segment_node, "STOP_SECONDS", 0.05)
    here.fuse(clean_views(2))
    with here.node.workspace.session._lock:
        asking, answers = in_thread(lambda: here.ask("segment"))
        wait_until(lambda: here.node.workspace.requests._count == 1, "the request to be at work")
        here.node.trigger_deactivate()
        here.node.trigger_cleanup()
        here.configure()
    joined(asking)
    assert len(answers) == 1
    topics = ["cloud", "report", *(f"classes/{token}" for token in ("background", "red_ball"))]
    publishers = robot.ros.node.count_publishers
    robot.ros.wait_until(lambda: all(publishers(f"/gsseg/{topic}") == 1 for topic in topics), "one publisher of each")
    assert here.ask("segment").error_code == SERVICES["segment"].Response.NO_CODES
    clouds = robot.ros.collect(PointCloud2, "/gsseg/cloud", LATCHED)
    here.done("reset")
    robot.ros.wait_until(lambda: clouds, "what is latched")
    assert {cloud.width for cloud in clouds} == {0}


# Topics of classes


def class_topics(robot: Robot) -> set[str]:
    prefix = "/gsseg/classes/"
    return {name[len(prefix) :] for name, _ in robot.ros.node.get_topic_names_and_types() if name.startswith(prefix)}


def test_classes_have_topics_while_they_have_gaussians_and_no_longer(
    shared: Ros, robot: Robot, parameters: dict[str, Any]
) -> None:
    views = clean_views(3)
    stray = views[0].read_labels()
    stray[0, 0] = 250
    undeclared = {name: value for name, value in parameters.items() if name != "class_names"}
    with node_here(shared, undeclared) as here:
        here.fuse([View.from_arrays(views[0].camera, stray), *views[1:]])
        report = here.done("segment").report
        filled = {summary.class_id for summary in report.classes if summary.num_gaussians}
        assert {0, 1, 2, 3} <= filled <= {0, 1, 2, 3, 250} and len(report.classes) == 251
        expected = {f"class_{k:02d}" if k else "background" for k in filled}
        robot.ros.wait_until(lambda: class_topics(robot) == expected, "their topics")
        assert {summary.topic for summary in report.classes} == {f"/gsseg/classes/{name}" for name in expected} | {""}
        here.done("reset")
        robot.ros.wait_until(lambda: not class_topics(robot), "them to go")
        here.fuse(clean_views(1, "more"))
        here.done("segment", classes=["1"])
        robot.ros.wait_until(lambda: "class_01" in class_topics(robot), "it to come back")


def test_a_stray_label_is_refused_with_what_to_do(
    shared: Ros, parameters: dict[str, Any], capfd: pytest.CaptureFixture[str]
) -> None:
    undeclared = {name: value for name, value in parameters.items() if name != "class_names"}
    with node_here(shared, {**undeclared, "max_classes": 4}) as here:
        here.fuse(clean_views(1))
        here.send([View.from_arrays(clean_views(1)[0].camera, np.full((48, 64), 4))])
        wait_until(lambda: here.inputs.rejected == {"unknown_label": 1}, "the mask to be refused")
        assert len(here.node.workspace.session.class_names) == 4
    assert "mask holds the label 4; expected at most 3, as max_classes is 4, or class_names" in capfd.readouterr().err


def test_names_that_were_announced_keep_their_topics(here: NodeHere, robot: Robot) -> None:
    here.fuse(clean_views(1))
    here.done("segment")
    here.done("reset")
    tokens = {"background", "red_ball", "cup_mug", "box"}
    robot.ros.wait_until(lambda: class_topics(robot) == tokens, "the topics")
    assert all(cloud.width == 0 for cloud in robot.latched(*((PointCloud2, f"classes/{token}") for token in tokens)))
