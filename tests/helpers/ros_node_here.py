"""The segmentation node inside the test's own process, driven by hand, so that a test can stop it anywhere.

Nothing spins it: no timer runs, no message comes but those that are handed to it, and requests are plain calls.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter
from ros_helpers import Ros, wait_until
from ros_robot import SECOND, SERVICES, STEP, messages

from gsseg_core.data.view import View
from gsseg_ros.node.inputs import Inputs
from gsseg_ros.node.obstacles import Obstacles
from gsseg_ros.node.outputs import Outputs
from gsseg_ros.node.segment_node import SegmentNode


class NodeHere:
    """A node, active from the start.

    Attributes
    ----------
    node : SegmentNode
        The node itself.
    stamp : int
        Of the next view, in nanoseconds; it begins at the same time in every node, as in a simulator.
    """

    def __init__(self, ros: Ros, parameters: Mapping[str, Any], remapping: Iterable[str] = ()) -> None:
        self.stamp = 1000 * SECOND
        values = {
            name: value if isinstance(value, list | int | float) else str(value) for name, value in parameters.items()
        }
        self.node = SegmentNode(
            context=ros.context,
            use_global_arguments=False,
            cli_args=["--ros-args", *(text for rule in remapping for text in ("-r", rule))],
            parameter_overrides=[Parameter(name, value=value) for name, value in values.items()],
        )
        self.configure()

    def configure(self) -> None:
        """Configure and activate."""
        assert self.node.trigger_configure() == TransitionCallbackReturn.SUCCESS
        assert self.node.trigger_activate() == TransitionCallbackReturn.SUCCESS

    @property
    def inputs(self) -> Inputs:
        assert self.node.inputs is not None
        return self.node.inputs

    @property
    def outputs(self) -> Outputs:
        assert self.node._outputs is not None
        return self.node._outputs

    @property
    def obstacles(self) -> Obstacles:
        assert self.node.obstacles is not None
        return self.node.obstacles

    def send(
        self,
        views: Iterable[View],
        topics: Iterable[str] = ("camera_info", "pose", "mask"),
        stamps: Iterable[int] | None = None,
    ) -> list[int]:
        """Hand it messages of some views; returns their stamps, which go on from the last one unless given."""
        used = []
        for view, stamp in zip(views, stamps or itertools.count(self.stamp, STEP), strict=False):
            used.append(stamp)
            self.stamp = max(self.stamp, stamp + STEP)
            sent = messages(view, stamp)
            self.hand({topic: sent[topic] for topic in topics})
        return used

    def hand(self, sent: Mapping[str, Any], camera: str = "") -> None:
        """Hand it messages by the name of their input, of one of its cameras."""
        for topic, message in sent.items():
            getattr(self.inputs.cameras[camera], f"on_{topic}")(topic, message)
            self.inputs._hand_over()

    def fuse(self, views: list[View]) -> None:
        """Hand it some views, and wait until they are fused."""
        before = self.inputs.accepted
        self.send(views)
        wait_until(lambda: self.inputs.accepted == before + len(views), f"{len(views)} views to be fused")

    def ask(self, service: str, **fields: Any) -> Any:
        """Call the handler of a service."""
        handler = getattr(self.node._requests, service, None) or getattr(self.node._changes, service)
        return handler(SERVICES[service].Request(**fields), SERVICES[service].Response())

    def done(self, service: str, **fields: Any) -> Any:
        """Call the handler of a service, which must work."""
        response = self.ask(service, **fields)
        assert response.error_code == 0, response.error_msg
        return response


@contextmanager
def node_here(ros: Ros, parameters: Mapping[str, Any], remapping: Iterable[str] = ()) -> Iterator[NodeHere]:
    """A node that is gone after the body; `remapping` has rules such as "mask:=/segmenter/mask"."""
    here = NodeHere(ros, parameters, remapping)
    try:
        yield here
    finally:
        here.node.close()
