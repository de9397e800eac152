"""Broken messages and requests for a node that runs, over DDS; part of `fuzz.py`."""

from __future__ import annotations

import argparse
import os
import random
import shutil
import time
from pathlib import Path
from typing import Any

os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"

import numpy as np
import pytest
from broken_messages import broken
from forked import THREADS
from fuzz import LONGEST_LINE, MOST_MEMORY, Ended, Tally, judge
from machine import memory_of
from mutations import any_bytes
from nav_msgs.msg import Odometry
from rclpy.serialization import serialize_message
from ros_helpers import Ros
from ros_robot import CLASSES, KINDS, SERVICES, Learn, Robot, core_session, messages, viewpoint
from sensor_msgs.msg import Image
from small_scenes import balls_on_a_table, clean_views, write_dataset
from whole_outputs import hash_of

from gsseg_core.text import printable

BATCH = 100
"""Inputs after which the node is asked what it knows."""
DEAD = "the node ended"

RAW = 0.1
"""Share of the messages whose serialised bytes are damaged, rather than their fields."""
KEPT = "kept/state.npz"


class FuzzedNode:
    """A node that has learnt something, and the means to see whether it still knows it."""

    def __init__(self, folder: Path, pose_source: str, patience: float) -> None:
        for name in THREADS:  # A node has threads of its own.
            os.environ.pop(name, None)
        self.root, self._backup, self._patience = folder / "root", folder / "backup", patience
        self._make_root(folder)
        self._ros = Ros(folder)
        self.robot = Robot(self._ros)
        self._parameters = {
            "scene_path": self.root / "data" / "scene.ply", "data_root": self.root, "class_names": CLASSES,
            "pose_source": pose_source,
        }  # fmt: skip
        self.views = clean_views(5)
        self._read = 0
        self.start()
        self.known = self.knows()
        self.labels = self.exported()

    def _make_root(self, folder: Path) -> None:
        write_dataset(self.root / "data")
        scene, _ = balls_on_a_table(seed=1)
        for path in (self.root / "other.ply", folder / "outside.ply"):
            scene.save(path)
        core_session(scene, clean_views(1)).save(self.root / "other.npz")
        (self.root / "mine").mkdir()
        (self.root / "mine" / "notes.txt").write_text("mine")
        (self.root / "data" / "mine.json").write_text("{}")
        (self.root / "link").symlink_to(folder)
        (self.root / "loop").symlink_to("loop")
        os.mkfifo(self.root / "fifo")
        for name in ("broken.ply", "broken.npz"):
            (self.root / name).write_text("nothing of the kind")
        core_session(balls_on_a_table()[0], clean_views(5)).save(self.root / KEPT)
        for path in self.users_files():
            target = self._backup / path.relative_to(self.root)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(path, target)
        self._hashes = {path: hash_of(path.read_bytes()) for path in self.users_files()}

    def users_files(self) -> list[Path]:
        """Files below data_root that no request may touch: all that are there at first but for one state."""
        found = [path for path in sorted(self.root.rglob("*")) if path.is_file() and not path.is_symlink()]
        return [path for path in found if "link" not in path.parts and path.name != "other.npz"]

    def start(self) -> None:
        """Start the node, and have it load what it shall know."""
        self.robot.started(self._parameters)
        self._read = 0
        self.reload()

    def reload(self) -> None:
        """Have the node know again what it knew at first."""
        self.robot.done("load_scene", path="data/scene.ply")
        self.robot.done("load_state", path=KEPT)

    def knows(self) -> list[int]:
        """Ask for views and Gaussians of each class, as `~/segment` reports them."""
        report = self._ros.result(self.robot.send("segment"), "segment", self._patience).report
        return [report.num_views, *(summary.num_gaussians for summary in report.classes)]

    def settle(self) -> None:
        """Wait until all that was published has come and is fused or refused: nothing changes from second to second."""
        seen: list[dict[str, str]] = []

        def quiet() -> bool:
            status = self.robot.status()
            self.robot.received_status.clear()
            if not status:
                return False
            seen[:] = [*seen[-1:], {key: text for key, text in status.items() if "received" in key or "waiting" in key}]
            return len(seen) == 2 and seen[0] == seen[1] and status["masks waiting to be fused"] == "0"

        self.robot.ros.wait_until(quiet, "the node to have handled all messages", self._patience)

    def exported(self) -> np.ndarray:
        """Labels as the node exports them."""
        self.robot.done("export", directory="check")
        with np.load(self.root / "check" / "segmentation.npz") as file:
            return np.array(file["labels"])

    def peak(self) -> int:
        """Most memory that the node has had since the last time that this was asked, in bytes."""
        assert self.robot.process is not None
        peak = memory_of("VmHWM", self.robot.process.pid)
        Path(f"/proc/{self.robot.process.pid}/clear_refs").write_text("5")
        return peak

    def complaints(self) -> list[str]:
        """Look for findings in what the node has logged since the last time that this was asked."""
        assert self.robot.process is not None
        said, self._read = self.robot.process.output[self._read :], len(self.robot.process.output)
        if "Traceback" in said:
            return ["in the log: " + judge(Ended(1, True, 0.0, 0, "", said))]
        unforeseen = [line for line in said.splitlines() if "unexpected" in line]
        return [f"in the log: unexpected {unforeseen[0].split('unexpected ', 1)[1][:60]}"] if unforeseen else []

    def changed_files(self) -> list[str]:
        """Files of the user that are not what they were; they are put back."""
        changed = [p for p, h in self._hashes.items() if not p.is_file() or hash_of(p.read_bytes()) != h]
        for path in changed:
            shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)
            path.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(self._backup / path.relative_to(self.root), path)
        return [f"a file of the user was changed: {path.relative_to(self.root)}" for path in changed]

    def answer(self, future: Any) -> Any:
        """Wait for an answer; None where there is none in time, or no node any more."""
        deadline = time.monotonic() + self._patience
        process = self.robot.process
        assert process is not None
        while not future.done():
            if time.monotonic() > deadline or not process.running:
                return None
            time.sleep(0.001)
        return future.result()

    def close(self) -> None:
        """Take everything down."""
        self._ros.close()


