"""A robot's day in one node: replay at 20 Hz, while replay, client and clock start again and requests come at random.

At moments drawn from the seed: the replay or the client is restarted, the simulated clock stops or jumps back, another
scene or a state is loaded, a state is saved, what is known is reset, learnt from, or a learning canceled. Then memory
must be flat, the node's counts must add up, and labels must be those of a fresh session that is given the views kept.

Usage: python benchmarks/robot_day.py [--minutes 60] [--seed 0] [--rate 20] [--folder FOLDER]
Exit code 1 where a bar is missed.
"""

from __future__ import annotations

import argparse
import os
import random
import re
import sys
import tempfile
import threading
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests/helpers"))

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from machine import memory_of
from report import markdown
from ros_helpers import Process, Ros
from ros_robot import CLASSES, Robot
from rosgraph_msgs.msg import Clock
from small_scenes import NAMES, balls_on_a_table, ring, true_labels, write_dataset

from gsseg_core.data.label_images import write_mask
from gsseg_core.learn.learner_state import State
from gsseg_core.live.session import LiveSession
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import Segmentation
from gsseg_ros.client import SegmentationClient
from gsseg_ros.errors import SegmentationError

SCENES = ("table", "other")
VIEWS, MAX_VIEWS, TAUGHT = 12, 200, 24
"""Of the datasets; kept by the node; learnt from."""
PATIENCE = 120.0  # s
FLAT = 0.05
WARM_UP = 0.15
"""Share of the day that does not count for memory."""
ALLOWED = {"BUSY", "NO_CODES", "NO_VIEWS", "CANCELED"}
"""Answers that are no fault: what was asked for could not be had at that moment."""


class SimulatedClock:
    """Publishes /clock, stops, and jumps back."""

    def __init__(self, ros: Ros) -> None:
        self._publisher = ros.node.create_publisher(Clock, "/clock", 10)
        self._base, self._since, self.running = 10_000.0, time.monotonic(), True
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def jump_back(self, seconds: float) -> None:
        """Set time back."""
        self._base = max(1.0, self._now() - seconds)
        self._since = time.monotonic()

    def close(self) -> None:
        """Stop publishing."""
        self._closing.set()
        self._thread.join(5)

    def _now(self) -> float:
        return self._base + time.monotonic() - self._since

    def _run(self) -> None:
        while not self._closing.wait(0.02):
            if self.running:
                now = self._now()
                self._publisher.publish(Clock(clock=Time(sec=int(now), nanosec=int(now % 1 * 1e9))))


@dataclass
class Findings:
    """What was done how often, what was measured, and what was wrong."""

    done: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)
    published: int = 0
    counted: dict[str, int] = field(default_factory=dict)
    memory: list[tuple[float, float]] = field(default_factory=list)  # s, MiB
    rows: list[list[str]] = field(default_factory=list)

    def judge(self, what: str, measured: str, bar: str, met: bool) -> None:
        """Add a row of the table of bars."""
        self.rows.append([what, measured, bar, "met" if met else "**not met**"])


