"""Class probabilities of a running segmentation node for the viewer: the source "ros" of `gsseg view --ros`."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from gsseg_msgs.srv import Segment
from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import GetParameters
from sensor_msgs.msg import PointCloud2

from gsseg_core.csr_rows import CSRRows, starts
from gsseg_core.data.class_names import class_name
from gsseg_core.errors import StateMismatchError
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import UNOBSERVED
from gsseg_core.viewer.live_source import LiveUpdate
from gsseg_core.viewer.model import Labelling
from gsseg_ros.client.calls import Calls
from gsseg_ros.client.run_clouds import was_published
from gsseg_ros.client.spinner import Spinner
from gsseg_ros.cloud_messages import CloudArrays, arrays_from_cloud
from gsseg_ros.conversions import stamp_ns
from gsseg_ros.errors import NodeUnavailableError, SegmentationError
from gsseg_ros.frames import Similarity
from gsseg_ros.qos import latched

ANSWER_SECONDS = 30.0
"""How long a request, and the clouds that follow it, may take."""

_PARAMETERS = ("scene_to_map.scale", "scene_to_map.translation", "scene_to_map.rotation")
_CHANGING = ("views fused", "codes", "changes of the class probabilities", "views accepted")
"""Values of the node's diagnostics that change with its class probabilities, and with nothing else: not by asking.

