"""Sequences of a robot's day: what happens in the middle of something else, and what is left afterwards."""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any

import pytest
from geometry_msgs.msg import PoseStamped
from gsseg_msgs.action import Learn
from gsseg_msgs.msg import ObjectArray
from nav_msgs.msg import Odometry
from rclpy.action.server import GoalResponse
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros_fixtures import parameters_fixture, root_fixture  # noqa: F401
from ros_helpers import Ros, ros_fixture, wait_until  # noqa: F401
from ros_node_here import NodeHere, node_here
from ros_robot import LATCHED
from sensor_msgs.msg import PointCloud2
from small_scenes import clean_views, lost_half_way

from gsseg_ros.node import diagnostics, live_outputs, services
from gsseg_ros.node.masks.detections import Adapter
from gsseg_ros.node.masks.detections_input import ADAPTERS
from gsseg_ros.node.masks.yolo_detections import named_mask
from gsseg_ros.node.reports import Selection

SIDES = ("left", "right")


def test_a_scene_that_was_moved_just_before_a_deactivate_is_published_there_once_the_node_is_active(
    ros: Ros, parameters: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    clouds = ros.collect(PointCloud2, "/gsseg/cloud", LATCHED)
    with node_here(ros, parameters) as here:
        here.fuse(clean_views(3))
        here.done("segment")
        ros.wait_until(lambda: clouds, "the first cloud")
        places, tries = here.node._requests.turns._places, []
        monkeypatch.setattr(services, "explain", lambda node, error: tries.append(error) or str(error))
        while places.acquire(blocking=False):
            pass
        here.node.set_parameters([Parameter("scene_to_map.translation", value=[0.02, 0.0, 0.0])])
        wait_until(lambda: tries, "the node to find that too many requests are at work")
        here.node.trigger_deactivate()
        places.release(services.AT_WORK + services.WAITING)
        wait_until(lambda: "placement" not in {thread.name for thread in threading.enumerate()}, "it to give up")
        here.node.trigger_activate()
        ros.wait_until(lambda: len(clouds) > 1, "the cloud from where the scene lies now")
        assert clouds[-1].data == here.done("segment", publish_nothing=True).cloud.data != clouds[0].data


def segment(here: NodeHere) -> None:
    here.done("segment")


def learn(here: NodeHere, learner: str = "votes") -> None:
    ended: list[str] = []
    goal = SimpleNamespace(
        request=Learn.Goal(learner=learner), is_active=True, is_cancel_requested=False,
        publish_feedback=lambda message: None, succeed=lambda: ended.append("succeeded"), abort=lambda: None,
    )  # fmt: skip
    here.node._learn._execute(goal)
    assert ended == ["succeeded"]


@pytest.mark.parametrize("work", [segment, learn])
def test_views_that_come_while_a_run_works_are_in_the_objects_in_the_end(
    ros: Ros, parameters: dict[str, Any], monkeypatch: pytest.MonkeyPatch, work: Any
) -> None:
    monkeypatch.setattr(live_outputs, "OBJECTS_PERIOD", 0.0)
    arrays, boxed, came = ros.collect(ObjectArray, "/gsseg/objects", LATCHED), Selection.objects, []

    def objects(selection: Selection, header: Any, revision: int) -> ObjectArray:
        if revision and not came:
            came.append(here.fuse(clean_views(4, turn=0.5)))
        return boxed(selection, header, revision)

    with node_here(ros, parameters) as here:
        wait_until(lambda: here.outputs.wants_objects, "somebody who listens")
        here.fuse(clean_views(2))
        monkeypatch.setattr(Selection, "objects", objects)
        work(here)
        here.inputs.live.tick()
        ros.wait_until(lambda: arrays and arrays[-1].revision == 0, "objects of all views")
    assert [array.revision > 0 for array in arrays][-2:] == [True, False]


def test_topics_of_two_cameras_can_be_exchanged_by_remapping(ros: Ros, parameters: dict[str, Any]) -> None:
    values = {**parameters, "cameras": list(SIDES), "detections_topic": "found", "ids": "given"}
    rules = [f"{one}/{name}:={two}/{name}" for name in ("image", "found") for one, two in (SIDES, SIDES[::-1])]
    with node_here(ros, values, rules) as here:
        inputs = here.inputs
        for images, detections, other in zip(inputs._images, inputs.detections, SIDES[::-1], strict=True):
            images._listen(True)
            assert images._subscription is not None
            heard = [images._subscription, detections._listen(PointCloud2, lambda topic, message: None)]
            assert [one._subscription.topic_name for one in heard] == [f"/{other}/image", f"/{other}/found"]


def test_each_of_two_exchanged_topics_is_heard_as_its_own_publisher_offers(
    ros: Ros, parameters: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    values = {**parameters, "cameras": list(SIDES), "detections_topic": "found", "ids": "given"}
    rules = [f"{one}/{name}:={two}/{name}" for name in ("pose", "found") for one, two in (SIDES, SIDES[::-1])]
    monkeypatch.setitem(ADAPTERS, "nav_msgs/msg/Odometry", Adapter("nav_msgs", "Odometry", False, named_mask))
    ros.node.create_publisher(Odometry, "/left/found", 1)
    for side, reliability in zip(SIDES, (ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT), strict=True):
        ros.node.create_publisher(PoseStamped, f"/{side}/pose", QoSProfile(depth=1, reliability=reliability))
    with node_here(ros, values, rules) as here:

        def heard() -> list[str]:
            here.inputs._expire()
            return [here.inputs.policies[f"/{side}/pose"] for side in SIDES]

        wait_until(lambda: heard() == ["reliable, volatile", "best effort, volatile"], "each as it is offered")
        wait_until(lambda: [one.adapter is None for one in here.inputs.detections] == [True, False], "the detections")


def test_a_node_that_is_asked_again_and_again_what_it_cannot_answer_yet_says_so_once_in_its_log(
    ros: Ros, parameters: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    lines: list[str] = []
    with node_here(ros, parameters) as here:
        monkeypatch.setattr(here.node._complaints, "_warn", lines.append)
        monkeypatch.setattr(here.node._complaints, "_now", lambda: 100.0)
        for said in ("no view has been fused", "the node is not active"):
            answers = {here.ask(service).error_msg for service in ("segment", "save_state", "segment", "segment")}
            assert any(answer.startswith(said) for answer in answers)
            rejected = here.node._learn._welcome(Learn.Goal()) == GoalResponse.REJECT
            assert (len(lines), lines[-1].startswith(said), rejected) == (1, True, not here.node.workspace.active)
            lines.clear()
            here.node.stop()


def test_an_odometry_of_two_cameras_is_counted_once(ros: Ros, parameters: dict[str, Any]) -> None:
    values = {**parameters, "cameras": list(SIDES), "pose_source": "odometry"}
    with node_here(ros, values, [f"{side}/odometry:=odom" for side in SIDES]) as here:
        heard = [one for one in here.inputs._subscriptions if one.topic_name == "/odom"]
        for _ in range(3):
            for one in heard:
                one._callback(Odometry())
        assert (len(heard), here.inputs.arrivals["/odom"][0]) == (2, 3)


@pytest.mark.parametrize(("topic", "rectified"), [("/cam/image_rect/mask", True), ("/cam/image/mask", False)])
def test_what_is_picked_in_is_rectified_where_the_topics_of_the_cameras_say_so(
    ros: Ros, parameters: dict[str, Any], monkeypatch: pytest.MonkeyPatch, topic: str, rectified: bool
) -> None:
    found: list[bool] = []
    monkeypatch.setattr(services, "pick_object", lambda *_, rectified: found.append(rectified))
    with node_here(ros, {**parameters, "cameras": list(SIDES)}, [f"{side}/mask:={topic}" for side in SIDES]) as here:
        here.ask("pick")
    assert found == [rectified]


def test_ids_that_a_tracker_gave_anew_are_said_once_in_the_log_and_in_diagnostics_until_they_are_forgotten(
    ros: Ros, parameters: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    lines: list[str] = []
    with node_here(ros, {key: value for key, value in parameters.items() if key != "class_names"}) as here:
        monkeypatch.setattr(here.node, "get_logger", lambda: SimpleNamespace(warning=lines.append, info=str))

        def verdict() -> str:
            status = diagnostics.diagnostic_array(
                "gsseg", here.node.workspace, here.inputs, here.node._sim_time.stamp()
            )
            return str(status.status[0].message)

        here.fuse(lost_half_way(clean_views(12)))
        learn(here)
        assert (lines, verdict()) == ([], "fusing")
        learn(here, "em")
        learn(here, "em")
        (line,) = lines
        assert verdict() == line
        assert line.startswith("other views use another id for ") and "and no mask shows both: class_" in line
        assert line.endswith("The parameter ids set to per-view finds objects whatever their ids are, and label_map "
                             "merges names")  # fmt: skip
        here.node.trigger_deactivate()
        here.node.trigger_activate()
        assert verdict() == line
        here.done("reset")
        assert verdict() == "fusing"
    assert lines == [line]


def test_an_export_that_would_replace_the_nodes_own_scene_is_refused_before_the_work(
    ros: Ros, parameters: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    with node_here(ros, parameters) as here:
        here.fuse(clean_views(2))
        _, file, *_ = here.done("export", directory="exported").files
        here.done("load_scene", path=f"exported/{file}")
        here.fuse(clean_views(2))
        monkeypatch.setattr(here.node._requests, "_select", lambda *_: pytest.fail("it begins to work"))
        answer = here.ask("export", directory="exported")
        assert answer.error_code == answer.PATH_TAKEN and f"{file}: is read by gsseg segment" in answer.error_msg
