"""Measure the ROS 2 node in processes of its own: rate of fusion, segment, cancel, memory, and the labels it gives.

Masks are replayed over DDS by `replay_node`; requests come from this process. Nothing else should run meanwhile.

Usage: python benchmarks/bench_ros.py [--views 2000] [--only rate,segment,million,cancel,memory,labels,real]
The real scene is looked for where GSSEG_DATA says, else in ../shared/data beside the checkout.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from gsseg_msgs.action import Learn
from gsseg_msgs.msg import SegmentationReport
from gsseg_msgs.srv import Export, Reset, Segment
from lifecycle_msgs.srv import GetState
from rcl_interfaces.srv import SetParameters
from rclpy.action import ActionClient
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from room import build_room
from sensor_msgs.msg import PointCloud2
from workloads import RoomSize, write_room

from gsseg_core import pipeline
from gsseg_core.data.label_images import write_mask
from gsseg_core.raster.backends import make_operator
from gsseg_ros.child_nodes import NODES

DATA = Path(os.environ.get("GSSEG_DATA") or Path(__file__).parents[2] / "shared" / "data") / "replica_apartment"
LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
PATIENCE = 600.0


class Robot:
    """A client in this process, and the nodes as child processes, in a domain of their own."""

    def __init__(self, domain: int, folder: Path) -> None:
        self.environment = {
            **os.environ,
            "ROS_DOMAIN_ID": str(domain),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "ROS_LOG_DIR": str(folder),
        }
        os.environ.update(ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST")
        self.folder = folder
        rclpy.init(domain_id=domain)
        self.node = rclpy.create_node("bench")
        self.status: dict[str, str] = {}
        self.clouds: dict[str, tuple[int, float]] = {}
        self._subscriptions: dict[str, object] = {}
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        threading.Thread(target=self._executor.spin, daemon=True).start()

    @contextmanager
    def running(self, module: str, parameters: Mapping[str, Any]) -> Iterator[subprocess.Popen[bytes]]:
        """Run a node while the body runs, and wait for its end."""
        settings = [text for name, value in parameters.items() for text in ("-p", f"{name}:={json.dumps(value)}")]
        command = [sys.executable, "-m", NODES[module], "--ros-args", *settings]
        with open(self.folder / f"{module}.log", "ab") as log:
            process = subprocess.Popen(command, env=self.environment, stdout=log, stderr=log)
        try:
            yield process
        finally:
            process.terminate()
            process.wait(20)

    def replay(self, parameters: Mapping[str, Any], patience: float = PATIENCE) -> None:
        """Replay to the end."""
        with self.running("replay_node", parameters) as process:
            if process.wait(patience):
                raise RuntimeError(f"replay_node failed; see {self.folder}/replay_node.log")

    def wait(self, condition: Callable[[], Any], what: str) -> None:
        """Wait until something is so."""
        deadline = time.monotonic() + PATIENCE
        while not condition():
            if time.monotonic() > deadline:
                raise TimeoutError(what)
            time.sleep(0.002)

    def spun(self, work: Callable[[], Any]) -> Any:
        """Do something in the thread that spins: an action's client loses answers that overtake its own calls."""
        task = self._executor.create_task(work)
        self.wait(task.done, "the spinning thread")
        return task.result()

    def call(self, kind: Any, name: str, request: Any) -> Any:
        """Call a service of the node; any error ends the benchmark."""
        client = self.node.create_client(kind, f"/gsseg/{name}")
        self.wait(client.service_is_ready, name)
        future = client.call_async(request)
        self.wait(future.done, name)
        self.node.destroy_client(client)
        answer = future.result()
        if getattr(answer, "error_code", 0):
            raise RuntimeError(f"{name}: {answer.error_msg}")
        return answer

    def set_beta(self, beta: float) -> None:
        """Change a setting of the refinement, so that nothing kept from before can be the answer."""
        request = SetParameters.Request(parameters=[Parameter("beta", value=beta).to_parameter_msg()])
        self.call(SetParameters, "set_parameters", request)

    def wait_until_active(self) -> None:
        """Wait until the node has loaded its scene; its services are there before that."""
        state = partial(self.call, GetState, "get_state", GetState.Request())
        self.wait(lambda: state().current_state.label == "active", "the node to be active")

    def settled(self) -> None:
        """Wait until all that was received has been fused or rejected, the mask in hand too."""
        time.sleep(1.5)  # Diagnostics come once a second.
        self.wait(lambda: all_handled(self.status), "fusion to end")

    def listen(self, topics: list[str]) -> None:
        """Subscribe to clouds."""
        for topic in topics:
            if topic not in self._subscriptions:
                self._subscriptions[topic] = self.node.create_subscription(
                    PointCloud2, topic, lambda message, topic=topic: self._on_cloud(topic, message), LATCHED
                )

    def segment(self) -> tuple[float, float, dict[str, float]]:
        """Seconds from request to answer and to the last cloud received, and those of the stages."""
        started = time.perf_counter()
        answer = self.call(Segment, "segment", Segment.Request())
        answered = time.perf_counter()
        stamp = _nanoseconds(answer.report.header.stamp)
        topics = ["/gsseg/cloud", *topics_of(answer.report)]
        self.wait(lambda: all(self.clouds.get(topic, (0, 0.0))[0] == stamp for topic in topics), "clouds")
        last = max(self.clouds[topic][1] for topic in topics)
        return answered - started, last - started, {stage.name: stage.seconds for stage in answer.report.stages}

    def learn(self, cancel_after: int | None = None) -> tuple[float, Any]:
        """Learn; seconds from the request (to cancel, or to learn) to the result, and the result."""
        client, seen = ActionClient(self.node, Learn, "/gsseg/learn"), []
        self.wait(client.server_is_ready, "learn")
        started = time.perf_counter()
        goal = self.spun(lambda: client.send_goal_async(Learn.Goal(), lambda m: seen.append(m.feedback.stage)))
        self.wait(goal.done, "goal")
        result = self.spun(goal.result().get_result_async)
        if cancel_after is not None:
            self.wait(lambda: seen.count("em") >= cancel_after, "feedback")
            started = time.perf_counter()
            self.spun(goal.result().cancel_goal_async)
        self.wait(result.done, "result")
        seconds = time.perf_counter() - started
        client.destroy()
        return seconds, result.result().result

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        self.status = {entry.key: entry.value for entry in message.status[0].values}

    def _on_cloud(self, topic: str, message: PointCloud2) -> None:
        self.clouds[topic] = (_nanoseconds(message.header.stamp), time.perf_counter())


