"""Fixtures that the tests of the segmentation node share: a data_root full of files, parameters, a context.

A test file imports those that its tests take:

    from ros_fixtures import parameters_fixture, root_fixture  # noqa: F401
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from rclpy.parameter import Parameter
from ros_datasets import copied, write_long_dataset
from ros_helpers import PATIENCE, Ros, private_ros
from ros_robot import CLASSES, Robot, core_session
from small_scenes import balls_on_a_table, clean_views, write_dataset

from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_ros.node import segment_node
from gsseg_ros.node.node_executor import NodeExecutor
from gsseg_ros.node.segment_node import SegmentNode


@pytest.fixture(name="root", scope="module")
def root_fixture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data_root with all sorts of files in it, and one beside it that is out of bounds."""
    top = tmp_path_factory.mktemp("top")
    root = top / "root"
    data = write_dataset(root / "data")
    write_long_dataset(root / "long")
    scene, _ = balls_on_a_table(seed=1)
    scene.save(root / "other.ply")
    scene.save(top / "outside.ply")
    (root / "link").symlink_to(top)
    (root / "loop").symlink_to("loop")
    core_session(scene, clean_views(1)).save(root / "other_state.npz")
    for name in ("broken.ply", "broken.npz"):
        (root / name).write_text("nothing of the kind")
    (root / "taken.npz").mkdir()
    (root / "taken").mkdir()
    (root / "taken" / "classes").write_text("in the way")
    leaking = copied(data, root / "leaking") / "labels" / "view1.png"
    leaking.rename(top / "view1.png")
    leaking.symlink_to(top / "view1.png")
    broken = copied(data, root / "broken") / "labels" / "view1.png"
    broken.write_bytes(broken.read_bytes()[:60])
    for mask in (copied(data, root / "unlabelled") / "labels").iterdir():
        mask.unlink()
    return root


@pytest.fixture(name="scene", scope="module")
def scene_fixture(root: Path) -> GaussianScene:
    """The scene of the balls on their table."""
    return GaussianScene.load(root / "data" / "scene.ply")


@pytest.fixture(name="parameters", scope="module")
def parameters_fixture(root: Path) -> dict[str, Any]:
    """Parameters of a node that has this scene and its class names."""
    return {"scene_path": root / "data" / "scene.ply", "data_root": root, "class_names": CLASSES}


@pytest.fixture(name="shared", scope="module")
def shared_fixture(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Ros]:
    """A context for the nodes of a whole test file; `ros` is one for a single test."""
    with private_ros(tmp_path_factory.mktemp("ros")) as ros:
        yield ros


@pytest.fixture(name="running", scope="module")
def running_fixture(shared: Ros, parameters: dict[str, Any]) -> Robot:
    """A node in a process of its own, active, for a whole test file."""
    return Robot(shared).started(parameters)


@pytest.fixture(name="idle", scope="module")
def idle_fixture(shared: Ros, parameters: dict[str, Any]) -> Robot:
    """A node in a process of its own that does not start by itself, for a whole test file."""
    robot = Robot(shared)
    robot.start({**parameters, "autostart": False}).wait_for("autostart is false")
    return robot


@pytest.fixture(name="robot")
def idle_robot_fixture(idle: Robot) -> Robot:
    """That node, not configured, whatever the test before has made of it."""
    return idle.brought_down()


@pytest.fixture(name="node")
def node_fixture(ros: Ros, parameters: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> Iterator[SegmentNode]:
    """A node in this process, not configured, that does not compile anything and that nobody spins yet."""
    monkeypatch.setattr(segment_node, "warm_up", lambda *_: None)
    overrides = [Parameter(name, value=str(v) if isinstance(v, Path) else v) for name, v in parameters.items()]
    node = SegmentNode(context=ros.context, parameter_overrides=overrides)
    yield node
    node.close()


@contextmanager
def spun(node: SegmentNode) -> Iterator[None]:
    """Spin a node of this process as its program does."""
    executor, stop = NodeExecutor(node), threading.Event()

    def spin() -> None:
        while not stop.is_set():
            executor.spin_once(0.1)

    spinning = threading.Thread(target=spin)
    spinning.start()
    try:
        yield
    finally:
        stop.set()
        spinning.join(PATIENCE)
        executor.shutdown()
