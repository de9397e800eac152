"""Quality of service of the node's topics. A new profile for each: rclpy writes what parameters override into it."""

from __future__ import annotations

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy


def sensor_data() -> QoSProfile:
    """Make a profile as for sensor data, deep enough for a burst while the interpreter is busy."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=30,
        reliability=ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.VOLATILE,
    )


def latched() -> QoSProfile:
    """Make a profile for what those who come late get too."""
    return QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def all_clouds() -> QoSProfile:
    """Make a profile for a client that wants every cloud.

    Reliable, for large clouds do not arrive otherwise; latched, so that a cloud is not lost that was sent before the
    two ends had found each other; deep enough that one of another client does not push it out.
    """
    return QoSProfile(depth=5, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
