"""A robot whose map changes while it drives, the node being a process of its own: votes end as the law says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gsseg_msgs.msg import SceneDelta as SceneDeltaMessage
from ros_fixtures import root_fixture  # noqa: F401
from ros_helpers import Ros, ros_fixture  # noqa: F401
from ros_robot import CLASSES, RELIABLE, Robot
from small_scenes import NAMES, balls_on_a_table, clean_views

from gsseg_core.learn.learner_state import State
from gsseg_core.live.living_session import LivingSession
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.scene_delta import GroupMove, SceneDelta
from gsseg_core.scene.similarity import Similarity
from gsseg_ros.delta_messages import delta_from_message, message_from_delta

CHANGES = 8


class Mapper:
    """What builds the map: it changes its own copy, and says how; keyframes are the node's alone."""

    def __init__(self, path: Path, seed: int) -> None:
        self.session = LivingSession(GaussianScene.load(path), NAMES)
        self._rng, self._next_id = np.random.default_rng(seed), 2**40

    def change(self, stamps: list[int]) -> SceneDeltaMessage:
        """Remove some Gaussians, add some of a group of their own, and move a group with three keyframes."""
        rng, living = self._rng, self.session.living
        chosen = np.sort(rng.choice(626, 40, replace=False))
        part = balls_on_a_table(seed=int(rng.integers(99)))[0].subset(chosen)
        ids, self._next_id = np.arange(40) + self._next_id, self._next_id + 40
        turn = Similarity(translation=rng.normal(0, 0.2, 3), scale=float(rng.uniform(0.9, 1.1)))
        keyframes = tuple(str(stamp) for stamp in rng.choice(stamps, 3, replace=False))
        delta = SceneDelta(
            revision=(living.revision or 0) + 1,
            removed=rng.choice(living.ids, 15, replace=False),
            added=part,
            added_ids=ids,
            added_groups=np.full(40, rng.integers(3), np.int64),
            moves=(GroupMove(0, turn, keyframes),),
        )
        message = message_from_delta(delta)
        self.session.update(replace(delta_from_message(message), moves=(GroupMove(0, turn),)))
        return message

    def save_other_robot(self, path: Path) -> None:
        """Save what another robot has learnt of the map as it is now, from 12 views of its own."""
        other = LivingSession(self.session.living, NAMES)
        for view in clean_views(12, turn=0.2):
            assert other.fuse(view) is None
        other.save(path)


@pytest.mark.parametrize("seed", [0, 1])
def test_changes_by_request_and_topic_between_masks_states_and_merging_end_in_the_votes_of_the_views_that_are_kept(
    ros: Ros, root: Path, seed: int
) -> None:
    path = root / "data" / "scene.ply"
    robot = Robot(ros).started({"scene_path": path, "data_root": root, "class_names": CLASSES})
    publisher = ros.node.create_publisher(SceneDeltaMessage, "scene_delta", RELIABLE)
    ros.wait_until(lambda: publisher.get_subscription_count() > 0, "the node's subscription to changes")
    mapper, views, stamps = Mapper(path, seed), clean_views(24, turn=0.3), list[int]()
    for i in range(CHANGES):
        stamps += robot.drive(views[3 * i : 3 * i + 3])  # Some are still under way when a change names them.
        message = mapper.change(stamps)
        if i % 2:
            publisher.publish(message)
            publisher.publish(message)  # It is refused, being out of turn.
        else:
            assert robot.done("update_scene", delta=message).scene_hash == mapper.session.scene.digest
        robot.wait_for_status(lambda s, made=i + 1: s.get("scene changes: made") == str(made), f"change {i + 1}")
        if i == 3:
            mapper.save_other_robot(root / f"other{seed}.npz")
    assert robot.done("merge_states", paths=[f"other{seed}.npz"]).num_merged == 12
    robot.done("save_state", path=f"end{seed}.npz")
    living = mapper.session.living
    first = LivingSession(GaussianScene.load(path))._first
    state = State.load(root / f"end{seed}.npz", living.scene.digest, len(living), None, first)
    fresh = LivingSession(living, NAMES)
    for view in state.views:
        assert fresh.fuse(view) is None
    assert len(state.views) == state.num_fused >= 30 and {view.group for view in state.views} >= {0, None}
    for found, expected in zip(state.votes, fresh._live.state().votes, strict=True):
        np.testing.assert_array_equal(found, expected)
    refused = str(CHANGES // 2)
    robot.wait_for_status(lambda status: status.get("scene changes: refused") == refused, "the refused changes")
