"""A robot for the tests of the segmentation node: it publishes posed masks, asks the node, and reads what it says."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from gsseg_msgs.action import Learn
from gsseg_msgs.srv import (
    Export,
    LoadScene,
    LoadState,
    MergeStates,
    Pick,
    RenderView,
    Reset,
    SaveState,
    Segment,
    UpdateScene,
)
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from nav_msgs.msg import Odometry
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters
from rclpy.action import ActionClient
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from ros_helpers import PATIENCE, Process, Ros
from sensor_msgs.msg import CameraInfo, Image
from small_scenes import NAMES
from std_msgs.msg import Header

from gsseg_core.data.view import View
from gsseg_core.live.session import LiveSession
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import Segmentation
from gsseg_ros.conversions import camera_info, mask_image, pose_from_matrix, stamp_message
from gsseg_ros.frames import Similarity

KINDS = {"mask": Image, "camera_info": CameraInfo, "pose": PoseStamped, "odometry": Odometry, "image": Image}
SERVICES = {
    "segment": Segment, "pick": Pick, "render_view": RenderView, "load_scene": LoadScene, "save_state": SaveState,
    "load_state": LoadState, "export": Export, "reset": Reset, "change_state": ChangeState,
    "describe_parameters": DescribeParameters, "get_parameters": GetParameters, "list_parameters": ListParameters,
    "update_scene": UpdateScene, "merge_states": MergeStates, "set_parameters": SetParameters, "get_state": GetState,
}  # fmt: skip
GREETING_SECONDS = 2.0
"""Until a node that has not answered its first question is asked again."""
RELIABLE = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
CLASSES = list(NAMES.values())
IDENTITY = Similarity()
SECOND = 1_000_000_000
STEP = SECOND // 10
"""Nanoseconds from one mask to the next."""


@dataclass
class Goal:
    """A goal of `~/learn` that was accepted."""

    handle: Any
    future: Any
    feedback: list[Any] = field(default_factory=list)

    @property
    def stages(self) -> list[str]:
        """Stages in the order in which feedback named them."""
        return list(dict.fromkeys(message.stage for message in self.feedback))


class Robot:
    """Publishes for one node and calls it.

    Parameters
    ----------
    ros : Ros
        Where.
    namespace : str
        Of the node and of its inputs; "" or "/somewhere".
    """

    def __init__(self, ros: Ros, namespace: str = "") -> None:
        self.ros, self.namespace, self.name = ros, namespace, f"{namespace}/gsseg"
        self.publishers = {
            topic: ros.node.create_publisher(kind, f"{namespace}/{topic}", RELIABLE) for topic, kind in KINDS.items()
        }
        # The question for the state comes last: a node that answers it has heard of all the others (see `_greet`).
        self.goals: list[Goal] = []
        self._learner = ActionClient(ros.node, Learn, f"{self.name}/learn", feedback_sub_qos_profile=RELIABLE)
        self._clients = {
            service: ros.node.create_client(kind, f"{self.name}/{service}") for service, kind in SERVICES.items()
        }
        self._greeted = False
        self.received_status = ros.collect(DiagnosticArray, "/diagnostics", RELIABLE)
        self.stamp = 1000 * SECOND
        self.process: Process | None = None

    # The node

    def start(self, parameters: dict[str, Any] | None = None, *arguments: str, lossless: bool = True) -> Process:
        """Start the node, without waiting for it; `lossless`: it hears all that is sent, however busy the machine."""
        overrides = {"reliability": "reliable", "depth": 1000} if lossless else {}
        qos = {
            f"qos_overrides.{self.namespace}/{topic}.subscription.{policy}": value
            for topic in KINDS
            for policy, value in overrides.items()
        }
        if self.namespace:
            arguments = ("-r", f"__ns:={self.namespace}", *arguments)
        self.process = self.ros.start("segment_node", {**(parameters or {}), **qos}, *arguments)
        self._greeted = False
        return self.process

    def started(self, parameters: dict[str, Any] | None = None, *arguments: str, lossless: bool = True) -> Robot:
        """Start the node and wait until it is active and listens to this robot."""
        self.start(parameters, *arguments, lossless=lossless)
        self.wait_active()
        return self

    def wait_active(self) -> None:
        """Wait until the node is active and its inputs are connected."""
        assert self.process is not None
        self.process.wait_for("active: listening", timeout=PATIENCE)  # Compiles its kernels after an installation.
        self.ros.wait_until(lambda: all(map(self._heard, ("mask", "camera_info"))), "the node's subscriptions")
        self.ros.wait_until(lambda: any(map(self._heard, ("pose", "odometry"))), "the node's subscription to poses")
        self.wait_for_state("active")

    def _heard(self, topic: str) -> bool:
        return self.publishers[topic].get_subscription_count() > 0

    def change(self, transition: str) -> bool:
        """Ask for a lifecycle transition, such as "configure"; returns whether it succeeded."""
        number = getattr(Transition, f"TRANSITION_{transition.upper()}")
        return bool(self.ask("change_state", transition=Transition(id=number)).success)

    @property
    def state(self) -> str:
        """Lifecycle state."""
        return str(self.ask("get_state").current_state.label)

    def wait_for_state(self, state: str) -> None:
        """Wait for the end of a transition that the node takes by itself: it says how that ends before it has ended."""
        self.ros.wait_until(lambda: self.state == state, f"the state {state}")

    def brought_to(self, state: str) -> Robot:
        """Take the steps from unconfigured to another state."""
        for transition in {"unconfigured": (), "inactive": ("configure",), "active": ("configure", "activate")}[state]:
            assert self.change(transition)
        assert self.state == state
        if state == "active":
            self.wait_active()
        return self

    def brought_down(self) -> Robot:
        """Take the steps from whichever state to unconfigured."""
        while self.state != "unconfigured":
            assert self.change({"active": "deactivate", "inactive": "cleanup"}[self.state])
        return self

    def shutdown(self) -> bool:
        """Ask for the shutdown that belongs to the lifecycle state."""
        return self.change(f"{self.state}_shutdown")

    # Requests

    def ask(self, service: str, **fields: Any) -> Any:
        """Call a service of the node and return the response."""
        return self.ros.result(self.send(service, **fields), f"the answer of {service}")

    def send(self, service: str, **fields: Any) -> Any:
        """Call a service of the node and return the future."""
        client = self._clients[service]
        self.ros.wait_until(client.service_is_ready, f"service {service}")
        self._greet()
        return client.call_async(SERVICES[service].Request(**fields))

    def _greet(self) -> None:
        """Ask a new node for its state until it answers.

        An answer is lost where the node has not yet heard of the one who asks, though its service is seen; and what
        the asker has made is heard of in the order in which it was made.
        """
        if self._greeted:
            return
        client, asked = self._clients["get_state"], []
        asked_at = -GREETING_SECONDS

        def answered() -> bool:
            nonlocal asked_at
            if client.service_is_ready() and time.monotonic() - asked_at >= GREETING_SECONDS:
                asked.append(client.call_async(GetState.Request()))
                asked_at = time.monotonic()
            return any(question.done() for question in asked)

        self.ros.wait_until(answered, "a first answer of the node", timeout=PATIENCE)
        self._greeted = True

    def done(self, service: str, **fields: Any) -> Any:
        """Call a service, which must work."""
        response = self.ask(service, **fields)
        assert response.error_code == 0, response.error_msg
        return response

    def goal(self, **fields: Any) -> Goal:
        """Send a goal of `~/learn`, which is accepted."""
        goal = self.offered(**fields)
        assert goal is not None, "the goal was rejected"
        return goal

    def offered(self, **fields: Any) -> Goal | None:
        """Send a goal of `~/learn`; returns None if it is rejected."""
        self.ros.wait_until(self._learner.server_is_ready, "the action")
        self._greet()
        feedback: list[Any] = []
        learner, goal = self._learner, Learn.Goal(**fields)
        sent = self.ros.run(lambda: learner.send_goal_async(goal, lambda message: feedback.append(message.feedback)))
        handle = self.ros.result(sent, "the answer to the goal")
        if not handle.accepted:
            return None
        self.goals.append(Goal(handle, self.ros.run(handle.get_result_async), feedback))
        return self.goals[-1]

    def outcome(self, goal: Goal) -> tuple[int, Any]:
        """Wait for the end of a goal; returns status and result."""
        answer = self.ros.result(goal.future, "the result", PATIENCE)
        return answer.status, answer.result

    def learn(self, **fields: Any) -> tuple[int, Any]:
        """Send a goal and wait for its end; returns status and result."""
        return self.outcome(self.goal(**fields))

    def begin(self, stage: str = "", **fields: Any) -> Goal:
        """Send a goal and wait until it works, at the stage if one is given."""
        goal = self.goal(**fields)
        self.ros.wait_until(lambda: stage in goal.stages if stage else goal.feedback, f"feedback {stage}")
        return goal

    def cancel(self, goal: Goal) -> tuple[int, Any]:
        """Cancel a goal and wait for its end; returns status and result."""
        answer = self.ros.result(self.ros.run(goal.handle.cancel_goal_async), "the answer to the cancel")
        assert len(answer.goals_canceling) == 1
        return self.outcome(goal)

    def exported(self, folder: Path, **fields: Any) -> Segmentation:
        """Export to a folder and read the segmentation back."""
        response = self.done("export", directory=str(folder), **fields)
        return Segmentation.load(folder / "segmentation.npz", GaussianScene.load(response.report.scene_path))

    def out(self, name: str) -> Path:
        """A folder below data_root to export to."""
        return Path(self.get("data_root")) / "out" / name

    # Parameters

    def set(self, name: str, value: Any) -> tuple[bool, str]:
        """Set a parameter; returns whether it was taken, and why not."""
        (result,) = self.ask("set_parameters", parameters=[Parameter(name, value=value).to_parameter_msg()]).results
        return bool(result.successful), str(result.reason)

    def get(self, name: str) -> Any:
        """Value of a parameter; rclpy has none for an empty list, which has no type."""
        values = self.ask("get_parameters", names=[name]).values
        return parameter_value_to_python(values[0]) if values else []

    # Views

    def next_stamp(self) -> int:
        """A stamp later than all before."""
        self.stamp += STEP
        return self.stamp

    def publish(self, messages: dict[str, Any]) -> None:
        """Publish messages by topic, the mask last."""
        for topic in sorted(messages, key=lambda topic: topic == "mask"):
            self.publishers[topic].publish(messages[topic])

    def drive(self, views: Iterable[View], similarity: Similarity = IDENTITY) -> list[int]:
        """Publish some views; returns their stamps."""
        stamps = []
        for view in views:
            stamps.append(self.next_stamp())
            self.publish(messages(view, stamps[-1], similarity))
        return stamps

    def fuse(self, views: Iterable[View]) -> None:
        """Publish some views, and wait until as many more are fused; nothing must have been learnt yet."""
        views = list(views)
        response = self.ask("segment")
        before = response.report.num_views if response.error_code == 0 else 0
        self.drive(views)
        self.ros.wait_until(
            lambda: self.ask("segment").report.num_views == before + len(views), f"{len(views)} views to be fused"
        )

    # What the node says by itself

    def latched(self, *topics: tuple[Any, str]) -> list[Any]:
        """What somebody gets who subscribes only now, of each topic (type and name below the node's)."""
        heard: list[list[Any]] = [[] for _ in topics]
        subscriptions = [
            self.ros.node.create_subscription(kind, f"{self.name}/{topic}", messages.append, LATCHED)
            for (kind, topic), messages in zip(topics, heard, strict=True)
        ]
        try:
            self.ros.wait_until(lambda: all(heard), f"the latched messages of {[topic for _, topic in topics]}")
        finally:
            for subscription in subscriptions:
                self.ros.node.destroy_subscription(subscription)
        return [messages[-1] for messages in heard]

    def status(self) -> dict[str, str]:
        """What `/diagnostics` said last of this node; empty before the first time."""
        for array in reversed(self.received_status):
            for status in array.status:
                if status.name == self.name:
                    return {value.key: value.value for value in status.values} | {"message": status.message}
        return {}

    def wait_for_status(self, condition: Callable[[dict[str, str]], Any], what: str) -> dict[str, str]:
        """Wait until `/diagnostics` says something; returns all that it says then."""
        last: dict[str, str] = {}

        def holds() -> bool:
            nonlocal last
            last = self.status()
            return bool(last and condition(last))

        try:
            self.ros.wait_until(holds, what)
        except pytest.fail.Exception as failure:
            pytest.fail(f"{failure}\nlast status: {json.dumps(last, indent=1)}")
        return last


def messages(view: View, stamp: int, similarity: Similarity = IDENTITY) -> dict[str, Any]:
    """Mask, camera_info and pose of a view."""
    header = Header(stamp=stamp_message(stamp), frame_id="camera")
    in_map = Header(stamp=header.stamp, frame_id="map")
    return {
        "mask": mask_image(view.read_labels(), header, 8),
        "camera_info": camera_info(view.camera, header),
        "pose": PoseStamped(
            header=in_map, pose=pose_from_matrix(similarity.camera_in_map(view.camera.world_to_camera))
        ),
    }


def viewpoint(view: View) -> dict[str, Any]:
    """Fields of a request that asks for the viewpoint of a view."""
    sent = messages(view, 7 * SECOND)
    return {"viewpoint_pose": sent["pose"], "viewpoint_camera": sent["camera_info"]}


def core_session(scene: GaussianScene, views: Iterable[View], names: Iterable[str] = CLASSES) -> LiveSession:
    """What the node has to come to, by the core alone."""
    session = LiveSession(scene, dict(enumerate(names)))
    for view in views:
        assert session.fuse(view) is None
    return session


def renamed(views: Iterable[View]) -> list[View]:
    """The same views, each under a name of its own."""
    return [replace(view, camera=replace(view.camera, name=str(i))) for i, view in enumerate(views)]


def assert_same(found: Segmentation, expected: Segmentation) -> None:
    """Same labels, and the same codes but for what a pose loses on its way through a quaternion."""
    np.testing.assert_array_equal(found.labels, expected.labels)
    np.testing.assert_allclose(found.probabilities, expected.probabilities, atol=1e-4)
    assert found.class_names == expected.class_names
