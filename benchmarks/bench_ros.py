"""Measure the ROS 2 node in processes of its own: rate of fusion, segment, cancel, memory, and the labels it gives.

Masks are replayed over DDS by `replay_node`; requests come from this process. Nothing else should run meanwhile.

Usage: python benchmarks/bench_ros.py [--views 2000] [--only rate,segment,million,cancel,memory,labels,real]
The real scene is looked for where `--data` or GSSEG_DATA says, else in ../shared/data beside the checkout.
"""

from __future__ import annotations

import os
import statistics
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from gsseg_msgs.msg import SegmentationReport
from gsseg_msgs.srv import Segment
from machine import describe, memory_of, parser_of
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from sensor_msgs.msg import PointCloud2
from workloads import RoomSize, write_room

from gsseg_core import pipeline
from gsseg_ros.child_nodes import ChildNode, ChildNodes
from gsseg_ros.client import LearnResult, SegmentationClient, SegmentationError
from gsseg_ros.conversions import stamp_ns
from gsseg_ros.qos import latched

PATIENCE = 600.0


class Robot(SegmentationClient):
    """A client in this process that hears the clouds of classes and what the node says of itself, beside its nodes."""

    def __init__(self, nodes: ChildNodes) -> None:
        super().__init__(domain_id=nodes.domain_id, find_timeout=PATIENCE)
        self._nodes = nodes
        self._arrived: dict[str, tuple[int, float]] = {}  # stamp of the last cloud, and when it came, by topic
        self._setter = self._spinner.node.create_client(SetParameters, f"{self._name}/set_parameters")
        self._spinner.run(self._hear_diagnostics)

    @property
    def status(self) -> dict[str, str]:
        """What the node said last of itself."""
        return {} if self._status is None else {entry.key: entry.value for entry in self._status.values}

    @contextmanager
    def running(self, parameters: Mapping[str, Any]) -> Iterator[ChildNode]:
        """Run the segmentation node while the body runs, and wait for its end."""
        child = self._nodes.start("segment_node", parameters)
        self._status = None
        try:
            yield child
        finally:
            child.interrupt()
            child.wait(20)

    def replay(self, parameters: Mapping[str, Any], patience: float = PATIENCE) -> None:
        """Replay to the end."""
        child = self._nodes.start("replay_node", parameters)
        child.wait(patience)
        _ = child.done  # Or it raises what is wrong.

    def settled(self) -> None:
        """Wait until all that was received has been fused or rejected, the mask in hand too."""
        time.sleep(1.5)  # Diagnostics come once a second.
        self._await(lambda: all_handled(self.status), "fusion to end")

    def set_beta(self, beta: float) -> None:
        """Change a setting of the refinement, so that nothing kept from before can be the answer."""
        request = SetParameters.Request(parameters=[Parameter("beta", value=beta).to_parameter_msg()])
        self._calls.ask(self._setter, request, time.monotonic() + PATIENCE)

    def listen(self, topics: list[str]) -> None:
        """Subscribe to clouds."""
        node = self._spinner.node
        for topic in set(topics) - self._arrived.keys():
            self._arrived[topic] = 0, 0.0
            heard = partial(self._on_class_cloud, topic)
            self._spinner.run(lambda: node.create_subscription(PointCloud2, topic, heard, latched()))  # noqa: B023

    def asked(self) -> SegmentationReport:
        """Have the node segment; its report."""
        return self._call(Segment, Segment.Request(), PATIENCE).report

    def timed(self) -> tuple[float, float, dict[str, float]]:
        """Seconds from a request to its answer and to the last cloud received, and those of the stages."""
        started = time.perf_counter()
        report = self.asked()
        answered = time.perf_counter()
        stamp, topics = stamp_ns(report.header.stamp), [f"{self._name}/cloud", *topics_of(report)]
        self._await(lambda: all(self._arrived[topic][0] == stamp for topic in topics), "clouds")
        last = max(self._arrived[topic][1] for topic in topics)
        return answered - started, last - started, {stage.name: stage.seconds for stage in report.stages}

    def learnt(self) -> tuple[float, LearnResult]:
        """Learn; seconds from the request to the result, and the result."""
        started = time.perf_counter()
        result = self.learn(timeout=PATIENCE)
        return time.perf_counter() - started, result

    def canceled(self, after: int) -> float:
        """Seconds from a cancel, after so many steps of learning were told, to the end of learning."""
        steps, canceled = 0, 0.0

        def told(stage: str, *_: float) -> None:
            nonlocal steps, canceled
            steps += stage == "em"
            if steps == after and not canceled:
                canceled = time.perf_counter()
                self.cancel()

        with suppress(SegmentationError):
            self.learn(on_feedback=told, timeout=PATIENCE)
        return time.perf_counter() - canceled

    def _await(self, condition: Callable[[], bool], what: str) -> None:
        if not self._spinner.wait_for(condition, PATIENCE):
            raise TimeoutError(what)

    def _on_class_cloud(self, topic: str, message: PointCloud2) -> None:
        self._arrived[topic] = stamp_ns(message.header.stamp), time.perf_counter()


