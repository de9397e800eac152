"""The end of the segmentation node: by a signal, and by force at any moment."""

from __future__ import annotations

import functools
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ros_fixtures import parameters_fixture, root_fixture  # noqa: F401
from ros_helpers import Ros, ros_fixture  # noqa: F401
from ros_robot import Goal, Robot, core_session, renamed
from small_scenes import clean_views

from gsseg_core.data.dataset import Dataset
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import Segmentation

pytest.importorskip("gsseg_msgs.msg", reason="gsseg_msgs is not installed")


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


def test_killed_while_it_learns_or_saves_the_earlier_state_loads_in_a_new_process(
    ros: Ros, parameters: dict[str, Any], root: Path, saved: Segmentation
) -> None:
    before = (root / "state.npz").read_bytes()

    def written() -> list[int]:
        return [path.stat().st_size for path in root.glob(".gsseg-*.npz")]

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
            assert not goal.future.done()
            robot.process.kill()
        else:
            least = moment * len(before)
            answer = robot.send("save_state", path="state.npz")
            ros.wait_until(lambda least=least: any(size >= least for size in written()), "the new file to grow")
            robot.process.kill()
            assert not answer.done()
            assert written(), "it was killed before it was done"
            for left in root.glob(".gsseg-*.npz"):
                left.unlink()
        assert (root / "state.npz").read_bytes() == before

    robot = Robot(ros, "/afterwards").started(parameters)
    assert robot.done("load_state", path="state.npz").num_views == 150
    found = robot.exported(root / "out" / "loaded")
    np.testing.assert_array_equal(found.probabilities, saved.probabilities)
