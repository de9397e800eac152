"""The end of the segmentation node: by a signal, and by force at any moment."""

from __future__ import annotations

import contextlib
import functools
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from patience import PATIENCE, wait_until
from ros_fixtures import node_fixture, parameters_fixture, root_fixture  # noqa: F401
from ros_helpers import Ros, ros_fixture  # noqa: F401
from ros_robot import Goal, Robot, core_session, renamed
from small_scenes import clean_views

from gsseg_core.data.dataset import Dataset
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import Segmentation
from gsseg_ros.node import segment_node
from gsseg_ros.node.node_executor import NodeExecutor
from gsseg_ros.node.segment_node import SegmentNode


@pytest.mark.parametrize("doing", ["idle", "learning"])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_with_exit_code_zero_whatever_it_does(
    ros: Ros, parameters: dict[str, Any], doing: str, number: signal.Signals
) -> None:
    robot = Robot(ros).started(parameters)
    robot.fuse(clean_views(2))
    if doing == "learning":
        robot.begin(dataset_path="long")
    process = robot.process
    assert process is not None
    process.send(number)
    assert process.wait() == 0, process.output
    assert "Traceback" not in process.output and "[ERROR]" not in process.output, process.output


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_while_it_is_not_configured(
    ros: Ros, parameters: dict[str, Any], number: signal.Signals
) -> None:
    process = Robot(ros).start({**parameters, "autostart": False})
    process.wait_for("autostart is false")
    process.send(number)
    assert process.wait() == 0, process.output


def test_the_last_callback_has_ended_before_the_node_goes(node: SegmentNode) -> None:
    executor, begun = NodeExecutor(node), threading.Event()
    order: list[str] = []

    def callback() -> None:
        begun.set()
        time.sleep(1)
        order.append("callback")

    executor.create_task(callback)
    while not begun.is_set():
        executor.spin_once(0.1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(node, "close", lambda: order.append("node"))
        segment_node._end(executor, node)
    assert order == ["callback", "node"]


@pytest.mark.parametrize("silent", [False, True])
def test_what_a_callback_meets_that_the_node_leaves_behind_is_not_complained_of(
    node: SegmentNode, monkeypatch: pytest.MonkeyPatch, silent: bool
) -> None:
    said: list[str] = []
    executor, begun, gone = NodeExecutor(node), threading.Event(), threading.Event()
    monkeypatch.setattr(executor, "_log", SimpleNamespace(error=said.append))

    def callback() -> None:
        begun.set()
        assert gone.wait(PATIENCE)
        raise ValueError("the node is gone")

    executor.create_task(callback)
    while not begun.is_set():
        executor.spin_once(0.1)
    if silent:
        executor.silence()
    gone.set()
    executor.shutdown()
    assert len(said) == (not silent)


@pytest.fixture(scope="module")
def saved(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Segmentation:
    """Write state.npz, of so many large views that to save it again takes a while; returns what it holds."""
    scene = GaussianScene.load(root / "data" / "scene.ply")
    views = Dataset(root / "long").views()[:6]
    session = core_session(scene, renamed(views * 25))
    session.save(root / "state.npz")
    return session.segmentation()


def at_work(goal: Goal, stage: str, done: int) -> bool:
    return any(message.stage == stage and message.done >= done for message in goal.feedback)


class Saving:
    """A node that saves its state, again and again until it is caught at it."""

    def __init__(self, robot: Robot, root: Path, before: bytes, part: float) -> None:
        self._robot, self._root, self._before, self._least = robot, root, before, part * len(before)
        self._answer = robot.send("save_state", path="state.npz")

    def stopped(self) -> bool:
        """Stop the node if it is in the middle, with so much of the new file written."""
        process = self._robot.process
        assert process is not None
        if self._answer.done():
            (self._root / "state.npz").write_bytes(self._before)
            self._answer = self._robot.send("save_state", path="state.npz")
        if not self._grown():
            return False
        process.send(signal.SIGSTOP)
        wait_until(lambda: process.stopped, "all threads to stop")
        if not self._grown():
            process.send(signal.SIGCONT)
            return False
        return True

    def _grown(self) -> bool:
        with contextlib.suppress(FileNotFoundError):  # It has just got its name.
            return any(path.stat().st_size >= self._least for path in self._root.glob(".gsseg-*.npz"))
        return False


def test_killed_while_it_learns_or_saves_the_earlier_state_loads_in_a_new_process(
    ros: Ros, parameters: dict[str, Any], root: Path, saved: Segmentation
) -> None:
    before = (root / "state.npz").read_bytes()

    learning: list[tuple[str, str, int]] = [("long", "observe", 0), ("long", "observe", 30), ("", "em", 1)]
    for i, moment in enumerate([*learning, 0.0, 0.3, 0.7]):
        # A namespace for each, since what was killed takes a while to be forgotten.
        robot = Robot(ros, f"/killed{i}").started(parameters)
        assert robot.done("load_state", path="state.npz").num_views == 150
        assert robot.process is not None
        if isinstance(moment, tuple):
            dataset, stage, done = moment
            goal = robot.goal(dataset_path=dataset)
            ros.wait_until(functools.partial(at_work, goal, stage, done), f"{stage} {done}")
            robot.process.kill()
        else:
            saving = Saving(robot, root, before, moment)
            ros.wait_until(saving.stopped, "the new file to grow")
            robot.process.kill()
            for left in root.glob(".gsseg-*.npz"):
                left.unlink()
        assert (root / "state.npz").read_bytes() == before

    robot = Robot(ros, "/afterwards").started(parameters)
    assert robot.done("load_state", path="state.npz").num_views == 150
    found = robot.exported(root / "out" / "loaded")
    np.testing.assert_array_equal(found.probabilities, saved.probabilities)


TOLD_WHEN_IT_IS_GONE = """
import sys
from gsseg_ros.node import segment_node

class Told(segment_node.SegmentNode):
    def __del__(self):
        print("the node is gone", flush=True)

segment_node.SegmentNode = Told
sys.exit(segment_node.main())
"""


@pytest.mark.parametrize(("ids", "code"), [("given", 0), ("per-view", 2)])
def test_it_is_gone_before_python_ends(ros: Ros, ids: str, code: int) -> None:
    """Threads of DDS that run on use what Python takes down: once in thousands of ends, that is a crash."""
    parameters = [f"ids:={ids}", "class_names:=['wall', 'ball']", "autostart:=false"]
    arguments = ["--ros-args", *(part for parameter in parameters for part in ("-p", parameter))]
    process = subprocess.Popen(
        [sys.executable, "-c", TOLD_WHEN_IT_IS_GONE, *arguments], env=ros.environment,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    with process, process.stdout as output:
        said = []
        for line in output:
            said.append(line)
            if "waiting to be configured" in line:
                process.terminate()
    assert process.returncode == code, said
    assert said[-1] == "the node is gone\n"
