"""What several tests of the segmentation node look at, and what they take away from it."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import contextmanager

from gsseg_msgs.msg import SegmentationReport
from ros_robot import Robot
from sensor_msgs.msg import PointCloud2

TOKENS = ("background", "red_ball", "cup_mug", "box")
"""Names of the classes' topics."""


def counts(report: SegmentationReport) -> dict[str, int]:
    """Gaussians by the name of their class."""
    return {summary.name: summary.num_gaussians for summary in report.classes}


def latched_clouds(robot: Robot) -> dict[str, PointCloud2]:
    """What a subscriber that comes late gets, by topic."""
    topics = ["cloud", *(f"classes/{token}" for token in TOKENS)]
    return dict(zip(topics, robot.latched(*((PointCloud2, topic) for topic in topics)), strict=True))


@contextmanager
def limited(robot: Robot, what: int, limit: int) -> Iterator[None]:
    """Take a resource away from the node's process, for real, for a while."""
    assert robot.process is not None
    _, hard = before = resource.prlimit(robot.process.pid, what)
    resource.prlimit(robot.process.pid, what, (limit, hard))
    try:
        yield
    finally:
        resource.prlimit(robot.process.pid, what, before)
