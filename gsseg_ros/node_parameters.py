"""Parameters of a node: described where they are declared, and told of where it was given others than it has."""

from __future__ import annotations

import difflib

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node


def parameter_descriptor(
    description: str, default: object, low: float | None, high: float | None, **more: bool
) -> ParameterDescriptor:
    """Describe a parameter; where it has limits, they are a range of its default's type."""
    descriptor = ParameterDescriptor(description=description, **more)
    if low is not None and high is not None:
        if isinstance(default, int):
            descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
        else:
            descriptor.floating_point_range = [FloatingPointRange(from_value=float(low), to_value=float(high))]
    return descriptor


def warn_of_unknown(node: Node, of_topics: bool = False) -> None:
    """Warn of parameters that a node was given and has not declared, which ROS passes over.

    It is no error: those of a file's `/**` may be of another node. Qualities of service, `of_topics`, are declared with
    each topic, and so are known only once all of these are there.
    """
    # rclpy has no public word for either.
    known = node._parameters.keys()
    given = (name for name in node._parameter_overrides if name.startswith("qos_overrides.") == of_topics)
    strange = sorted({*given} - known)
    near = [difflib.get_close_matches(name, known, 1) for name in strange]
    said = [name + "".join(f" (did you mean {one}?)" for one in ones) for name, ones in zip(strange, near, strict=True)]
    if said:
        node.get_logger().warning(f"parameters that this node does not have are ignored: {', '.join(said)}")