def fuzz_node(wanted: list[str], folder: Path, options: argparse.Namespace) -> list[Tally]:
    """Send broken messages and requests of some kinds."""
    tallies = []
    for pose_source in ("topic", "odometry"):
        kinds = [kind for kind in wanted if (kind == "odometry") == (pose_source == "odometry")]
        if not kinds:
            continue
        node = FuzzedNode(folder / pose_source, pose_source, options.patience)
        try:
            tallies += [_fuzzed(kind, node, options) for kind in kinds]
        finally:
            node.close()
    return tallies


def _fuzzed(kind: str, node: FuzzedNode, options: argparse.Namespace) -> Tally:
    tally, started, overlays = Tally(kind), time.monotonic(), None
    node.reload()
    node.peak()
    if kind == "image":  # Pictures are heard while somebody looks at what is made of them.
        overlays = node.robot.ros.node.create_subscription(Image, f"{node.robot.name}/overlay", lambda _: None, 10)
    one = _message if kind in KINDS else _request
    for number in range(options.first, options.first + options.count):
        rng, begun = random.Random(f"{options.seed} {kind} {number}"), time.monotonic()
        outcome = one(kind, node, rng)
        tally.longest = max(tally.longest, time.monotonic() - begun)
        last = number == options.first + options.count - 1
        findings = node.complaints() if kind not in KINDS else []
        if last or (number + 1) % BATCH == 0 or outcome == DEAD:
            findings += _checked(kind, node, tally)
        tally.add(number, findings[0] if findings else outcome)
        for more in findings[1:]:
            tally.causes.setdefault(more, []).append(number)
        if tally.inputs % 200 == 0:
            print(
                f"{kind}: {tally.inputs} inputs, {time.monotonic() - started:.0f} s, {dict(tally.counts)}", flush=True
            )
    if overlays is not None:
        node.robot.ros.node.destroy_subscription(overlays)
    return tally


