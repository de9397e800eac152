"""Fixtures that the tests of the segmentation node share: a data_root full of files, parameters, a context.

A test file imports those that its tests take:

    from ros_fixtures import parameters_fixture, root_fixture  # noqa: F401
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from ros_helpers import Ros
from ros_robot import CLASSES, copied, core_session, private_ros, write_long_dataset
from small_scenes import balls_on_a_table, clean_views, write_dataset

from gsseg_core.scene import GaussianScene


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
