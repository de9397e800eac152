"""Subscribes to masks, camera_infos and poses, pairs them by stamp and camera, and fuses them in a thread."""

from __future__ import annotations

import secrets
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.lifecycle import LifecycleNode
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from gsseg_core.data.view import View
from gsseg_core.errors import GssegError, PoseError
from gsseg_core.live.results import SCENE_CHANGED, Rejection
from gsseg_ros.camera_infos import camera_of_image, is_rectified
from gsseg_ros.conversions import matrix_from_pose, stamp_ns
from gsseg_ros.errors import NoSceneError, TooManyPixelsError
from gsseg_ros.node.camera_images import CameraImages
from gsseg_ros.node.complaints import LIVE, PERIOD, REFUSED_POSE, Complaints
from gsseg_ros.node.jobs import Worker
from gsseg_ros.node.live_outputs import LiveOutputs
from gsseg_ros.node.masks.compressed import compressed_topic
from gsseg_ros.node.masks.reader import MaskReader
from gsseg_ros.node.outputs import Outputs
from gsseg_ros.node.pairing import ExactPoses, InterpolatedPoses, Paired, Pairing, PoseSource
from gsseg_ros.node.sim_time import on_set_back
from gsseg_ros.node.tf_poses import TfPoses
from gsseg_ros.node.workspace import Workspace
from gsseg_ros.qos import clear_overrides, sensor_data

EXPIRE_PERIOD = 0.1  # s