def _message(kind: str, node: FuzzedNode, rng: random.Random) -> str:
    """Publish a view of which one message is broken; what comes of it shows in the log, and in what the node knows."""
    view = rng.choice(node.views)
    sent = messages(view, node.robot.next_stamp())
    if kind == "odometry":
        pose = sent.pop("pose")
        sent[kind] = Odometry(header=pose.header)
        sent[kind].pose.pose = pose.pose
    elif kind == "image":
        pixels = np.zeros((view.camera.height, view.camera.width, 3), np.uint8)
        height, width = pixels.shape[:2]
        sent[kind] = Image(header=sent["mask"].header, height=height, width=width, encoding="rgb8", step=3 * width)
        sent[kind].data = pixels.tobytes()
    if rng.random() < RAW:
        sent[kind] = any_bytes(serialize_message(sent[kind]), rng)
    else:
        sent[kind] = broken(sent[kind], rng)
    node.robot.publish(sent)
    return "done"


def _request(kind: str, node: FuzzedNode, rng: random.Random) -> str:
    """Send a broken request or goal, and judge its answer."""
    if kind == "learn":
        goal = broken(Learn.Goal(dataset_path=rng.choice(("", "data")), max_steps=2, learner="votes"), rng)
        try:
            sent = node.robot.goal(**_fields(goal))
        except (AssertionError, pytest.fail.Exception):
            return "refused" if node.robot.process is not None and node.robot.process.running else DEAD
        found = node.answer(sent.future)
        answer = found.result if found is not None else None
    else:
        request = SERVICES[kind].Request()
        if kind in ("segment", "render_view"):
            request = SERVICES[kind].Request(**viewpoint(rng.choice(node.views)))
        answer = node.answer(node.robot.send(kind, **_fields(broken(request, rng))))
    if answer is None:
        return "hang" if node.robot.process is not None and node.robot.process.running else DEAD
    if answer.error_code == 0:
        if kind in ("load_scene", "load_state", "learn"):
            node.reload()
        return "done"
    if answer.error_code == type(answer).UNKNOWN:
        return f"answered UNKNOWN: {answer.error_msg[:60]}"
    if len(answer.error_msg) > LONGEST_LINE or answer.error_msg != printable(answer.error_msg):
        return "refused with a line that is long or not printable"
    return "refused"


def _checked(kind: str, node: FuzzedNode, tally: Tally) -> list[str]:
    """See whether the node lives, what it has logged, and whether it knows what it knew."""
    process = node.robot.process
    assert process is not None
    findings = node.changed_files()
    if not process.running:
        findings += [*node.complaints(), DEAD]
        node.start()
        return findings
    try:
        if kind in KINDS:
            node.settle()
        known = node.knows()
        if kind in KINDS and known[0] < node.known[0]:
            findings.append(f"{node.known[0]} views were known, now {known[0]}")
        if kind not in KINDS and known != node.known:
            findings.append("requests that were refused, or change nothing, changed what is known")
        peak = node.peak()
        tally.most_memory = max(tally.most_memory, peak)
        if peak > MOST_MEMORY:
            findings.append("memory: more than 2 GiB")
        node.reload()
        if not np.array_equal(node.exported(), node.labels):
            findings.append("labels of the same state differ from before")
    except (AssertionError, pytest.fail.Exception) as error:
        findings.append(f"no answer: {str(error).splitlines()[0][:90]}")
        process.kill()
        node.start()
    return findings + node.complaints()


def _fields(message: Any) -> dict[str, Any]:
    return {name: getattr(message, name) for name in message.get_fields_and_field_types()}
