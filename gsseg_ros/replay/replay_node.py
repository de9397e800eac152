"""Publishes a dataset folder or a recorded bag as the topics that the segmentation node listens to."""

from __future__ import annotations

import math
import signal
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import rclpy
from geometry_msgs.msg import PoseStamped
from gsseg_msgs.msg import SceneDelta
from rclpy.duration import Duration
from rclpy.exceptions import ParameterException
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args
from sensor_msgs.msg import CameraInfo, Image

from gsseg_core.errors import GssegError, SettingsError
from gsseg_core.freed_memory import search_no_imports_at_the_end
from gsseg_ros.conversions import stamp_message
from gsseg_ros.node_parameters import parameter_descriptor, warn_of_unknown
from gsseg_ros.replay.sources import TYPES, BagSource, FolderSource, Group
from gsseg_ros.shared_memory import make_room

_CLASSES = {
    "mask": Image, "camera_info": CameraInfo, "pose": PoseStamped, "image": Image, "scene_delta": SceneDelta,
}  # fmt: skip
_KINDS = {
    str: "a string", bool: "true or false", int: "a whole number", float: "a number with a decimal point",
}  # fmt: skip
_QOS = QoSProfile(depth=30, reliability=ReliabilityPolicy.RELIABLE)

# Name, default, smallest, largest (of numbers), description.
_PARAMETERS: tuple[tuple[str, str | int | float, float | None, float | None, str], ...] = (
    ("data", "", None, None, "Dataset folder to replay; exactly one of 'data' and 'bag' is set"),
    ("bag", "", None, None, "Bag to replay: a folder, .mcap or .db3; exactly one of 'data' and 'bag' is set"),
    ("labels", "labels", None, None, "Sub-folder of 'data' with the label images"),
    ("split", "train", None, None, "Views of 'data' to replay: train, test or all"),
    ("rate", 10.0, 1e-3, 1e3, "Masks per second"),
    ("loop", 1, 0, 2**31 - 1, "How many times; 0 is for ever"),
    ("grow", False, None, None, "Whether the scene of 'data' arrives in five submaps, and a loop closes at the end"),
    ("frame_id", "camera", None, None, "Frame of the camera, in the headers of mask, camera_info and image ('data')"),
    ("map_frame", "map", None, None, "Frame in which the poses are ('data')"),
    ("wait_for_subscribers", 60.0, 0.0, 3600.0, "Seconds to wait for somebody who listens to 'mask'"),
    *(
        (f"{role}_topic", "", None, None, f"Topic of 'bag' to replay as '{role}'; empty: the one named so at its end")
        for role in TYPES
    ),
)

# Endpoints are discovered one by one: who listens to the masks may not be known to listen to the poses yet.
_SETTLE_S = 0.5
# For messages on their way: what a busy receiver has lost, it asks for again seconds later. One that hangs may not hold
# up the others for longer.
_PATIENCE_S = 30.0

# Less than that is no news: whoever is busy with a large message takes it.
_USUAL_S = 5.0

# A signal is noticed when a wait ends, so no wait is longer.
_SLICE_S = 0.05


class Stopped(Exception):
    """The node was asked to stop before it was done."""


