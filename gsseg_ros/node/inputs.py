"""Listens to the streams of all cameras, and fuses the masks that they pair, in a thread."""

from __future__ import annotations

import itertools
import secrets
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.lifecycle import LifecycleNode
from sensor_msgs.msg import CompressedImage

from gsseg_core.data.class_names import listed
from gsseg_core.data.soft_masks import SeenLabels
from gsseg_core.data.view import View
from gsseg_core.errors import GssegError
from gsseg_core.live.results import SCENE_CHANGED, Rejection
from gsseg_ros.camera_infos import image_size
from gsseg_ros.errors import DepthImageError, LabelInfoError, NoSceneError, TooManyPixelsError
from gsseg_ros.node.camera_images import CameraImages
from gsseg_ros.node.camera_streams import CameraStreams, camera_of, mask_class
from gsseg_ros.node.complaints import DETECTIONS_TYPE, LIVE, PERIOD, REFUSED_LABELS, REFUSED_POSE, Complaints
from gsseg_ros.node.depth_images import gate_by_image
from gsseg_ros.node.jobs import Worker
from gsseg_ros.node.live_outputs import LiveOutputs
from gsseg_ros.node.masks import label_info
from gsseg_ros.node.masks.compressed import compressed_topic
from gsseg_ros.node.masks.detections_input import DetectionsInput
from gsseg_ros.node.masks.reader import MaskReader
from gsseg_ros.node.matched_subscription import MatchedSubscription
from gsseg_ros.node.outputs import Outputs
from gsseg_ros.node.pairing import MOST_BYTES, Paired
from gsseg_ros.node.parameters import Settings
from gsseg_ros.node.sim_time import on_set_back, steady_timer
from gsseg_ros.node.tf_poses import TfPoses
from gsseg_ros.node.workspace import Workspace

EXPIRE_PERIOD = 0.1  # s
_MASKS = ("mask", "detections")  # Roles of what becomes views.
_REASONS = {TooManyPixelsError: "too_large", DepthImageError: "bad_depth"}  # Others are those of the core.

AWAITED_SECONDS, _PAUSE = 5.0, 0.02
"""How long, at most, masks are waited for that have come and are not yet fused."""