def main() -> None:
    """Measure what was asked for."""
    parser = parser_of(__doc__)
    parser.add_argument("--views", type=int, default=2000, help="of the memory test")
    parser.add_argument("--only", default="rate,segment,cancel,labels,memory,million")
    parser.add_argument("--real-data", type=Path, help="of `real`; written there unless it exists")
    options = parser.parse_args()
    wanted, data = options.only.split(","), options.data / "replica_apartment"
    print(describe())
    with tempfile.TemporaryDirectory() as name, ChildNodes(Path(name) / "logs") as nodes:
        os.environ.update(nodes.environment)
        with Robot(nodes) as robot:
            if data.is_dir():
                real_scene(robot, data, [name for name in wanted if name not in ("million", "memory", "real")])
                if "memory" in wanted:
                    memory(robot, data, options.views)
            else:
                print(f"skipped: real data not found at {data}")
            if "million" in wanted:
                million(robot, Path(name) / "room")
            if "real" in wanted:
                real_size(robot, options.real_data or Path(name) / "real")


def real_scene(robot: Robot, data: Path, wanted: list[str]) -> None:
    """Rate, segment, cancel and labels on the apartment."""
    if not wanted:
        return
    with (
        tempfile.TemporaryDirectory() as folder,
        robot.running({"scene_path": str(data / "scene.ply"), "data_root": folder}),
    ):
        for rate in (10.0, 20.0, 30.0, 40.0) if "rate" in wanted else (10.0,):
            fuse(robot, data, rate)
        seconds, result = robot.learnt()
        print(f"learn: {seconds:.2f} s, {result.num_steps} steps on {result.report.num_views} views")
        if "segment" in wanted:
            segment(robot, "real scene, all classes", 7)
        if "cancel" in wanted:
            times = [robot.canceled(1 + i % 3) for i in range(5)]
            print(f"cancel to result: median {statistics.median(times):.3f} s, longest {max(times):.3f} s")
        if "labels" in wanted:
            labels(robot, data, Path(folder))


def fuse(robot: Robot, data: Path, rate: float) -> None:
    """Replay once and count what was fused."""
    robot.wait_until_active(PATIENCE)
    robot.reset()
    before = [int(robot.status.get(key, 0)) for key in ("views accepted", "queue drops", "/mask received")]
    robot.replay({"data": str(data), "rate": rate})
    robot.settled()
    accepted, drops = int(robot.status["views accepted"]) - before[0], int(robot.status["queue drops"]) - before[1]
    sent, arrived = len(list((data / "labels").iterdir())), int(robot.status["/mask received"]) - before[2]
    print(f"replay at {rate:g} masks/s: of {sent} masks {arrived} arrived, {accepted} were fused, {drops} dropped")


