"""Objects with boxes, as a planner gets them from the node, and the markers that people see of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from gsseg_msgs.msg import Object, ObjectArray
from ros_fixtures import parameters_fixture, root_fixture, running_fixture, scene_fixture, shared_fixture  # noqa: F401
from ros_helpers import Ros, ros_fixture  # noqa: F401
from ros_robot import LATCHED, Robot, core_session
from small_scenes import clean_views
from visualization_msgs.msg import Marker, MarkerArray

from gsseg_core.export.pictures import palette
from gsseg_core.objects.oriented_boxes import object_boxes
from gsseg_core.refine.settings import PAPER, UNREFINED
from gsseg_core.scene.camera import rigid_motion
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import Segmentation
from gsseg_ros.conversions import pose_from_matrix
from gsseg_ros.frames import Similarity
from gsseg_ros.node.live_outputs import OBJECTS_PERIOD
from gsseg_ros.object_messages import box_from_object


@pytest.fixture
def robot(running: Robot) -> Robot:
    """A node that has fused six views."""
    running.done("reset")
    running.fuse(clean_views(6))
    return running


def assert_objects(found: list[Object], scene: GaussianScene, result: Segmentation, place: Similarity) -> None:
    """The messages are the core's boxes of a segmentation, in the map."""
    boxes = object_boxes(scene, result)
    assert [thing.id for thing in found] == list(boxes)
    for thing in found:
        index = result.labels == thing.id
        assert (thing.name, thing.num_gaussians) == (result.class_names[thing.id], index.sum())
        assert thing.confidence == pytest.approx(result.confidence[index].mean(), abs=1e-4)
        color = palette(result.num_classes)[thing.id] / 255
        np.testing.assert_allclose([thing.color.r, thing.color.g, thing.color.b], color, atol=1e-6)
        box, expected = box_from_object(thing), place.box_to_map(boxes[thing.id])
        np.testing.assert_allclose(box.mean, expected.mean, atol=1e-4)
        np.testing.assert_allclose(box.covariance, expected.covariance, atol=1e-4)
        np.testing.assert_allclose(box.size, expected.size, atol=1e-3)
        np.testing.assert_allclose(box.center, expected.center, atol=1e-3)
        np.testing.assert_allclose(box.axes, expected.axes, atol=1e-2)


def test_the_objects_of_a_run_are_answered_and_latched_with_their_boxes(robot: Robot, scene: GaussianScene) -> None:
    response = robot.done("segment")
    session = core_session(scene, clean_views(6))
    assert_objects(response.objects, scene, session.segmentation(PAPER), Similarity())
    (latched,) = robot.latched((ObjectArray, "objects"))
    assert (latched.header, latched.revision) == (response.report.header, response.report.revision)
    assert latched.objects == response.objects
    assert "boxes" in [stage.name for stage in response.report.stages]


def test_only_the_objects_that_were_asked_for_are_there(robot: Robot) -> None:
    response = robot.done("segment", classes=["background", "box"])
    assert [thing.name for thing in response.objects] == ["box"]
    sure = robot.done("segment", min_confidence=1.0)
    assert sum(thing.num_gaussians for thing in sure.objects) == sum(
        summary.num_gaussians for summary in sure.report.classes if summary.class_id > 0
    )


def test_markers_show_a_box_and_a_name_for_each_object_and_nothing_else(robot: Robot) -> None:
    objects = robot.done("segment").objects
    (array,) = robot.latched((MarkerArray, "object_markers"))
    first, *markers = array.markers
    assert first.action == Marker.DELETEALL
    assert [(marker.ns, marker.id) for marker in markers] == [
        (namespace, thing.id) for thing in objects for namespace in ("boxes", "names")
    ]
    assert {marker.header.frame_id for marker in markers} == {"map"}
    for thing, (box, name) in zip(objects, zip(markers[::2], markers[1::2], strict=True), strict=True):
        assert (box.type, box.pose, box.scale) == (Marker.CUBE, thing.box_pose, thing.box_size)
        assert 0 < box.color.a < 1 and (box.color.r, box.color.g) == (thing.color.r, thing.color.g)
        assert (name.type, name.text) == (Marker.TEXT_VIEW_FACING, thing.name)
        top = box_from_object(thing).corners[:, 2].max()
        assert top < name.pose.position.z < top + 0.5