def main() -> None:
    """Measure what was asked for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--views", type=int, default=2000, help="of the memory test")
    parser.add_argument("--only", default="rate,segment,cancel,labels,memory,million")
    parser.add_argument("--real-data", type=Path, help="of `real`; written there unless it exists")
    options = parser.parse_args()
    wanted = options.only.split(",")
    print(
        f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}; load {os.getloadavg()[0]}"
    )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        robot = Robot(91, folder)
        if DATA.is_dir():
            real_scene(robot, [name for name in wanted if name not in ("million", "memory", "real")], folder)
            if "memory" in wanted:
                memory(robot, options.views)
        else:
            print(f"skipped: real data not found at {DATA}")
        if "million" in wanted:
            million(robot, folder)
        if "real" in wanted:
            real_size(robot, options.real_data or folder / "real")


def real_scene(robot: Robot, wanted: list[str], folder: Path) -> None:
    """Rate, segment, cancel and labels on the apartment."""
    if not wanted:
        return
    with robot.running("segment_node", {"scene_path": str(DATA / "scene.ply"), "data_root": str(folder)}):
        for rate in (10.0, 20.0, 30.0, 40.0) if "rate" in wanted else (10.0,):
            fuse(robot, str(DATA), rate)
        seconds, result = robot.learn()
        print(f"learn: {seconds:.2f} s, {result.num_steps} steps on {result.report.num_views} views")
        if "segment" in wanted:
            segment(robot, "real scene, all classes", 7)
        if "cancel" in wanted:
            times = [robot.learn(cancel_after=1 + i % 3)[0] for i in range(5)]
            print(f"cancel to result: median {statistics.median(times):.3f} s, longest {max(times):.3f} s")
        if "labels" in wanted:
            labels(robot, folder)


def fuse(robot: Robot, data: str, rate: float) -> None:
    """Replay once and count what was fused."""
    robot.wait_until_active()
    robot.call(Reset, "reset", Reset.Request())
    before = [int(robot.status.get(key, 0)) for key in ("views accepted", "queue drops", "/mask received")]
    robot.replay({"data": data, "rate": rate})
    robot.settled()
    accepted, drops = int(robot.status["views accepted"]) - before[0], int(robot.status["queue drops"]) - before[1]
    sent, arrived = len(list((Path(data) / "labels").iterdir())), int(robot.status["/mask received"]) - before[2]
    print(f"replay at {rate:g} masks/s: of {sent} masks {arrived} arrived, {accepted} were fused, {drops} dropped")


def segment(robot: Robot, what: str, runs: int) -> None:
    """Segment from new codes or settings each time, then once more with nothing changed."""
    robot.listen(["/gsseg/cloud"])
    first = robot.call(Segment, "segment", Segment.Request())
    robot.listen(topics_of(first.report))
    time.sleep(1.0)  # Subscriptions are found by then; a robot has them from the start.
    rows = []
    for run in range(runs):
        robot.set_beta(0.64 + 0.02 * (run % 2))
        rows.append(robot.segment())
    robot.set_beta(0.65)
    answered, last = (statistics.median(row[i] for row in rows) for i in (0, 1))
    stages = {name: round(statistics.median(row[2].get(name, 0.0) for row in rows), 3) for name in rows[0][2]}
    print(f"segment, {what}: answer {answered:.3f} s, last cloud {last:.3f} s (longest {max(r[1] for r in rows):.3f})")
    print(f"  stages: {stages}")
    robot.segment()
    print(f"  again with nothing changed: last cloud {robot.segment()[1]:.3f} s")


def labels(robot: Robot, folder: Path) -> None:
    """Compare with the command line on the same views."""
    robot.call(Export, "export", Export.Request(directory="robot"))
    pipeline.segment(DATA / "scene.ply", DATA, folder / "command_line")
    mine, other = (np.load(folder / name / "segmentation.npz")["labels"] for name in ("robot", "command_line"))
    print(f"labels that differ from the command line's: {(mine != other).sum()} of {len(mine)}")


def memory(robot: Robot, views: int) -> None:
    """Resident memory of the node while many views are replayed."""
    parameters = {"scene_path": str(DATA / "scene.ply"), "max_views": 100}
    with robot.running("segment_node", parameters) as process:
        loops = -(-views // 105)
        done = threading.Event()
        rows: list[tuple[int, float]] = []

        def watch() -> None:
            while not done.wait(1.0):
                status = Path(f"/proc/{process.pid}/status").read_text()
                kib = int(status.split("VmRSS:")[1].split()[0])
                rows.append((int(robot.status.get("views accepted", 0)), kib / 1024))

        thread = threading.Thread(target=watch)
        thread.start()
        robot.replay({"data": str(DATA), "rate": 15.0, "loop": loops}, PATIENCE + loops * 105 / 15)
        robot.settled()
        done.set()
        thread.join()
        print(f"memory over {robot.status['views accepted']} views fused, max_views 100, MiB by views fused:")
        marks = [100 * 2**i for i in range(10) if 100 * 2**i < rows[-1][0]]
        for mark in [*marks, rows[-1][0]]:
            print(f"  {mark:5d}: {next(mib for count, mib in rows if count >= mark):.0f}")


def million(robot: Robot, folder: Path) -> None:
    """Segment a million Gaussians."""
    room = build_room()
    data = folder / "room"
    data.mkdir()
    room.scene.save(data / "scene.ply")
    (data / "classes.json").write_text(json.dumps({str(k): f"box {k}" for k in range(1, 10)}))
    cameras = room.cameras[::3]
    entries = []
    for i, camera in enumerate(cameras):
        pose = np.linalg.inv(camera.world_to_camera)
        entries.append(
            {"id": i, "img_name": camera.name, "width": camera.width, "height": camera.height, "fx": camera.fx,
             "fy": camera.fy, "position": pose[:3, 3].tolist(), "rotation": pose[:3, :3].tolist()}
        )  # fmt: skip
        image = make_operator(room.scene, camera).render(np.eye(10, dtype=np.float32)[room.truth])
        write_mask(data / "labels" / f"{camera.name}.png", image.argmax(axis=2), 8)
    (data / "cameras.json").write_text(json.dumps(entries))
    with robot.running("segment_node", {"scene_path": str(data / "scene.ply")}):
        fuse(robot, str(data), 2.0)
        segment(robot, "1,000,000 Gaussians, 10 classes", 7)
        seconds, result = robot.learn()
        print(f"learn: {seconds:.1f} s, {result.num_steps} steps on {result.report.num_views} views")
        segment(robot, "the same after learn", 7)


def real_size(robot: Robot, data: Path) -> None:
    """Fuse masks of 1280 x 720 at 5 Hz into 3 million Gaussians of 20 classes, and segment: times, and peak memory."""
    if not data.exists():
        write_room(data, RoomSize(3_000_000, 40, 20, 1280, 720, sh_degree=1))
    with robot.running("segment_node", {"scene_path": str(data / "scene.ply")}) as process:
        fuse(robot, str(data), 5.0)
        segment(robot, "3,000,000 Gaussians, 20 classes", 5)
        status = Path(f"/proc/{process.pid}/status").read_text()
        print(f"peak resident memory of the node: {int(status.split('VmHWM:')[1].split()[0]) / 2**20:.2f} GiB")


def all_handled(status: Mapping[str, str]) -> bool:
    """Tell by `/diagnostics` whether every mask that came was fused or rejected; one in hand waits nowhere."""
    ended = sum(int(count) for key, count in status.items() if key == "views accepted" or key.startswith("rejected "))
    return "/mask received" in status and int(status["/mask received"]) == ended


def topics_of(report: SegmentationReport) -> list[str]:
    """Topics of the classes that have Gaussians; the others have none."""
    return [entry.topic for entry in report.classes if entry.topic]


def _nanoseconds(stamp: Any) -> int:
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


if __name__ == "__main__":
    main()
