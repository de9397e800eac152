"""Jobs of the node that `kills.py` kills: saving its state, exporting, and learning, each asked for over DDS."""

from __future__ import annotations

import os
import shutil
import statistics
import time
from pathlib import Path
from typing import Any

os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"

from forked import THREADS
from kills import Victim, state_faults
from ros_helpers import Ros
from ros_robot import CLASSES, Robot, core_session, renamed
from small_scenes import balls_on_a_table, clean_views
from whole_outputs import Fault, faults_of, hash_of, leftovers, listing, read_folder

from gsseg_core.data.view import View
from gsseg_core.errors import GssegError
from gsseg_core.segmentation import Segmentation

TURNED = (0, 2, 3, 1)
VIEWS = {"first": 3, "second": 30}
"""Views in each of two states, whose masks have other ids, too."""


class NodeVictim(Victim):
    """A node, the folder below which it may write, and two states that it can load there."""

    def __init__(self, folder: Path) -> None:
        self.root = folder / "root"
        self.root.mkdir()
        self.scene, _ = balls_on_a_table()
        self.scene.save(folder / "scene.ply")
        for name, count in VIEWS.items():
            views = renamed(clean_views(6) * (count // 6 or 1))[:count]
            session = core_session(self.scene, views if name == "first" else [turned(view) for view in views])
            session.save(self.root / f"{name}.npz")
        for name in THREADS:  # A node has threads of its own.
            os.environ.pop(name, None)
        self._ros = Ros(folder)
        self._robot = Robot(self._ros)
        self._parameters = {"scene_path": folder / "scene.ply", "data_root": self.root, "class_names": CLASSES}
        self.prepare()

    def prepare(self) -> None:
        """Do the job undisturbed, for comparison."""

    def robot(self) -> Robot:
        """Return the robot of a node that runs; it is started if the last one was killed."""
        process = self._robot.process
        if process is None or not process.running:
            self._robot.started(self._parameters)
        return self._robot

    def load(self, name: str) -> Any:
        """Have the node load one of the states."""
        return self.robot().done("load_state", path=f"{name}.npz")

    def begin(self) -> Any:
        """Ask for the job; returns the future of its answer."""
        raise NotImplementedError

    def seconds(self) -> float:
        times = []
        for _ in range(5):
            self.load("second")
            started = time.perf_counter()
            self._robot.ros.result(self.begin())
            times.append(time.perf_counter() - started)
        return statistics.median(times)

    def kill(self, delay: float) -> bool:
        self.load("second")
        answer = self.begin()
        time.sleep(delay)
        running = not answer.done()
        process = self._robot.process
        assert process is not None
        process.kill()
        return running

    def faults(self) -> list[Fault]:
        return [fault for name, count in VIEWS.items() for fault in self.state_faults(name, {count})]

    def close(self) -> None:
        self._ros.close()

    def state_faults(self, name: str, views: set[int]) -> list[Fault]:
        """Say what is wrong with a saved state."""
        return state_faults(self.root / f"{name}.npz", self.scene, views)


class NodeSaving(NodeVictim):
    """`~/save_state` over an earlier state."""

    def prepare(self) -> None:
        self._save("first")
        self._clean = listing(self.root)

    def begin(self) -> Any:
        return self.robot().send("save_state", path="state.npz")

    def kill(self, delay: float) -> bool:
        self._save("first")
        return super().kill(delay)

    def faults(self) -> list[Fault]:
        return super().faults() + self.state_faults("state", set(VIEWS.values()))

    def faults_after(self) -> list[Fault]:
        answer = self.robot().ask("load_state", path="state.npz")
        return self.faults() + ([("refused", answer.error_msg)] if answer.error_code else [])

    def leftovers(self) -> list[Fault]:
        self._save("first")
        return leftovers(self.root, self._clean)

    def _save(self, name: str) -> None:
        self.load(name)
        self.robot().done("save_state", path="state.npz")


class NodeExporting(NodeVictim):
    """`~/export` into a folder that holds an earlier export of other codes."""

    def prepare(self) -> None:
        self._runs = {}
        for name in VIEWS:
            self._export(name, name)
            self._runs[name] = read_folder(self.root / name)
            shutil.rmtree(self.root / name)
        for name in ("first", "second", "first"):
            self._export(name, "out")
        self._clean = listing(self.root)

    def begin(self) -> Any:
        return self.robot().send("export", directory="out")

    def faults(self) -> list[Fault]:
        return super().faults() + faults_of(self.root / "out", self._runs)

    def faults_after(self) -> list[Fault]:
        try:  # As whoever uses it reads it.
            Segmentation.load(self.root / "out/segmentation.npz", self.scene)
        except GssegError as error:
            return [*self.faults(), ("refused", str(error))]
        return self.faults()

    def leftovers(self) -> list[Fault]:
        self._export("first", "out")
        return leftovers(self.root, self._clean)

    def _export(self, name: str, directory: str) -> None:
        self.load(name)
        self.robot().done("export", directory=directory)


class NodeLearning(NodeVictim):
    """`~/learn` from the views of a state."""

    def prepare(self) -> None:
        self._before = self._files()
        self._clean = listing(self.root)

    def begin(self) -> Any:
        return self.robot().goal().future

    def faults(self) -> list[Fault]:
        after = self._files()
        changed = [name for name in self._before if after.get(name) != self._before[name]]
        return super().faults() + ([("lost", f"changed: {', '.join(changed)}")] if changed else [])

    def faults_after(self) -> list[Fault]:
        count = self.load("second").num_views
        wrong = [("lost", f"the state holds {count} views; expected {VIEWS['second']}")]
        return self.faults() + (wrong if count != VIEWS["second"] else [])

    def leftovers(self) -> list[Fault]:
        self.robot().learn()
        return leftovers(self.root, self._clean)

    def _files(self) -> dict[str, str]:
        return {str(path.relative_to(self.root)): hash_of(path.read_bytes()) for path in self.root.iterdir()}


def turned(view: View) -> View:
    """Give the mask of a view other ids."""
    labels = view.read_labels()
    for before, after in enumerate(TURNED):
        labels[view.read_labels() == before] = after
    return View.from_arrays(view.camera, labels)


NODE_VICTIMS: dict[str, type[NodeVictim]] = {"save": NodeSaving, "export": NodeExporting, "learn": NodeLearning}