def test_learning_publishes_the_objects_of_its_run(robot: Robot, scene: GaussianScene) -> None:
    _, result = robot.learn()
    assert result.error_code == 0, result.error_msg
    (latched,) = robot.latched((ObjectArray, "objects"))
    assert (latched.header, latched.revision) == (result.report.header, result.report.revision)
    session = core_session(scene, clean_views(6))
    session.learn()
    assert [thing.id for thing in latched.objects] == list(object_boxes(scene, session.segmentation(UNREFINED)))


def test_the_objects_of_a_run_stay_until_another_view_comes(robot: Robot) -> None:
    _, result = robot.learn()
    heard = robot.ros.collect(ObjectArray, f"{robot.name}/objects", LATCHED)
    robot.ros.wait_until(lambda: heard, "the latched message")
    told = len(robot.received_status)
    enough = told + 2 + OBJECTS_PERIOD  # Diagnostics come once a second, by the clock of the node.
    robot.ros.wait_until(lambda: len(robot.received_status) > enough, "the node to go on for a while")
    assert {array.revision for array in heard} == {result.report.revision}
    robot.drive(clean_views(1))
    robot.ros.wait_until(lambda: heard[-1].revision == 0, "objects of the view")


@pytest.mark.parametrize("request_", ["reset", "load_scene"])
def test_afterwards_there_are_no_objects(robot: Robot, request_: str) -> None:
    robot.done("segment")
    robot.done(request_)
    objects, markers = robot.latched((ObjectArray, "objects"), (MarkerArray, "object_markers"))
    assert list(objects.objects) == []
    assert [marker.action for marker in markers.markers] == [Marker.DELETEALL]


def test_objects_come_by_themselves_while_views_come_and_somebody_listens(robot: Robot, scene: GaussianScene) -> None:
    robot.done("reset")
    heard = robot.ros.collect(ObjectArray, f"{robot.name}/objects", LATCHED)
    robot.ros.wait_until(lambda: heard, "the latched message")  # So the two have found each other.
    robot.drive(clean_views(6))
    robot.ros.wait_until(lambda: heard[-1].objects, "objects")
    # The first ones may be from before the last views; those after them are sent when another view comes.
    robot.wait_for_status(lambda status: status.get("views fused") == "6", "six views")
    count = len(heard)
    robot.drive(clean_views(1))
    robot.ros.wait_until(lambda: len(heard) > count, "objects of all views")
    assert {array.revision for array in heard[1:]} == {0}
    result = core_session(scene, [*clean_views(6), clean_views(1)[0]]).segmentation(UNREFINED)
    assert [thing.id for thing in heard[-1].objects] == list(object_boxes(scene, result))


def test_boxes_are_in_the_map_where_the_scene_has_another_frame_and_scale(
    ros: Ros, parameters: dict[str, Any], scene: GaussianScene
) -> None:
    rotation, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    rotation *= np.linalg.det(rotation)
    place = Similarity(2.5, rotation, np.array([4.0, -1.0, 0.5]))
    q = pose_from_matrix(rigid_motion(rotation, np.zeros(3))).orientation
    robot = Robot(ros).started({
        **parameters, "scene_to_map.scale": 2.5, "scene_to_map.translation": [4.0, -1.0, 0.5],
        "scene_to_map.rotation": [q.x, q.y, q.z, q.w],
    })  # fmt: skip
    views = clean_views(6)
    robot.drive(views, place)
    robot.ros.wait_until(lambda: robot.ask("segment").report.num_views == 6, "six views")
    assert_objects(robot.done("segment").objects, scene, core_session(scene, views).segmentation(PAPER), place)
