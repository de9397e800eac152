"""Where the scene lies in the map, as messages have it: a static transform that goes out, a request that comes in."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped
from gsseg_msgs.srv import LoadScene
from rclpy.parameter import Parameter
from std_msgs.msg import Header

from gsseg_core.errors import PoseError
from gsseg_ros.conversions import matrix_from_pose, transform_of
from gsseg_ros.errors import InvalidRequestError
from gsseg_ros.frames import Similarity
from gsseg_ros.node.declarations import SCALES
from gsseg_ros.qos import latched


def placed(request: LoadScene.Request) -> list[Parameter]:
    """Read where a request puts the scene, as parameters; none if it says nothing of that.

    Raises `InvalidRequestError`: scale or pose are impossible.
    """
    scale, pose = request.scene_to_map_scale, request.scene_to_map
    if scale == 0:
        return []
    least, largest = SCALES
    if not least <= scale <= largest:
        raise InvalidRequestError(f"scene_to_map_scale is {scale:g}; expected 0, or {least:g} to {largest:g}")
    try:
        matrix_from_pose(pose, "scene_to_map")
    except PoseError as error:
        raise InvalidRequestError(str(error)) from error
    place, turn = pose.position, pose.orientation
    values = {
        "scale": scale, "translation": [place.x, place.y, place.z], "rotation": [turn.x, turn.y, turn.z, turn.w],
    }  # fmt: skip
    return [Parameter(f"scene_to_map.{name}", value=value) for name, value in values.items()]


@contextmanager
def placed_by(node: Any, wanted: Sequence[Parameter]) -> Iterator[None]:
    """Set where the scene lies, as `placed` reads it; and as it was if something is raised in the body.

    Raises `InvalidRequestError`: it was refused.
    """
    before = [node.get_parameter(parameter.name) for parameter in wanted]
    if wanted and not (result := node.set_parameters_atomically(wanted)).successful:
        raise InvalidRequestError(f"the place of the scene was refused: {result.reason}")
    try:
        yield
    except Exception:
        if before:
            node.set_parameters_atomically(before)
        raise


class SceneFrame:
    """Publishes `map_frame -> scene_frame` on `/tf_static`, as tf2_ros does; nothing where tf2_msgs is not installed.

    The scale is left out, as transforms have none: the axes of the frame are those of the scene, its unit is a metre.
    Without a `scene_frame`, nothing is published.
    """

    def __init__(self, node: Any, map_frame: str, scene_frame: str) -> None:
        self._node, self._map_frame, self._scene_frame = node, map_frame, scene_frame
        self._publisher: Any = None
        if not scene_frame:
            return
        try:
            from tf2_msgs.msg import TFMessage  # type: ignore[import-not-found, unused-ignore]
        except ImportError:
            return
        self._message, self._publisher = TFMessage, node.create_publisher(TFMessage, "/tf_static", latched())

    def publish(self, similarity: Similarity, stamp: Time) -> None:
        """Publish where the scene lies from now on."""
        if self._publisher is not None:
            self._publisher.publish(
                self._message(transforms=[transform(self._map_frame, self._scene_frame, similarity, stamp)])
            )

    def close(self) -> None:
        """Take the topic away."""
        if self._publisher is not None:
            self._node.destroy_publisher(self._publisher)


def transform(map_frame: str, scene_frame: str, similarity: Similarity, stamp: Time) -> TransformStamped:
    """Write the pose of the scene in the map as a transform."""
    return TransformStamped(
        header=Header(stamp=stamp, frame_id=map_frame),
        child_frame_id=scene_frame,
        transform=transform_of(similarity.rotation, similarity.translation),
    )