class Inputs:
    """Subscribes from activation to deactivation. Callbacks only put messages aside; a worker fuses them."""

    def __init__(self, node: LifecycleNode, workspace: Workspace, outputs: Outputs, complaints: Complaints) -> None:
        self._node, self._workspace, self._complaints = node, workspace, complaints
        self.accepted = 0  # views that were fused
        # Masks that were not, by reason; "scene_changed" are those that came before the scene was loaded, reset or
        # replaced by a saved state, and had not been fused by then.
        self.rejected: Counter[str] = Counter()
        self.explained: dict[str, str] = {}  # by reason: what was wrong with the last of these
        self._counting, self._handing = threading.Lock(), threading.Lock()
        # "views" that were held against depth images, and their pixels: "measured", and "contradicted" by what was.
        self.gated: Counter[str] = Counter()
        self.refused_poses = 0
        self.last_refusal = (-PERIOD, "")  # when (s, `time.monotonic`), and what was wrong
        # By full name of the topic: messages so far, and when the last one came (s, `time.monotonic`).
        self.arrivals: dict[str, tuple[int, float]] = {}
        self.roles: dict[str, str] = {}  # by full name of the topic: what it is; of those only that have to be there
        self._subscriptions: list[MatchedSubscription] = []
        self.started = time.monotonic()
        # For `gsseg_ros.node.diagnostics`: what it counted lately, and when (s); how many of these it has logged.
        self.counted: deque[tuple[float, Counter[str]]] = deque([(self.started, Counter())])
        self.logged: Counter[str] = Counter()
        self._told: Counter[str] = Counter()
        self._said: set[str] = set()
        self._group = MutuallyExclusiveCallbackGroup()
        with ExitStack() as built:
            self._build(outputs, built)
            self._built = built.pop_all()

    def _build(self, outputs: Outputs, built: ExitStack) -> None:
        """Begin to listen; the stack takes away what was made, at the end or where the next step fails."""
        node, workspace, settings = self._node, self._workspace, self._workspace.settings
        self.tf = self._tf_poses(settings, built)
        self.worker: Worker[Paired] = Worker(self._fuse, settings.queue_size, lambda paired: paired.size, MOST_BYTES)
        built.callback(self.worker.stop)
        self.live = LiveOutputs(
            workspace, outputs, lambda: self.worker.waiting > 0, lambda: node.get_clock().now().to_msg(),
            partial(self._complaints.add, LIVE),
        )  # fmt: skip
        built.callback(self.live.close)
        compressed = settings.image_transport == "compressed"
        self._masks = MaskReader(settings, workspace.label_space, self._say_once)
        self.cameras: dict[str, CameraStreams] = {}  # by name; "" if there is only one
        self.detections: list[DetectionsInput] = []
        self._images: list[CameraImages] = []
        if (kind := label_info.label_info_class()) is not None:  # It is not missed: names come once, if at all.
            self._listen(built, kind, label_info.TOPIC, label_info.TOPIC, self.on_label_info, False)
        # A simulator's stamps repeat, and views of an earlier activation may come back with a saved state.
        activation = secrets.token_hex(4)
        workspace.activations.add(activation)
        for name in settings.cameras or ("",):
            camera = CameraStreams(
                name, settings, self.tf, activation=activation, listen=partial(self._listen, built),
                refuse_pose=self._refuse_pose, era=lambda: workspace.era,
            )  # fmt: skip
            images = CameraImages(node, outputs, self.live, camera, self._group, compressed=compressed)
            built.callback(images.close)
            self.cameras[name] = camera
            self._images.append(images)
            if settings.detections_topic:
                self.detections.append(self._detections_of(camera, settings))
                built.callback(self.detections[-1].close)
        timer = steady_timer(node, EXPIRE_PERIOD, self._expire, self._group)
        built.callback(node.destroy_timer, timer)
        built.callback(on_set_back(node, self._set_back).unregister)
        workspace.forget_waiting = self._forget_waiting
        built.callback(setattr, workspace, "forget_waiting", lambda: None)

    def _tf_poses(self, settings: Settings, built: ExitStack) -> TfPoses | None:
        """Make what looks up TF, which listens if poses come from there; None without tf2_ros, if it can be missed."""
        poses = (TfPoses if settings.pose_source == "tf" else TfPoses.if_here)(self._node, settings.map_frame)
        if poses is not None:
            built.callback(poses.close)
            if settings.pose_source in ("tf", "auto"):
                poses.listen()
        elif settings.pose_source == "auto":
            said = "pose_source is auto, and tf2_ros cannot be imported: poses come from topics alone"
            self._node.get_logger().info(said)
        return poses

    def close(self) -> None:
        """Stop listening; a mask that is being fused is finished."""
        self._built.close()

    def await_fused(self, stamps: set[str]) -> None:
        """Wait until masks of these stamps (ns) that have come are fused or dropped, for some seconds at most."""
        latest = time.monotonic() + AWAITED_SECONDS
        while stamps & self._stamps_under_way() and self._workspace.active and time.monotonic() < latest:
            time.sleep(_PAUSE)

    def _stamps_under_way(self) -> set[str]:
        with self._handing:
            stamps = {paired.stamp for paired in self.worker.unfinished}
            return set(map(str, stamps.union(*(camera.pairing.stamps for camera in self.cameras.values()))))

    @property
    def policies(self) -> dict[str, str]:
        """By full name of the topic: quality of service of its subscription, overrides included."""
        return {subscription.topic_name: subscription.policies for subscription in self._subscriptions}

    @property
    def lost(self) -> dict[str, int]:
        """By full name of the topic: messages that did not arrive, as far as the middleware knows."""
        return {subscription.topic_name: subscription.lost for subscription in self._subscriptions}

    def publishers_of(self, topic: str) -> int:
        """Count the publishers of an input."""
        return int(self._node.count_publishers(topic))

    @property
    def namesakes(self) -> int:
        """Number of other nodes with this node's name: each works on its requests, whoever answers first."""
        return self.publishers_of("~/transition_event") - 1

    def _detections_of(self, camera: CameraStreams, settings: Settings) -> DetectionsInput:
        """Make the input of detections; their type, and so whether a mask belongs to them, turns out later."""
        name = camera.topic(settings.detections_topic)
        topic = self._node.resolve_topic_name(name)
        self.arrivals[topic], self.roles[topic] = (0, self.started), "detections"
        return DetectionsInput(
            self._node,
            name,
            lambda kind, take: self._listen(None, kind, "detections", name, take),
            lambda take: self._listen(None, mask_class(settings), "mask", camera.topic("mask"), take),
            camera.on_mask,
            self._lose,
        )

    def _lose(self, reason: str, message: str) -> None:
        """Count a mask that went on without what belongs to it."""
        self._count_rejected(reason)
        self.explained[reason] = message
        self._complaints.add(reason, message)

    def _listen(
        self,
        built: ExitStack | None,
        kind: Any,
        role: str,
        topic: str,
        callback: Callable[[str, Any], None],
        required: bool = True,
    ) -> MatchedSubscription:
        """Subscribe until the stack is closed; without one, the caller closes the subscription."""
        topic = compressed_topic(self._node, topic) if kind is CompressedImage else topic
        name, numbers = self._node.resolve_topic_name(topic), itertools.count(1)  # Cameras may share the topic.

        def arrived(message: Any) -> None:
            self.arrivals[name] = (next(numbers), time.monotonic())
            callback(name, message)
            self._hand_over()

        self.arrivals[name] = (0, self.started)  # Before: messages may come at once, in another thread.
        if required:
            self.roles[name] = role
        subscription = MatchedSubscription(self._node, kind, topic, arrived, self._group)
        self._subscriptions.append(subscription)
        if built is not None:
            built.callback(subscription.close)
        return subscription

    def on_label_info(self, topic: str, message: Any) -> None:
        """Take in names of labels."""
        try:
            names = label_info.names_of(message, topic)
        except LabelInfoError as error:
            self._complaints.add(REFUSED_LABELS, str(error))
            return
        if self._workspace.label_space.hear(names):
            self._node.get_logger().info(f"{topic}: labels are called {listed(names.values())}")

    def _refuse_pose(self, why: str) -> None:
        self.refused_poses += 1
        self.last_refusal = (time.monotonic(), why)
        self.explained["bad_pose"] = why
        self._complaints.add(REFUSED_POSE, why)

    def _set_back(self, before: int, began: int) -> None:
        for camera in self.cameras.values():
            camera.set_back(began)
        if self.tf is not None:  # It may hold what the pairings, without a mask, have not asked for.
            self.tf.set_back(before, began)
        if forgotten := sum(detections.clear() for detections in self.detections):
            self._count_rejected("time_jump", forgotten)
        self._hand_over()

    def _expire(self) -> None:
        for subscription in self._subscriptions:
            subscription.look()
        for camera in self.cameras.values():
            camera.expire()
        self._hand_over()
        for images in self._images:
            images.tick()
        for detections in self.detections:
            self._complaints.remind(DETECTIONS_TYPE, detections.look())
        self.live.tick()

    def _hand_over(self) -> None:
        with self._handing:  # Whoever asks finds a mask here or there.
            for camera in list(self.cameras.values()):  # Another thread may still be making some.
                for paired in camera.pairing.take():
                    self.worker.submit(paired)
            dropped = self.dropped
            self._workspace.dropped.update(dropped - self._told)
            self._told = dropped

    @property
    def dropped(self) -> Counter[str]:
        """Masks that were dropped before they came to be fused, or did not arrive, by reason."""
        dropped = sum((camera.pairing.dropped for camera in list(self.cameras.values())), Counter[str]())
        if self.worker.dropped:
            dropped["queue_full"] = self.worker.dropped
        if lost := sum(count for topic, count in self.lost.items() if self.roles.get(topic) in _MASKS):
            dropped["lost"] = lost
        return dropped

    def _forget_waiting(self) -> None:
        """Drop the masks that wait; the session knows those on their way to it by their era."""
        waiting = sum(detections.clear() for detections in self.detections)  # First: others may still become pairs.
        waiting += sum(camera.pairing.clear() for camera in self.cameras.values())
        self._count_rejected(SCENE_CHANGED, waiting + self.worker.clear())

    def _count_rejected(self, reason: str, count: int = 1) -> None:
        with self._counting:
            self.rejected[reason] += count

    def _fuse(self, paired: Paired) -> None:
        try:
            rejection = self._fused(paired)
        except NoSceneError as error:
            rejection = Rejection("no_scene", str(error))
        except GssegError as error:
            reason = _REASONS.get(type(error))
            rejection = self._workspace.session.reject(Rejection(reason, str(error)) if reason else Rejection.of(error))
        except Exception as error:
            self._node.get_logger().error(f"mask {paired.name}: unexpected {type(error).__name__}: {error}")
            rejection = Rejection("unexpected", str(error))
        if rejection is None:
            self.accepted += 1
            self.cameras[paired.stream].accepted += 1
            return
        self._count_rejected(rejection.reason)
        self.explained[rejection.reason] = rejection.message
        self._complaints.add(rejection.reason, f"a view was rejected ({rejection.reason}): {rejection.message}")

    def _fused(self, paired: Paired) -> Rejection | None:
        workspace = self._workspace
        if paired.era is not workspace.era:
            return Rejection(SCENE_CHANGED, f"mask {paired.name} came before the scene was loaded or reset")
        seen = self._masks.read(paired.mask[1], paired.mask[0], workspace.session, paired.camera_info[1])
        with workspace.placement.fusing:
            return self._fused_in_place(paired, seen)

    def _fused_in_place(self, paired: Paired, seen: SeenLabels) -> Rejection | None:
        (topic, _), (info_topic, info) = paired.mask, paired.camera_info
        size = seen.labels.shape[::-1]
        camera = camera_of(paired, size, self._workspace.settings)
        if size != (said := image_size(info, info_topic)):
            self._say_once(
                f"{topic}: masks are {size[0]} x {size[1]} pixels, {info_topic} says {said[0]} x {said[1]}: its "
                "intrinsics are scaled"
            )
        if camera.undistortion is not None:
            self._say_once(
                f"{info_topic}: the lens is distorted ({info.distortion_model}): masks are undistorted; if they are of "
                "rectified images, set the parameter rectified to true"
            )
            seen = seen.undistorted(camera.undistortion)
        view = View.from_seen(camera, seen)
        if paired.depth is not None:
            view = self._gated(view, paired)
        rejection = self._workspace.session.fuse(view, paired.era)
        if rejection is None:
            self.live.fused(paired, camera)
        return rejection

    def _gated(self, view: View, paired: Paired) -> View:
        """Make those pixels of a view unknown that its depth image contradicts, and count them."""
        (topic, depth), settings = paired.depth, self._workspace.settings
        frame_id = paired.mask[1].header.frame_id
        gated = gate_by_image(self._workspace.session, view, depth, topic, frame_id, settings)
        self.gated["views"] += 1
        self.gated["measured"] += int(gated.measured.sum())
        self.gated["contradicted"] += int(gated.contradicted.sum())
        return gated.view

    def _say_once(self, message: str) -> None:
        if message not in self._said:
            self._said.add(message)
            self._node.get_logger().info(message)