The last is there while the node is active, so that one that answered NOT_ACTIVE is asked again then.
"""


class RosSource:
    """Asks a node to segment whenever its diagnostics report new views or a new result of learning.

    A request has the node publish its clouds, for all who listen. They hold the class of a Gaussian and its confidence,
    and no other probabilities. The node has the same scene; its name may have a namespace before it. Raises
    `NodeUnavailableError`: there is no such node.
    """

    def __init__(
        self,
        scene: GaussianScene,
        node_name: str = "gsseg",
        *,
        domain_id: int | None = None,
        find_timeout: float = 30.0,
    ) -> None:
        self._scene, self._name = scene, "/" + node_name.strip("/")
        self._said: tuple[str, ...] | None = None
        self._shown: tuple[str, ...] | None = None
        self._clouds: dict[str, PointCloud2 | None] = {}  # None until one comes.
        self._spinner = Spinner("gsseg_view", None, domain_id)
        try:
            self._calls = Calls(self._spinner, self._name, find_timeout)
            node = self._spinner.node
            self._segment = node.create_client(Segment, f"{self._name}/segment")
            node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
            self._listen(f"{self._name}/cloud")
            self._where = node.create_client(GetParameters, f"{self._name}/get_parameters")
            self._places = self._find_places()
        except BaseException:
            self._spinner.close()
            raise

    def wait(self, timeout: float) -> LiveUpdate | None:
        """Wait until the node has new class probabilities, and fetch them.

        Raises `StateMismatchError`: the node has another scene; `NodeUnavailableError`: it does not answer.
        """
        if not self._spinner.wait_for(lambda: self._said != self._shown, timeout):
            return None
        said, before = self._said, dict(self._clouds)
        try:
            report = self._calls.call(self._segment, Segment.Request(), ANSWER_SECONDS).report
        except SegmentationError as error:
            if error.name == "BUSY":  # Many ask; this one can wait.
                self._spinner.wait_for(lambda: False, timeout)
                return None
            if error.name not in ("NOT_ACTIVE", "NO_CODES"):
                raise
            self._shown = said
            return LiveUpdate(Labelling.unknown(len(self._scene)), 0) if error.name == "NO_CODES" else None
        if report.scene_hash != self._scene.digest:
            self._shown = said  # To ask again before anything has changed would keep the node at work for nothing.
            raise StateMismatchError(
                f"{self._name} has the scene {report.scene_path}, which is not {self._scene.path or 'this one'}; "
                "expected the same file"
            )
        if not was_published(report):  # There is something newer to ask for.
            return None
        try:
            labelling = self._labelling(report, before)
        except StateMismatchError:  # The scene may have been put elsewhere in the map.
            self._places = self._find_places()
            labelling = self._labelling(report, before)
        self._shown = said
        return LiveUpdate(labelling, int(report.num_views))

    def close(self) -> None:
        """Leave ROS; the node goes on."""
        self._spinner.close()

    def _labelling(self, report: Any, before: Mapping[str, PointCloud2 | None]) -> Labelling:
        names = {summary.class_id: summary.name for summary in report.classes}
        labels, confidence = np.full(len(self._scene), UNOBSERVED, np.int32), np.zeros(len(self._scene), np.float32)
        # ~/cloud has all objects; the background is in a cloud of its own.
        topics = [f"{self._name}/cloud", *(s.topic for s in report.classes if s.class_id == 0 and s.topic)]
        for topic in topics:
            self._listen(topic)
            cloud = self._cloud(topic, stamp_ns(report.header.stamp), before.get(topic))
            index = self._places.find(cloud.points, topic)
            labels[index], confidence[index] = cloud.labels, cloud.confidence
        # A later run's cloud may have classes that turned up after this one.
        names = {k: class_name(names, k) for k in range(max(*names, 0, int(labels.max())) + 1)}
        known = labels >= 0
        return Labelling(labels, CSRRows(starts(known), labels[known].astype(np.uint32), confidence[known]), names)

    def _listen(self, topic: str) -> None:
        if topic not in self._clouds:
            self._clouds[topic] = None
            self._spinner.run(
                lambda: self._spinner.node.create_subscription(
                    PointCloud2, topic, lambda message: self._clouds.update({topic: message}), latched()
                )
            )

    def _cloud(self, topic: str, stamp: int, before: PointCloud2 | None) -> CloudArrays:
        def came() -> bool:
            # A later run's cloud is as good as this one's: it is what is known now. But one that was there before this
            # run has a later stamp where time was set back, and the same one where /clock stands still.
            cloud = self._clouds[topic]
            return cloud is not before and cloud is not None and stamp_ns(cloud.header.stamp) >= stamp

        if not self._spinner.wait_for(came, ANSWER_SECONDS):
            raise NodeUnavailableError(f"{topic}: no cloud of the last run within {ANSWER_SECONDS:g} s")
        return arrays_from_cloud(self._clouds[topic], topic)

    def _find_places(self) -> _Places:
        return _Places(self._similarity().points_to_map(self._scene.means))

    def _similarity(self) -> Similarity:
        client = self._where
        self._calls.find(client.service_is_ready, f"service {client.srv_name}", ANSWER_SECONDS)
        question = GetParameters.Request(names=list(_PARAMETERS))
        told = self._calls.ask(client, question, time.monotonic() + ANSWER_SECONDS)
        if told is None:
            raise self._calls.unanswered(client.srv_name, gone=not client.service_is_ready())
        scale, translation, rotation = (_value(value) for value in told.values)
        return Similarity.from_parameters(scale, translation, rotation)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == self._name:
                values = {value.key: value.value for value in status.values}
                self._said = tuple(values.get(key, "") for key in _CHANGING)


class _Places:
    """Finds the Gaussians of a cloud, which has no indices, by their position in the map, bit for bit.

    Of two in the very same place, the first is found.
    """

    def __init__(self, points: np.ndarray) -> None:  # (N, 3) float32
        keys = _keys(points)
        self._order = np.argsort(keys, kind="stable")
        self._sorted = keys[self._order]

    def find(self, points: np.ndarray, topic: str) -> np.ndarray:
        """Give the indices (M,) of points (M, 3)."""
        keys = _keys(points)
        place = np.minimum(np.searchsorted(self._sorted, keys), len(self._sorted) - 1)
        found = self._sorted[place] == keys
        if not found.all():
            raise StateMismatchError(
                f"{topic}: {np.count_nonzero(~found)} of {len(points)} points are not centres of the scene; expected "
                "the scene and the scene_to_map of the node"
            )
        index: np.ndarray = self._order[place]
        return index


def _keys(points: np.ndarray) -> np.ndarray:
    """One key per point (M, 3): its 12 bytes, which numpy sorts and compares as such."""
    keys: np.ndarray = np.ascontiguousarray(points, np.float32).view(np.dtype((np.void, 12)))[:, 0]
    return keys


def _value(value: ParameterValue) -> Any:
    kinds = {3: value.double_value, 8: value.double_array_value}
    return kinds[value.type]