class Topic:
    """A topic that does not run away from who listens: messages that have not arrived are kept, and no others follow.

    Its publisher is reliable, and keeps `_QOS.depth` messages. `wait` waits until a time (s, `time.monotonic`), and
    ends the wait for receivers by what it raises; `say` is told, in one line, what is waited for where that takes long.
    """

    def __init__(self, publisher: Any, wait: Callable[[float], None], say: Callable[[str], object]) -> None:
        self.publisher, self.published = publisher, 0  # messages so far
        self._wait, self._say, self._unheard, self._patience_s = wait, say, 0, _PATIENCE_S

    def publish(self, message: Any) -> None:
        """Publish a message, once receivers have asked for all that could be pushed out by it."""
        if self._unheard >= _QOS.depth:
            self.settle()
        self.publisher.publish(message)
        self.published += 1
        # Seldom enough to cost nothing, and long before it has to be waited for.
        self._unheard = 0 if self._unheard >= _QOS.depth // 2 and self._arrived() else self._unheard + 1

    def settle(self) -> None:
        """Wait until all has arrived; for one that hangs, only until the patience is at an end."""
        while not self._arrived() and self._patience_s > 0:
            started = time.monotonic()
            self._wait(started + min(_SLICE_S, self._patience_s))
            usual = self._patience_s > _PATIENCE_S - _USUAL_S
            self._patience_s -= time.monotonic() - started
            if usual and self._patience_s <= _PATIENCE_S - _USUAL_S:
                self._say(
                    f"'{self.publisher.topic_name}': a receiver has not taken in what was sent for {_USUAL_S:g} s (is "
                    f"it busy, or was it killed?); continuing without it after {_PATIENCE_S:g} s"
                )
        self._unheard = 0

    def _arrived(self) -> bool:
        arrived = bool(self.publisher.wait_for_all_acked(Duration()))
        if arrived:
            self._patience_s = _PATIENCE_S
        return arrived


class ReplayNode(Node):
    """Node `replay`: publishes `mask`, `camera_info`, `pose` and `image` at a given rate of masks.

    The settings are parameters, read once and described where they are declared; see `_PARAMETERS`.
    """

    def __init__(self) -> None:
        super().__init__("replay")
        self._newest = 0  # stamp, ns
        self._stop_asked = False
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self)
        self._topics = {
            name: Topic(self.create_publisher(kind, name, _QOS), self._spin_until, self.get_logger().warning)
            for name, kind in _CLASSES.items()
        }

    def declare(self) -> dict[str, Any]:
        """Declare all parameters and return their values; raises `SettingsError` for a wrong type or range."""
        values = {}
        for name, default, low, high, text in _PARAMETERS:
            try:
                self.declare_parameter(name, default, parameter_descriptor(text, default, low, high, read_only=True))
                values[name] = self.get_parameter(name).value  # An empty list, which has no type, is found here.
            except ParameterException as error:
                limits = "" if low is None else f" from {low:g} to {high:g}"
                kind = _KINDS[type(default)]
                reason = " ".join(str(error).split())
                raise SettingsError(f"parameter '{name}': {reason}; expected {kind}{limits}") from None
        return values

    def replay(self, source: Iterable[Group], rate: float, loop: int) -> None:
        """Publish all that the source holds, `rate` masks per second, `loop` times (0: until stopped).

        Each time the source is iterated over anew; what it gives is in order of `due`.
        """
        start, offset, passes = time.monotonic(), 0.0, 0
        while loop == 0 or passes < loop:
            last = 0.0
            for group in source:
                last = group.due
                # Counted from the start and not from the mask before: waits that last too long do not add up.
                self._spin_until(start + (offset + group.due) / rate)
                self._publish(group)
            offset += math.floor(last) + 1
            passes += 1
        self._spin_until(start + offset / rate)

    def wait_for_subscribers(self, seconds: float) -> None:
        """Wait until somebody listens to `mask`, or warn that nobody does."""
        deadline = time.monotonic() + seconds
        masks = self._topics["mask"].publisher
        topic = masks.topic_name
        if masks.get_subscription_count() == 0:
            self.get_logger().info(f"waiting up to {seconds:g} s for somebody who listens to '{topic}'")
        while masks.get_subscription_count() == 0:
            if time.monotonic() >= deadline:
                self.get_logger().warning(f"nobody listens to '{topic}' after {seconds:g} s: publishing all the same")
                return
            self._spin_until(min(deadline, time.monotonic() + _SLICE_S))
        self._spin_until(time.monotonic() + _SETTLE_S)

    def linger(self) -> None:
        """Stay until what was published has arrived, or too long; raises `Stopped` as soon as that is asked for."""
        for topic in self._topics.values():
            topic.settle()

    @property
    def published(self) -> dict[str, int]:
        """Messages so far, by topic."""
        return {name: topic.published for name, topic in self._topics.items()}

    def stop(self) -> None:
        """Have the replay end soon with `Stopped`; may be called from a signal handler."""
        self._stop_asked = True

    def close(self) -> None:
        """Take the node down."""
        self._executor.shutdown()
        self.destroy_node()

    def _publish(self, group: Group) -> None:
        stamp = self._next_stamp()
        for topic, message in group.messages:
            if not isinstance(message, bytes):
                message.header.stamp = stamp
            self._topics[topic].publish(message)

    def _next_stamp(self) -> Any:
        # Strictly increasing even where the clock stands still (simulated time) or is set back.
        self._newest = max(self._newest + 1, self.get_clock().now().nanoseconds)
        return stamp_message(self._newest)

    def _spin_until(self, deadline: float) -> None:
        """Answer requests until then; raises `Stopped` as soon as that is asked for."""
        while not self._stop_asked:
            left = deadline - time.monotonic()
            if left <= 0:
                return
            self._executor.spin_once(timeout_sec=min(left, _SLICE_S))
        raise Stopped


