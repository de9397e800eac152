"""Quality of service of the node's topics. A new profile for each: rclpy writes what parameters override into it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from rclpy.exceptions import ParameterException
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

from gsseg_core.errors import SettingsError

FEEDBACK_DEPTH = 1000
"""Of the feedback of an action: of a client that stands still for a while, too, none is lost."""


def input_data(depth: int) -> QoSProfile:
    """Make a profile for an input, so many messages deep, for a burst while the interpreter is busy.

    How reliable it is, `gsseg_ros.node.matched_subscription` finds out.
    """
    return QoSProfile(depth=depth, reliability=ReliabilityPolicy.BEST_AVAILABLE, durability=DurabilityPolicy.VOLATILE)


def sensor_data() -> QoSProfile:
    """Make a profile as for sensor data, which goes with every subscription but a reliable one."""
    return QoSProfile(depth=30, reliability=ReliabilityPolicy.BEST_EFFORT, durability=DurabilityPolicy.VOLATILE)


def latched(depth: int = 1) -> QoSProfile:
    """Make a profile for latched topics, whose last message late subscribers get, too."""
    return QoSProfile(depth=depth, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def reliable(depth: int = 100) -> QoSProfile:
    """Make a profile as is usual, but so deep that in a burst, too, every request gets an answer."""
    return QoSProfile(depth=depth, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.VOLATILE)


@contextmanager
def clear_overrides(topic: str) -> Iterator[None]:
    """Make what rclpy raises in the body for a parameter qos_overrides that cannot be used one clear error.

    Raises `SettingsError`: in its place.
    """
    try:
        yield
    except (RuntimeError, ValueError, ParameterException) as error:
        raise SettingsError(
            f"parameters qos_overrides of the topic {topic}: {error}; expected reliability reliable or best_effort, "
            "history keep_last or keep_all, and depth a number of messages"
        ) from error


def overridable_publisher(node: Any, kind: Any, topic: str, quality: QoSProfile) -> Any:
    """Make a publisher whose quality of service parameters may override; raises as `clear_overrides` does."""
    with clear_overrides(topic):
        overridable = QoSOverridingOptions.with_default_policies()
        return node.create_publisher(kind, topic, quality, qos_overriding_options=overridable)