class Inputs:
    """Subscribes from activation to deactivation. Callbacks only put messages aside; a worker fuses them.

    Attributes
    ----------
    arrivals : dict of str to (int, float)
        By full name of the topic: messages so far, and when the last one came (s, `time.monotonic`).
    roles : dict of str to str
        By full name of the topic: what it is, such as "mask".
    accepted : int
        Views that were fused.
    rejected : Counter of str
        Masks that were not, by reason; "scene_changed" are those that came before the scene was loaded, reset or
        replaced by a saved state, and had not been fused by then.
    explained : dict of str to str
        By reason: what was wrong with the last of these.
    counted : deque of (float, Counter)
        What `gsseg_ros.node.diagnostics` counted lately, and when (s, `time.monotonic`).
    logged : Counter of str
        How many of these it has named in the log.
    refused_poses : int
        Poses that could not be used.
    last_refusal : (float, str)
        When the last of these came (s, `time.monotonic`), and what was wrong with it.
    policies : dict of str to str
        By full name of the topic: quality of service of the subscription, overrides included.
    """

    def __init__(self, node: LifecycleNode, workspace: Workspace, outputs: Outputs, complaints: Complaints) -> None:
        self._node, self._workspace, self._complaints = node, workspace, complaints
        self.accepted = 0
        self.rejected: Counter[str] = Counter()
        self.explained: dict[str, str] = {}
        self._counting = threading.Lock()
        self.refused_poses = 0
        self.last_refusal = (-PERIOD, "")
        self.arrivals: dict[str, tuple[int, float]] = {}
        self.roles: dict[str, str] = {}
        self.policies: dict[str, str] = {}
        self.started = time.monotonic()
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
        node, workspace = self._node, self._workspace
        settings = workspace.settings
        self.tf = TfPoses(node, settings.map_frame) if settings.pose_source == "tf" else None
        poses: PoseSource = self.tf or (InterpolatedPoses() if settings.pose_source == "odometry" else ExactPoses())
        if self.tf is not None:
            built.callback(self.tf.close)
        # A simulator's stamps repeat, and views of an earlier activation may come back with a saved state.
        self.pairing = Pairing(poses, prefix=f"{secrets.token_hex(4)}_")
        self.worker: Worker[Paired] = Worker(self._fuse, settings.queue_size)
        built.callback(self.worker.stop)
        self.live = LiveOutputs(
            workspace,
            outputs,
            lambda: self.worker.waiting > 0,
            lambda: node.get_clock().now().to_msg(),
            lambda _, message: self._complaints.add(LIVE, message),
        )
        built.callback(self.live.close)
        compressed = settings.image_transport == "compressed"
        self._images = CameraImages(
            node, outputs, self.live, self.tf or type(poses)(), self._group, compressed=compressed
        )
        built.callback(self._images.close)
        self._masks = MaskReader(settings)
        wanted: list[tuple[Any, str, Callable[[str, Any], None]]] = [
            (CompressedImage if settings.mask_transport == "compressed" else Image, "mask", self._on_mask),
            (CameraInfo, "camera_info", self._on_camera_info),
        ]
        if settings.pose_source == "topic":
            wanted.append((PoseStamped, "pose", self._on_pose))
        elif settings.pose_source == "odometry":
            wanted.append((Odometry, "odometry", self._on_odometry))
        for kind, topic, callback in wanted:
            built.callback(node.destroy_subscription, self._listen(kind, topic, callback))
        # Not by /clock, which may stand still.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        timer = node.create_timer(EXPIRE_PERIOD, self._expire, callback_group=self._group, clock=steady)
        built.callback(node.destroy_timer, timer)
        built.callback(on_set_back(node, self._set_back).unregister)
        workspace.forget_waiting = self._forget_waiting
        built.callback(setattr, workspace, "forget_waiting", lambda: None)

    def close(self) -> None:
        """Stop listening; a mask that is being fused is finished."""
        self._built.close()

    def publishers_of(self, topic: str) -> int:
        """Count the publishers of an input."""
        return int(self._node.count_publishers(topic))

    def _listen(self, kind: Any, role: str, callback: Callable[[str, Any], None]) -> Any:
        topic = compressed_topic(self._node, role) if kind is CompressedImage else role
        subscription: Any = None

        def arrived(message: Any) -> None:
            name = subscription.topic_name
            self.arrivals[name] = (self.arrivals[name][0] + 1, time.monotonic())
            callback(name, message)
            self._hand_over()

        quality = sensor_data()
        with clear_overrides(topic):
            subscription = self._node.create_subscription(
                kind,
                topic,
                arrived,
                quality,
                callback_group=self._group,
                qos_overriding_options=QoSOverridingOptions.with_default_policies(),
            )
        self.arrivals[subscription.topic_name] = (0, self.started)
        self.roles[subscription.topic_name] = role
        policies = f"{quality.reliability.short_key}, {quality.durability.short_key}"
        self.policies[subscription.topic_name] = policies.replace("_", " ")
        return subscription

    def _on_mask(self, topic: str, message: Any) -> None:
        stamp, era = stamp_ns(message.header.stamp), self._workspace.era
        self.pairing.add_mask(stamp, (topic, message), message.header.frame_id, era)

    def _on_camera_info(self, topic: str, message: CameraInfo) -> None:
        for pairing in (self.pairing, self._images.pairing):
            pairing.add_camera_info(stamp_ns(message.header.stamp), (topic, message), message.header.frame_id)

    def _on_pose(self, topic: str, message: PoseStamped) -> None:
        self._add_pose(topic, message.header, message.pose)

    def _on_odometry(self, topic: str, message: Odometry) -> None:
        self._add_pose(topic, message.header, message.pose.pose)

    def _add_pose(self, topic: str, header: Any, pose: Any) -> None:
        map_frame = self._workspace.settings.map_frame
        try:
            if header.frame_id not in ("", map_frame):
                raise PoseError(
                    f"{topic}: frame_id is '{header.frame_id}'; expected '{map_frame}', the parameter map_frame"
                )
            matrix = matrix_from_pose(pose, topic)
        except PoseError as error:
            self.refused_poses += 1
            self.last_refusal = (time.monotonic(), str(error))
            self._complaints.add(REFUSED_POSE, str(error))
            return
        for pairing in (self.pairing, self._images.pairing):
            pairing.add_pose(stamp_ns(header.stamp), matrix)

    def _set_back(self, stamp: int) -> None:
        for pairing in (self.pairing, self._images.pairing):
            pairing.set_back(stamp)
        if self.tf is not None:  # It may hold what the pairings, without a mask, have not asked for.
            self.tf.clear()
        self._hand_over()

    def _expire(self) -> None:
        self.pairing.expire(time.monotonic())
        self._hand_over()
        self._images.tick()
        self.live.tick()

    def _hand_over(self) -> None:
        for paired in self.pairing.take():
            self.worker.submit(paired)
        dropped = Counter(self.pairing.dropped)
        dropped["queue_full"] = self.worker.dropped
        self._workspace.dropped.update(dropped - self._told)
        self._told = dropped

    def _forget_waiting(self) -> None:
        """Drop the masks that wait; the session knows those on their way to it by their era."""
        self._count_rejected(SCENE_CHANGED, self.pairing.clear() + self.worker.clear())

    def _count_rejected(self, reason: str, count: int = 1) -> None:
        with self._counting:
            self.rejected[reason] += count

    def _fuse(self, paired: Paired) -> None:
        try:
            rejection = self._fused(paired)
        except NoSceneError as error:
            rejection = Rejection("no_scene", str(error))
        except TooManyPixelsError as error:
            rejection = self._workspace.session.reject(Rejection("too_large", str(error)))
        except GssegError as error:
            rejection = self._workspace.session.reject(Rejection.of(error))
        except Exception as error:
            self._node.get_logger().error(f"mask {paired.name}: unexpected {type(error).__name__}: {error}")
            rejection = Rejection("unexpected", str(error))
        if rejection is None:
            self.accepted += 1
            return
        self._count_rejected(rejection.reason)
        self.explained[rejection.reason] = rejection.message
        self._complaints.add(rejection.reason, f"a view was rejected ({rejection.reason}): {rejection.message}")

    def _fused(self, paired: Paired) -> Rejection | None:
        workspace = self._workspace
        if paired.era is not workspace.era:
            return Rejection(SCENE_CHANGED, f"mask {paired.name} came before the scene was loaded or reset")
        session = workspace.session
        (topic, mask), (info_topic, info) = paired.mask, paired.camera_info
        seen = self._masks.read(mask, topic)
        settings, pose = workspace.settings, paired.pose
        if settings.pose_source == "odometry":
            pose = pose @ settings.camera_in_base
        size, rectified = seen.labels.shape[::-1], is_rectified(settings.rectified, topic, info_topic)
        pose = settings.scene_to_map.world_to_camera(pose)
        camera = camera_of_image(paired.name, info, size, pose, topic, info_topic, rectified=rectified)
        if size != (info.width, info.height):
            self._say_once(
                f"{topic}: masks are {size[0]} x {size[1]} pixels, {info_topic} says {info.width} x "
                f"{info.height}: its intrinsics are scaled"
            )
        if camera.undistortion is not None:
            self._say_once(
                f"{info_topic}: the lens is distorted ({info.distortion_model}): masks are undistorted; if they are of "
                "rectified images, set the parameter rectified to true"
            )
            seen = seen.undistorted(camera.undistortion)
        rejection = session.fuse(View.from_seen(camera, seen), paired.era)
        if rejection is None:
            self.live.fused(paired, camera)
        return rejection

    def _say_once(self, message: str) -> None:
        if message not in self._said:
            self._said.add(message)
            self._node.get_logger().info(message)
