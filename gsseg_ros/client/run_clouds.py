"""Keeps the clouds of runs that a client has asked for, until it has found its own among them."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator

from gsseg_msgs.msg import SegmentationReport
from sensor_msgs.msg import PointCloud2

from gsseg_ros.client.spinner import Spinner
from gsseg_ros.conversions import stamp_ns
from gsseg_ros.errors import NodeUnavailableError
from gsseg_ros.qos import latched

_MOST = 16
"""Clouds that are kept; of two that ask in turn, and never rest together, all would be."""


def was_published(report: SegmentationReport) -> bool:
    """Whether a run was: one that others replaced, or got ahead of, is answered all the same."""
    return any(stage.name == "publish" for stage in report.stages)


class RunClouds:
    """Listens to a node's `~/cloud`, whose full name is `topic`; its methods may be called from several threads."""

    def __init__(self, spinner: Spinner, topic: str) -> None:
        self._spinner, self._lock = spinner, threading.Lock()
        self._clouds: dict[int, PointCloud2] = {}  # by stamp [ns]
        self._awaiting = 0
        # Latched for a cloud that was sent before the two ends had found each other; others do not push it out so soon.
        self._topic = spinner.node.create_subscription(PointCloud2, topic, self._on_cloud, latched(5))

    @contextlib.contextmanager
    def kept(self) -> Iterator[None]:
        """Keep all clouds that come during the body."""
        with self._lock:
            self._awaiting += 1
        try:
            yield
        finally:
            with self._lock:
                self._awaiting -= 1
                if not self._awaiting:
                    self._clouds.clear()

    def of_run(self, report: SegmentationReport, deadline: float) -> PointCloud2 | None:
        """Wait for the cloud of a run; None if it was not published, or that of a later one has come instead.

        Raises `NodeUnavailableError`: neither has come by the deadline (s, `time.monotonic`).
        """
        stamp = stamp_ns(report.header.stamp)
        if not was_published(report) and time.monotonic() < deadline:
            return None
        if not self._spinner.wait_for(lambda: max([*self._clouds, -1]) >= stamp, deadline - time.monotonic()):
            publishers = self._spinner.node.count_publishers(self._topic.topic_name)
            raise NodeUnavailableError(
                f"{self._topic.topic_name}: segment was answered, but its cloud did not come in time "
                f"({publishers} publishers, {len(self._clouds)} other clouds); did "
                "another request replace it, or does a qos_override make it best effort or volatile?"
            )
        return self._clouds.get(stamp)

    def _on_cloud(self, message: PointCloud2) -> None:
        with self._lock:
            if self._awaiting:
                self._clouds[stamp_ns(message.header.stamp)] = message
                while len(self._clouds) > _MOST:
                    del self._clouds[next(iter(self._clouds))]
