"""The inputs of one camera: its masks, paired with camera_info, pose and depth, and its pictures for the overlay."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from gsseg_core.errors import PoseError
from gsseg_core.scene.camera import Camera
from gsseg_ros.camera_infos import camera_of_image, is_rectified
from gsseg_ros.conversions import matrix_from_pose, stamp_ns
from gsseg_ros.node.masks.detections import Detected
from gsseg_ros.node.pairing import Paired, Pairing, PairingSettings
from gsseg_ros.node.parameters import Settings
from gsseg_ros.node.pose_sources import GivenPose, InterpolatedPoses, MessagePoses, PoseFrames, PoseSource, TfFirst
from gsseg_ros.node.tf_poses import TfPoses


class Listen(Protocol):
    """A function that subscribes to a topic."""

    def __call__(
        self, kind: Any, role: str, topic: str, callback: Callable[[str, Any], None], required: bool = True
    ) -> object:
        """Subscribe with the type, role and name of a topic, what takes in its messages, and whether it has to come."""


def mask_class(settings: Settings) -> Any:
    """Class of the messages that masks come in."""
    return CompressedImage if settings.mask_transport == "compressed" else Image


def camera_of(paired: Paired, size: tuple[int, int], settings: Settings) -> Camera:
    """Make the scene's camera of a mask or picture of some size (width, height); raises as `camera_of_image` does."""
    (topic, _), (info_topic, info) = paired.mask, paired.camera_info
    pose = settings.scene_to_map.world_to_camera(paired.pose)
    rectified = is_rectified(settings.rectified, topic, info_topic)
    return camera_of_image(paired.name, info, size, pose, topic, info_topic, rectified=rectified)


class CameraStreams:
    """Subscribes to the topics of one camera, and pairs what comes. Messages are only put aside.

    Names of topics begin with its own, as "front" for `front/mask`; that of the only camera is empty. Views are
    named by the `activation`, too; `era` tells the workspace's, and `refuse_pose` is told what is wrong with a pose.
    """

    def __init__(
        self,
        name: str,
        settings: Settings,
        tf: TfPoses | None,
        *,
        activation: str,
        listen: Listen,
        refuse_pose: Callable[[str], None],
        era: Callable[[], object],
    ) -> None:
        self.name, self.accepted = name, 0  # views that were fused
        self._settings, self._tf, self._refuse_pose, self._era = settings, tf, refuse_pose, era
        source = settings.pose_source
        in_base = settings.camera_in_base if source == "odometry" else None
        if tf is not None and in_base is not None and np.array_equal(in_base, np.eye(4)):
            in_base = None  # It was not given, and TF knows it.
        self._frames = PoseFrames(settings.map_frame, tf, in_base)
        self.pairing = Pairing(self.poses(), PairingSettings(with_depth=settings.depth_gating), activation, name)
        self._pairings = [self.pairing]
        topics: list[tuple[Any, str, Callable[[str, Any], None]]] = [(CameraInfo, "camera_info", self.on_camera_info)]
        if settings.depth_gating:
            topics.append((Image, "depth", self.on_depth))
        if source == "odometry":
            topics.append((Odometry, "odometry", self.on_odometry))
        elif source != "tf":
            topics.append((PoseStamped, "pose", self.on_pose))
        if not settings.detections_topic:  # Last: who has found it, and begins to publish, has found the others, too.
            topics.append((mask_class(settings), "mask", self.on_mask))
        for kind, role, callback in topics:
            # What TF knows may be all that there is.
            listen(kind, role, self.topic(role), callback, required=not (role == "pose" and source == "auto"))

    def topic(self, role: str) -> str:
        """Name of one of its topics."""
        return f"{self.name}/{role}" if self.name else role

    def poses(self) -> PoseSource:
        """Make a source of its poses; every pairing has one of its own."""
        settings, tf = self._settings, self._tf
        if settings.pose_source == "odometry":
            return InterpolatedPoses(frames=self._frames)
        if tf is not None and settings.pose_source == "tf":
            return tf
        if tf is not None and settings.pose_source == "auto":
            return TfFirst(tf, settings.pose_tolerance, self._frames)
        return MessagePoses(settings.pose_tolerance, self._frames)

    def share(self, pairing: Pairing) -> None:
        """Hand every camera_info and every pose to another pairing, too: that of its pictures."""
        self._pairings.append(pairing)

    def on_mask(self, topic: str, message: Image | CompressedImage | Detected) -> None:
        """Take in a mask, or what was detected in its place."""
        _, image = (message.mask or ("", None)) if isinstance(message, Detected) else ("", message)
        stamp, size = stamp_ns(message.header.stamp), 0 if image is None else len(image.data)
        self.pairing.add_mask(stamp, (topic, message), message.header.frame_id, self._era(), size)

    def on_camera_info(self, topic: str, message: CameraInfo) -> None:
        """Take in a camera_info."""
        for pairing in self._pairings:
            pairing.add_camera_info(stamp_ns(message.header.stamp), (topic, message), message.header.frame_id)

    def on_depth(self, topic: str, message: Image) -> None:
        """Take in a depth image."""
        self.pairing.add_depth(stamp_ns(message.header.stamp), (topic, message), message.header.frame_id)

    def on_pose(self, topic: str, message: PoseStamped) -> None:
        """Take in a pose of the camera."""
        self._add_pose(topic, message.header, message.pose)

    def on_odometry(self, topic: str, message: Odometry) -> None:
        """Take in a pose of what carries the camera."""
        self._add_pose(topic, message.header, message.pose.pose, message.child_frame_id)

    def set_back(self, stamp: int) -> None:
        """Take in that the clock was set back to `stamp` (ns)."""
        for pairing in self._pairings:
            pairing.set_back(stamp)

    def expire(self) -> None:
        """Pair or drop what has waited long enough; call it some ten times a second."""
        self.pairing.expire(time.monotonic())

    def _add_pose(self, topic: str, header: Any, pose: Any, child: str = "") -> None:
        try:
            if not self._frames.reaches_map(header.frame_id):
                map_frame = self._settings.map_frame
                raise PoseError(
                    f"{topic}: frame_id is '{header.frame_id}'; expected '{map_frame}', the parameter map_frame, or "
                    "TF to be usable here (tf2_ros cannot be imported)"
                )
            matrix = matrix_from_pose(pose, topic)
        except PoseError as error:
            self._refuse_pose(str(error))
            for pairing in self._pairings:
                pairing.refuse_pose(stamp_ns(header.stamp))
            return
        for pairing in self._pairings:
            pairing.add_pose(stamp_ns(header.stamp), GivenPose(matrix, header.frame_id, child))