def make_source(settings: dict[str, Any]) -> FolderSource | BagSource:
    """Open the folder or bag that the parameters name."""
    data, bag = settings["data"], settings["bag"]
    if bool(data) == bool(bag):
        found = f"data is '{data}' and bag is '{bag}'" if data else "neither 'data' nor 'bag' is set"
        raise SettingsError(f"parameters: {found}; expected exactly one of 'data' (a dataset folder) and 'bag'")
    if bag:
        return BagSource(Path(bag).expanduser(), {role: settings[f"{role}_topic"] for role in TYPES})
    folder = Path(data).expanduser(), settings["labels"], settings["split"], settings["frame_id"], settings["map_frame"]
    if not settings["grow"]:
        return FolderSource(*folder)
    if settings["loop"] != 1:
        raise SettingsError(f"parameters: grow is true and loop is {settings['loop']}; expected 1: a scene grows once")
    from gsseg_ros.replay.growing import GrowingSource  # It loads the scene, and a bag is played without.

    return GrowingSource(*folder)


def _run(node: ReplayNode) -> int:
    """Replay as the parameters say; returns the exit code."""
    log, start = node.get_logger(), None
    try:
        settings = node.declare()
        warn_of_unknown(node)
        source = make_source(settings)
        missing = source.without_mask if isinstance(source, FolderSource) else []
        if missing:
            log.warning(f"{len(missing)} views have no label image and are left out, the first '{missing[0]}'")
        node.wait_for_subscribers(settings["wait_for_subscribers"])
        log.info(f"replaying {source.description} at {settings['rate']:g} masks per second")
        start = time.monotonic()
        node.replay(source, settings["rate"], settings["loop"])
        end = "done"
        node.linger()
    except GssegError as error:
        log.error(str(error))
        return 2
    except Stopped:
        end = "stopped"
    seconds = time.monotonic() - start if start is not None else 0.0
    counts = ", ".join(f"{node.published[topic]} {topic}" for topic in TYPES)
    log.info(f"{end}: published {counts} in {seconds:.2f} s")
    return 0


def _with_parameters(args: list[str] | None) -> list[str]:
    """Replace the option `--grow` by the parameter that it stands for."""
    args = list(sys.argv if args is None else args)
    if "--grow" not in remove_ros_args(args):
        return args
    args.remove("--grow")
    return [*args, "--ros-args", "-p", "grow:=true"]


def main(args: list[str] | None = None) -> int:
    """Run the node; exit code 0 when done or stopped by a signal, 2 for bad input."""
    search_no_imports_at_the_end()
    make_room()
    early: list[int] = []  # signals that come while the node is made
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda which, _: early.append(which))
    try:
        # rclpy's own handlers would take the context away in the middle of a publication.
        rclpy.init(args=_with_parameters(args), signal_handler_options=SignalHandlerOptions.NO)
        node = ReplayNode()
    except Exception as error:  # What ROS raises for arguments and parameters that it cannot take is not public.
        print(f"replay_node: {' '.join(str(error).split())}", file=sys.stderr)
        rclpy.try_shutdown()
        return 2
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: node.stop())
    if early:
        node.stop()
    try:
        return _run(node)
    finally:
        node.close()
        rclpy.shutdown()


if __name__ == "__main__":
    sys.exit(main())