def segment(robot: Robot, what: str, runs: int) -> None:
    """Segment from new codes or settings each time, then once more with nothing changed."""
    robot.listen(["/gsseg/cloud"])
    robot.listen(topics_of(robot.asked()))
    time.sleep(1.0)  # Subscriptions are found by then; a robot has them from the start.
    rows = []
    for run in range(runs):
        robot.set_beta(0.64 + 0.02 * (run % 2))
        rows.append(robot.timed())
    robot.set_beta(0.65)
    answered, last = (statistics.median(row[i] for row in rows) for i in (0, 1))
    stages = {name: round(statistics.median(row[2].get(name, 0.0) for row in rows), 3) for name in rows[0][2]}
    print(f"segment, {what}: answer {answered:.3f} s, last cloud {last:.3f} s (longest {max(r[1] for r in rows):.3f})")
    print(f"  stages: {stages}")
    robot.timed()
    print(f"  again with nothing changed: last cloud {robot.timed()[1]:.3f} s")


def labels(robot: Robot, data: Path, folder: Path) -> None:
    """Compare with the command line on the same views."""
    robot.export("robot")
    pipeline.segment(data / "scene.ply", data, folder / "command_line")
    mine, other = (np.load(folder / name / "segmentation.npz")["labels"] for name in ("robot", "command_line"))
    print(f"labels that differ from the command line's: {(mine != other).sum()} of {len(mine)}")


def memory(robot: Robot, data: Path, views: int) -> None:
    """Resident memory of the node while many views are replayed."""
    with robot.running({"scene_path": str(data / "scene.ply"), "max_views": 100}) as child:
        loops = -(-views // 105)
        done = threading.Event()
        rows: list[tuple[int, float]] = []

        def watch() -> None:
            while not done.wait(1.0):
                rows.append((int(robot.status.get("views accepted", 0)), memory_of("VmRSS", child.pid) / 2**20))

        thread = threading.Thread(target=watch)
        thread.start()
        robot.replay({"data": str(data), "rate": 15.0, "loop": loops}, PATIENCE + loops * 105 / 15)
        robot.settled()
        done.set()
        thread.join()
        print(f"memory over {robot.status['views accepted']} views fused, max_views 100, MiB by views fused:")
        marks = [100 * 2**i for i in range(10) if 100 * 2**i < rows[-1][0]]
        for mark in [*marks, rows[-1][0]]:
            print(f"  {mark:5d}: {next(mib for count, mib in rows if count >= mark):.0f}")


def million(robot: Robot, data: Path) -> None:
    """Segment a million Gaussians."""
    write_room(data, RoomSize(1_000_000, 20, 10, 640, 480))
    with robot.running({"scene_path": str(data / "scene.ply")}):
        fuse(robot, data, 2.0)
        segment(robot, "1,000,000 Gaussians, 10 classes", 7)
        seconds, result = robot.learnt()
        print(f"learn: {seconds:.1f} s, {result.num_steps} steps on {result.report.num_views} views")
        segment(robot, "the same after learn", 7)


def real_size(robot: Robot, data: Path) -> None:
    """Fuse masks of 1280 x 720 at 5 Hz into 3 million Gaussians of 20 classes, and segment: times, and peak memory."""
    if not data.exists():
        write_room(data, RoomSize(3_000_000, 40, 20, 1280, 720, sh_degree=1))
    with robot.running({"scene_path": str(data / "scene.ply")}) as child:
        fuse(robot, data, 5.0)
        segment(robot, "3,000,000 Gaussians, 20 classes", 5)
        print(f"peak resident memory of the node: {memory_of('VmHWM', child.pid) / 2**30:.2f} GiB")


def all_handled(status: Mapping[str, str]) -> bool:
    """Tell by `/diagnostics` whether every mask that came was fused or rejected; one in hand waits nowhere."""
    ended = sum(int(count) for key, count in status.items() if key == "views accepted" or key.startswith("rejected "))
    return "/mask received" in status and int(status["/mask received"]) == ended


def topics_of(report: SegmentationReport) -> list[str]:
    """Topics of the classes that have Gaussians; the others have none."""
    return [entry.topic for entry in report.classes if entry.topic]


if __name__ == "__main__":
    main()
