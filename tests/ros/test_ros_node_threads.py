"""Where memory is too short for another thread, what was begun is finished, and the next time all is as ever."""

from __future__ import annotations

import threading
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
from patience import wait_until
from ros_fixtures import root_fixture  # noqa: F401
from ros_robot import CLASSES, IDENTITY
from small_scenes import balls_on_a_table, clean_views

from gsseg_core.live.living_session import LivingSession
from gsseg_ros.frames import Similarity
from gsseg_ros.node.declarations import DECLARATIONS
from gsseg_ros.node.parameters import Settings
from gsseg_ros.node.placement import Placement
from gsseg_ros.node.workspace import Workspace

ASIDE, FURTHER = (Similarity.from_parameters(1.0, [x, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]) for x in (0.05, 0.1))


def without_thread(patch: pytest.MonkeyPatch, name: str) -> None:
    """Refuse to start the thread of a name."""
    start = threading.Thread.start

    def refuse(thread: threading.Thread) -> None:
        if thread.name == name:
            raise RuntimeError("can't start new thread")
        start(thread)

    patch.setattr(threading.Thread, "start", refuse)


def test_views_follow_the_next_change_of_the_scenes_place_where_no_thread_could_move_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    session = LivingSession(balls_on_a_table()[0], dict(enumerate(CLASSES)))
    for view in clean_views(2):
        assert session.fuse(view) is None
    placement, told, taken, settled = Placement(lambda: session), list[str](), list[Similarity](), list[int]()
    placement.refused, placement.settled = told.append, lambda: settled.append(1)
    with monkeypatch.context() as patch:
        without_thread(patch, "placement")
        placement.change(IDENTITY, ASIDE, lambda: taken.append(ASIDE))
    assert taken == [ASIDE] and len(told) == 1 and "can't start new thread" in told[0]
    placement.change(ASIDE, FURTHER, lambda: taken.append(FURTHER))
    wait_until(lambda: settled, "the views to follow")
    there = [FURTHER.world_to_camera(IDENTITY.camera_in_map(v.camera.world_to_camera)) for v in clean_views(2)]
    assert [view.camera.world_to_camera.tolist() for view in session.views] == [pose.tolist() for pose in there]


@pytest.mark.parametrize("keep_votes", [False, True])
def test_a_scene_is_loaded_though_no_thread_can_prepare_for_the_first_request(
    root: Path, monkeypatch: pytest.MonkeyPatch, keep_votes: bool
) -> None:
    values: dict[str, Any] = {declaration.name: declaration.default for declaration in DECLARATIONS}
    workspace, forgotten = Workspace(Settings.of(values), lambda: None), list[int]()
    path = root / "data" / "scene.ply"
    workspace.load_scene(path, None, nullcontext())
    before = workspace.session
    workspace.forget_waiting = lambda: forgotten.append(1)
    without_thread(monkeypatch, "neighbours")
    if keep_votes:
        assert workspace.grow_scene(path, None, 0.0, nullcontext()).num_carried == len(before.scene)
    else:
        workspace.load_scene(path, None, nullcontext())
        assert workspace.session is not before and forgotten