class Day:
    """The node, and all that happens to it."""

    def __init__(self, folder: Path, seed: int, rate: float) -> None:
        self._root, self._rng, self._rate = folder / "root", random.Random(seed), rate
        self.found = Findings()
        for name in SCENES:
            write_noisy_dataset(self._root / name, SCENES.index(name), seed)
        self._ros = Ros(folder)
        self.robot = Robot(self._ros)
        self._clock = SimulatedClock(self._ros)
        parameters = {"data_root": self._root, "class_names": CLASSES, "max_views": MAX_VIEWS, "use_sim_time": True}
        self.robot.started({"scene_path": self._root / "table" / "scene.ply", **parameters}, lossless=False)
        self._scene, self._replay, self._saved = "table", None, set[str]()
        self._client = self._new_client()
        self._begun, self._read = time.monotonic(), 0
        self.play("table")

    # What happens

    def play(self, name: str) -> None:
        """Begin to replay one of the datasets, for ever."""
        parameters = {"data": self._root / name, "rate": self._rate, "loop": 0, "split": "all", "use_sim_time": True}
        self._replay: Process | None = self._ros.start("replay_node", parameters)

    def stop_playing(self) -> None:
        """Stop the replay, wait until the node has handled all that came, and see whether its counts add up."""
        replay, self._replay = self._replay, None
        if replay is None:
            return
        if "replaying" not in replay.output:
            replay.wait_for("replaying", PATIENCE)
        assert replay.stop(PATIENCE) == 0, replay.output
        said = re.search(r"published (\d+) mask", replay.output)
        self.found.published += int(said[1]) if said else 0
        self._ros._processes.remove(replay)
        self._add_up()

    def restart_replay(self) -> None:
        self.stop_playing()
        self.play(self._scene)

    def restart_client(self) -> None:
        self._client.close()
        self._client = self._new_client()
        self._client.segment()

    def jump(self) -> None:
        self._clock.jump_back(self._rng.choice((0.5, 2.0, 60.0, 3600.0)))
        if self._rng.random() < 0.5:
            self.restart_replay()  # Its stamps never go back by themselves.

    def stop_clock(self) -> None:
        self._clock.running = False
        time.sleep(self._rng.uniform(0.5, 3))
        self._clock.running = True

    def load_scene(self) -> None:
        self._scene = self._rng.choice(SCENES)
        self._client.load_scene(f"{self._scene}/scene.ply")
        if self._rng.random() < 0.7:
            self.restart_replay()

    def load_state(self) -> None:
        if self._scene in self._saved:
            self._client.load_state(f"{self._scene}.npz")

    def save_state(self) -> None:
        self._client.save_state(f"{self._scene}.npz")
        self._saved.add(self._scene)

    def reset(self) -> None:
        self._client.reset()

    def segment(self) -> None:
        self._client.segment()

    def learn(self) -> None:
        self._client.learn(num_views=TAUGHT, timeout=PATIENCE)

    def cancel(self) -> None:
        with ThreadPoolExecutor(1) as beside:
            learning = beside.submit(self._client.learn, num_views=TAUGHT, timeout=PATIENCE)
            time.sleep(self._rng.uniform(0, 0.5))
            self._client.cancel()
            learning.result()

    EVENTS = (
        (restart_replay, 3), (restart_client, 2), (jump, 3), (stop_clock, 1), (load_scene, 2), (load_state, 2),
        (save_state, 3), (reset, 2), (segment, 5), (learn, 3), (cancel, 3),
    )  # fmt: skip

    def pass_time(self, seconds: float) -> None:
        """Let things happen for so long."""
        end, told = time.monotonic() + seconds, time.monotonic()
        events, weights = zip(*self.EVENTS, strict=True)
        while time.monotonic() < end:
            self._wait(self._rng.uniform(0.1, 8.0))
            (event,) = self._rng.choices(events, weights)
            self.found.done[event.__name__] += 1
            try:
                event(self)
            except SegmentationError as error:
                self.found.refused[error.name] += 1
                if error.name not in ALLOWED:
                    self._wrong(f"{event.__name__}: {error}")
            except (Exception, pytest.fail.Exception) as error:
                self._wrong(f"{event.__name__}: {type(error).__name__}: {str(error)[:300]}")
            self._clock.running = True
            if self._replay is None:
                self.play(self._scene)
            if time.monotonic() - told > 60:
                told = time.monotonic()
                self._tell()

    # What must hold

    def check_log(self) -> None:
        """No traceback, nothing unforeseen."""
        assert self.robot.process is not None
        output = self.robot.process.output
        lines = [line for line in output.splitlines() if "Traceback" in line or "unexpected" in line]
        lines += [] if self.robot.process.running else ["the node ended"]
        self.found.judge("tracebacks in the node's log", f"{len(lines)} {' '.join(lines[:1])[:120]}", "0", not lines)

    def check_labels(self, learn: bool) -> None:
        """Replay from a reset, or go on and learn; labels are those of a fresh session with the views that are kept."""
        what = "labels after learning" if learn else "labels after a reset"
        if not learn:
            self.stop_playing()
            self._client.load_scene(f"{self._scene}/scene.ply")
            self._client.reset()
        if self._replay is None:
            self.play(self._scene)
        if self._replay is not None:
            self._replay.wait_for("replaying", PATIENCE)
        self._wait((1.5 if learn else 0.5) * MAX_VIEWS / self._rate)
        self._client.wait_for_views(1, PATIENCE)
        self.stop_playing()
        if learn:
            self._client.learn(num_views=TAUGHT, timeout=PATIENCE)
        self._client.save_state("end.npz")
        self._client.export("end", refine=False)
        scene = GaussianScene.load(self._root / self._scene / "scene.ply")
        state = State.load(self._root / "end.npz", scene.digest, len(scene))
        found = Segmentation.load(self._root / "end" / "segmentation.npz", scene)
        fresh = LiveSession(scene, NAMES, max_views=MAX_VIEWS)
        for view in state.views:
            fresh.fuse(view)
        if learn:
            fresh.learn(num_views=TAUGHT)
        self._client.load_state("end.npz")
        self._client.export("again", refine=False)
        again = Segmentation.load(self._root / "again" / "segmentation.npz", scene)
        labels = fresh.codes().argmax(axis=1)
        seen = fresh.codes().any(axis=1)
        differ = int((found.labels != labels)[seen].sum() + (found.labels != again.labels).sum())
        self.found.judge(what, f"{differ} of {len(scene)} differ, {len(state.views)} views", "0 differ", differ == 0)
        if not learn:
            names = {view.name for view in state.views}
            odd = int((_votes(state) != _votes(fresh._live.state())).sum()) if len(names) == fresh.num_fused else -1
            counted = f"{state.num_fused} fused, {len(state.views)} kept, {odd} votes differ"
            met = state.num_fused == len(state.views) == len(names) and odd == 0
            self.found.judge("votes of the views kept", counted, "as many, 0 differ", met)

    def check_memory(self) -> None:
        """Memory at the end against after warm-up, by a line through all that was measured between."""
        end = self.found.memory[-1][0]
        times, sizes = np.array([point for point in self.found.memory if point[0] >= WARM_UP * end]).T
        slope, start = np.polyfit(times, sizes, 1)
        first, last = start + slope * times[0], start + slope * times[-1]
        fifth = max(1, len(sizes) // 5)
        early, late = np.median(sizes[:fifth]), np.median(sizes[-fifth:])
        grown = max((last - first) / first, (late - early) / early)
        measured = f"{100 * grown:+.1f} % (line {first:.0f} to {last:.0f}, medians {early:.0f} to {late:.0f} MiB)"
        self.found.judge("memory, from warm-up to the end", measured, f"at most +{100 * FLAT:.0f} %", grown <= FLAT)

    def check_counts(self) -> None:
        """All counts of the day."""
        counted = self.found.counted
        lost = self.found.published - counted.get("received", 0)
        said = ", ".join(f"{count} {name}" for name, count in counted.items() if count)
        wrong = [text for text in self.found.wrong if text.startswith("counts")]
        met = not wrong and lost >= 0
        self.found.judge("masks", f"{self.found.published} published, {said}, {lost} not delivered", "adds up", met)
        others = [text for text in self.found.wrong if text not in wrong]
        self.found.judge("requests", f"{len(others)} faults", "0", not others)

    def close(self) -> None:
        """Take everything down."""
        self._client.close()
        self._clock.close()
        self._ros.close()

    def _add_up(self) -> None:
        self.robot.received_status.clear()
        idle = ("masks waiting for pose or camera_info", "masks waiting to be fused")
        status = self.robot.wait_for_status(lambda s: all(s.get(key) == "0" for key in idle), "the node to be idle")
        received, accepted = int(status["/mask received"]), int(status["views accepted"])
        rejected = {key: int(count) for key, count in status.items() if key.startswith("rejected ")}
        self.found.counted = {"received": received, "fused": accepted, **rejected}
        if received != accepted + sum(rejected.values()):
            self._wrong(f"counts: {received} received, {accepted} fused, {rejected}")
        if received > self.found.published:
            self._wrong(f"counts: {received} received, {self.found.published} published")

    def _wait(self, seconds: float) -> None:
        """Wait, and note once a second what memory the node has."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            time.sleep(min(left, 1.0))
            assert self.robot.process is not None
            mib = memory_of("VmRSS", self.robot.process.pid) / 2**20
            self.found.memory.append((time.monotonic() - self._begun, mib))

    def _new_client(self) -> SegmentationClient:
        client = SegmentationClient(self.robot.name, domain_id=self._ros.domain, find_timeout=30)
        client.wait_until_active()
        return client

    def _wrong(self, text: str) -> None:
        self.found.wrong.append(text)
        print(f"  {self.found.memory[-1][0] if self.found.memory else 0:.0f} s: {text}", flush=True)

    def _tell(self) -> None:
        seconds, mib = self.found.memory[-1]
        counts = f"{self.found.published} masks published, {sum(self.found.done.values())} events"
        print(f"{seconds / 60:.0f} min: {mib:.0f} MiB, {counts}, {len(self.found.wrong)} faults", flush=True)


def write_noisy_dataset(folder: Path, number: int, seed: int) -> None:
    """Write a dataset whose masks have some objects missed or swapped, so that every view counts in the labels."""
    scene, truth = balls_on_a_table(seed=number)
    if number:
        truth = np.array([0, 2, 3, 1])[truth]
    cameras, rng = ring(VIEWS, turn=0.5 * number), np.random.default_rng([seed, number])
    write_dataset(folder, scene, truth, cameras, NAMES)
    (folder / "split.json").unlink()
    for camera in cameras:
        labels = true_labels(scene, truth, camera)
        noisy = labels.copy()
        for k in range(1, len(NAMES)):
            draw = rng.random()
            if draw < 0.4:
                noisy[labels == k] = 0 if draw < 0.2 else k % 3 + 1
        write_mask(folder / "labels" / f"{camera.name}.png", noisy, 8)


def _votes(state: State) -> np.ndarray:
    return state.votes.dense(state.num_classes)[:, : len(NAMES)]


def main() -> int:
    """Have a day and print the tables; returns 1 where a bar is missed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--minutes", type=float, default=60.0, help="default: %(default)s")
    parser.add_argument("--seed", type=int, default=0, help="default: %(default)s")
    parser.add_argument("--rate", type=float, default=20.0, help="masks per second (default: %(default)s)")
    parser.add_argument("--folder", type=Path, help="keep all files there (default: a temporary folder)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="day-") as name:
        folder = options.folder or Path(name)
        folder.mkdir(parents=True, exist_ok=True)
        day = Day(folder, options.seed, options.rate)
        try:
            day.pass_time(60 * options.minutes)
            day.check_memory()
            day.check_labels(learn=True)
            day.check_labels(learn=False)
            day.check_counts()
            day.check_log()
        finally:
            day.close()
    found = day.found
    print(f"\nseed {options.seed}, {options.minutes:g} minutes at {options.rate:g} masks per second\n")
    print(markdown(["what", "measured", "bar", ""], found.rows) + "\n")
    print(markdown(["event", "times"], [[name, str(count)] for name, count in sorted(found.done.items())]) + "\n")
    print("Answers that were no fault: " + (", ".join(f"{n} {name}" for name, n in found.refused.items()) or "none"))
    print("\n".join(found.wrong[:20]))
    return int(any(row[-1] != "met" for row in found.rows))


if __name__ == "__main__":
    sys.exit(main())
