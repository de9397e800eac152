"""The node's scene changes under it: by a request, by a topic and by a grown file; and robots come together."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus
from gsseg_msgs.msg import SceneDelta as SceneDeltaMessage
from hypothesis import given, settings
from hypothesis import strategies as st
from patience import PATIENCE
from ros_fixtures import parameters_fixture, root_fixture, scene_fixture, shared_fixture  # noqa: F401
from ros_helpers import Ros, wait_until
from ros_node_here import NodeHere, node_here
from ros_robot import SECOND
from scipy.spatial.transform import Rotation
from small_scenes import balls_on_a_table, clean_views, write_dataset

from gsseg_core.data.dataset import Dataset
from gsseg_core.live.living_session import Changed, LivingSession
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.scene_delta import GroupMove, SceneDelta
from gsseg_core.scene.similarity import Similarity
from gsseg_ros.conversions import stamp_message
from gsseg_ros.delta_messages import delta_from_message, message_from_delta
from gsseg_ros.errors import InvalidRequestError
from gsseg_ros.node import diagnostics, inputs
from gsseg_ros.node.jobs import Job
from gsseg_ros.node.scene_changes import _with_names
from gsseg_ros.replay.growing import GrowingSource

SCENE, _ = balls_on_a_table()
COPY = SceneDelta(
    added=GaussianScene.from_arrays(
        SCENE.means + np.array([0, 0, 1.5]), SCENE.quats, SCENE.scales, SCENE.opacities, SCENE.sh
    ),
    added_ids=np.arange(len(SCENE)) + 2**40,
    added_groups=np.full(len(SCENE), 5, np.int64),
)


@pytest.fixture(scope="module")
def module_here(shared: Ros, tmp_path_factory: pytest.TempPathFactory) -> Iterator[NodeHere]:
    root = tmp_path_factory.mktemp("living")
    SCENE.save(root / "scene.ply")
    with node_here(shared, {"data_root": root, "scene_path": root / "scene.ply"}) as here:
        yield here


@pytest.fixture
def here(module_here: NodeHere) -> NodeHere:
    """A node with its scene as at the start, and four views."""
    module_here.done("load_scene")
    module_here.node.workspace.changes.clear()
    module_here.fuse(clean_views(4))
    return module_here


def votes(session: LivingSession) -> np.ndarray:
    return session._live._votes.dense()


def as_refused(session: LivingSession) -> np.ndarray:
    again = LivingSession(session.living)
    for view in session.views:
        again.fuse(view)
    return votes(again)


def root(here: NodeHere) -> Path:
    return here.node.workspace.root


def status(here: NodeHere) -> DiagnosticStatus:
    return diagnostics.diagnostic_array("gsseg", here.node.workspace, here.inputs, Time(), "").status[0]


def test_a_request_and_the_topic_change_the_scene_and_votes_are_those_of_the_views_in_it(
    here: NodeHere, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = here.node.workspace.living_session
    shown: list[int | None] = []
    monkeypatch.setattr(here.node.inputs.live, "changed", lambda: shown.append(session.living.revision))
    delta = replace(COPY, removed=np.arange(30))
    answer = here.done("update_scene", delta=message_from_delta(delta))
    assert (answer.num_removed, answer.num_added, answer.num_views_lifted) == (30, len(SCENE), 4)
    assert (answer.revision, answer.num_gaussians, answer.scene_hash) == (1, 2 * len(SCENE) - 30, session.scene.digest)
    stamp = session.views[0].name.split("_")[-1]
    move = GroupMove(0, Similarity(translation=np.array([50.0, 0, 0])), (stamp, "17"))
    here.node._changes.on_scene_delta(message_from_delta(SceneDelta(revision=2, moves=(move,))))
    assert session.living.revision == 2 and shown == [1, 2]
    assert [view.group for view in session.views] == [0, None, None, None]
    np.testing.assert_array_equal(votes(session), as_refused(session))
    told = {value.key: value.value for value in status(here).values}
    assert (told["scene changes: made"], told["scene changes: views named and not kept"]) == ("2", "1")
    assert here.done("segment").report.num_gaussians == len(session.scene)


def test_a_change_with_numbers_of_numpy_can_be_sent() -> None:
    move = GroupMove(np.int64(3), Similarity())  # type: ignore[arg-type]
    message = message_from_delta(SceneDelta(np.int64(4), moves=(move,)))  # type: ignore[arg-type]
    assert (message.revision, message.moves[0].group) == (4, 3)


def test_a_keyframe_whose_mask_still_waits_for_its_pose_is_fused_before_the_change_that_names_it(
    here: NodeHere, monkeypatch: pytest.MonkeyPatch
) -> None:
    session, asked, under_way = here.node.workspace.living_session, threading.Event(), here.inputs._stamps_under_way
    monkeypatch.setattr(inputs, "AWAITED_SECONDS", PATIENCE)
    monkeypatch.setattr(here.inputs, "_stamps_under_way", lambda: (under_way(), asked.set())[0])
    (late,) = clean_views(1)
    (stamp,) = here.send([late], ["camera_info", "mask"])
    move = GroupMove(0, Similarity(translation=np.array([50.0, 0, 0])), (str(stamp),))
    delta = message_from_delta(SceneDelta(moves=(move,)))
    change = threading.Thread(target=here.node._changes.on_scene_delta, args=(delta,))
    change.start()
    assert asked.wait(PATIENCE)
    assert session.living.revision is None
    here.send([late], ["pose"], [stamp])
    change.join(PATIENCE)
    assert [view.group for view in session.views] == [None] * 4 + [0]
    assert not here.node.workspace.changes["views named and not kept"]
    np.testing.assert_array_equal(votes(session), as_refused(session))


def test_a_file_changes_the_scene_and_a_grown_one_takes_votes_along(
    here: NodeHere, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = here.node.workspace.living_session
    shown: list[int | None] = []
    monkeypatch.setattr(here.inputs.live, "changed", lambda: shown.append(session.living.revision))
    COPY.save(root(here) / "delta.npz")
    answer = here.done("update_scene", path="delta.npz")
    assert answer.num_added == len(SCENE)
    session.scene.subset(np.arange(10, 2 * len(SCENE))).save(root(here) / "grown.ply")
    loaded = here.done("load_scene", path="grown.ply", keep_votes=True)
    assert (loaded.num_carried, loaded.matched_by) == (2 * len(SCENE) - 10, "id")
    np.testing.assert_array_equal(votes(session), as_refused(session))
    assert here.node.workspace.session is session and session.num_fused == 4
    assert shown == [1, None], "of what is latched objects come anew"
    assert here.ask("load_scene", path="grown.ply", keep_votes=True, tolerance=-1.0).error_code % 100 == 3


@pytest.mark.parametrize(
    ("fields", "code", "message"),
    [
        ({"delta": SceneDeltaMessage(removed=[9999])}, 3, "removes 1 ids that the scene does not have"),
        ({"delta": SceneDeltaMessage(removed=[2**63])}, 3, "expected numbers of at most"),
        ({"delta": SceneDeltaMessage(added_ids=[9999], means=[0.0])}, 3, "means are 1 numbers; expected 3"),
        ({"path": "none.npz"}, 11, "does not exist"),
        ({"path": "scene.ply"}, 12, "is not a scene delta"),
        ({"path": "../x.npz"}, 10, "not below data_root"),
    ],
)
def test_a_change_that_cannot_be_made_is_answered_in_one_line_and_changes_nothing(
    here: NodeHere, fields: dict[str, Any], code: int, message: str
) -> None:
    session = here.node.workspace.living_session
    before = votes(session).copy()
    answer = here.ask("update_scene", **fields)
    assert answer.error_code == 11000 + code and message in answer.error_msg and "\n" not in answer.error_msg
    np.testing.assert_array_equal(votes(session), before)


def test_a_change_whose_scene_was_replaced_while_its_file_was_read_is_not_answered_as_made(
    here: NodeHere, monkeypatch: pytest.MonkeyPatch
) -> None:
    COPY.save(root(here) / "late.npz")

    def late(*_: object) -> SceneDelta:
        here.done("load_scene")
        return COPY

    monkeypatch.setattr(SceneDelta, "load", late)
    answer = here.ask("update_scene", path="late.npz")
    assert answer.error_code == 11003 and "another scene was loaded meanwhile" in answer.error_msg
    assert len(here.node.workspace.session.scene) == len(SCENE) and not here.node.workspace.changes


def test_an_answer_is_of_its_own_change_whatever_another_client_changes_at_once(
    here: NodeHere, monkeypatch: pytest.MonkeyPatch
) -> None:
    session, count = here.node.workspace.living_session, here.node.workspace.count
    monkeypatch.setattr(
        here.node.workspace, "count", lambda c: (count(c), session.update(SceneDelta(removed=np.array([1]))))
    )
    answer = here.done("update_scene", delta=message_from_delta(SceneDelta(removed=np.array([0]))))
    assert session.living.revision == 2
    assert (answer.revision, answer.num_gaussians) == (1, len(SCENE) - 1)
    assert answer.scene_hash == SCENE.subset(np.arange(1, len(SCENE))).digest != session.scene.digest


def test_answers_of_loading_and_merging_are_of_their_own_work_whatever_another_client_asks_next(
    here: NodeHere, monkeypatch: pytest.MonkeyPatch
) -> None:
    workspace = here.node.workspace
    here.done("save_state", path="mine.npz")
    take, classes = workspace.slot.take, list(workspace.session.class_names.values())
    workspace.reset()

    @contextmanager
    def then_another(name: str) -> Iterator[Job]:
        with take(name) as job:
            yield job
        workspace.reset()

    monkeypatch.setattr(workspace.slot, "take", then_another)
    loaded, merged = here.done("load_state", path="mine.npz"), here.done("merge_states", paths=["mine.npz"])
    assert loaded.class_names == merged.class_names == classes and merged.num_views == 4


def test_a_run_whose_views_were_replaced_meanwhile_says_that_it_was_not_published(
    here: NodeHere, monkeypatch: pytest.MonkeyPatch
) -> None:
    stages = [stage.name for stage in here.done("segment").report.stages]
    number = here.node.workspace.number
    monkeypatch.setattr(here.node.workspace, "number", lambda run: (here.node.workspace.reset(), number(run)))
    again = here.done("segment").report
    assert stages[-1] == "publish" not in [stage.name for stage in again.stages]


def test_a_stamp_names_the_newest_views_that_carry_it_and_no_round_of_time() -> None:
    names = [
        "0a_0_0",
        "0a_0_0_2",
        "0a_0_5000",
        "0a_1_0",
        "0a_left_0_7000",
        "0a_cam_1_0_7000",
        "x",
        "0b_0_5000",
        "0b_0_5000_2",
    ]
    known: Any = SimpleNamespace(view_names=names)

    def named(*views: str) -> tuple[str, ...]:
        return _with_names(SceneDelta(moves=(GroupMove(0, Similarity(), views),)), known, {"0a", "0b"}).moves[0].views

    assert named("0") == ("0a_1_0",)
    assert named("5000", "x") == ("0b_0_5000", "0b_0_5000_2", "x")
    assert named("7000") == ("0a_left_0_7000", "0a_cam_1_0_7000")
    assert named("1", "2") == ("1", "2")


def test_a_delta_out_of_turn_is_complained_of_once_and_changes_nothing(
    here: NodeHere, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    monkeypatch.setattr(here.node._changes, "_complain", said.append)
    session = here.node.workspace.living_session
    for revision in (7, 9, 8):
        message = message_from_delta(SceneDelta(revision=revision, removed=np.array([revision])))
        here.node._changes.on_scene_delta(message)
    assert len(said) == 1 and said[0].startswith(
        "topic scene_delta: its revision is 9; expected 8, as the scene is at 7"
    )
    assert here.node.workspace.changes["refused"] == 1 and len(session.scene) == len(SCENE) - 2
    assert here.node.workspace.refused_change[1] == said[0]
    np.testing.assert_array_equal(votes(session), as_refused(session))


def test_a_delta_of_the_topic_that_is_being_made_is_waited_for_before_the_node_is_inactive(
    here: NodeHere, monkeypatch: pytest.MonkeyPatch
) -> None:
    session, begun, made = here.node.workspace.living_session, threading.Event(), threading.Event()
    update = session.update

    def slowly(delta: SceneDelta) -> Changed:
        begun.set()
        made.wait(1.0)  # Until the node is inactive, if it does not wait.
        return update(delta)

    monkeypatch.setattr(session, "update", slowly)
    message = message_from_delta(SceneDelta(removed=np.array([0])))
    change = threading.Thread(target=here.node._changes.on_scene_delta, args=(message,))
    change.start()
    assert begun.wait(PATIENCE)
    here.node.trigger_deactivate()
    revision = session.living.revision
    made.set()
    change.join(PATIENCE)
    here.node.trigger_activate()
    assert revision == 1, "it is made when the node is inactive already"


def test_states_of_other_robots_are_added_exactly(here: NodeHere) -> None:
    session = here.node.workspace.living_session
    other, alone = LivingSession(SCENE), votes(session).copy()
    for view in clean_views(4):
        other.fuse(view)
    other.save(root(here) / "one.npz")
    answer = here.done("merge_states", paths=["one.npz"])
    assert (answer.num_merged, answer.num_views) == (4, 8)
    np.testing.assert_array_equal(votes(session), 2 * alone)
    here.fuse(clean_views(1))
    more = votes(session).copy()
    assert here.ask("merge_states", paths=["one.npz"]).error_code == 11112  # It is here already.
    np.testing.assert_array_equal(votes(session), more)
    assert here.ask("merge_states").error_code == 11103
    assert here.ask("merge_states", paths=["scene.ply"]).error_code == 11112


def test_a_stamp_names_the_nodes_own_views_though_views_of_another_robot_with_that_stamp_were_merged(
    here: NodeHere, shared: Ros
) -> None:
    own, session = here.node.workspace.living_session.view_names, here.node.workspace.living_session
    stamp = own[0].split("_")[-1]
    with node_here(shared, {"data_root": root(here), "scene_path": root(here) / "scene.ply"}) as other:
        other.stamp = int(stamp)
        other.fuse(clean_views(4))
        other.done("save_state", path="other.npz")
    here.done("merge_states", paths=["other.npz"])
    assert sum(name.endswith(stamp) for name in session.view_names) == 2
    for again in (False, True):
        if again:
            here.node.trigger_deactivate()
            here.node.trigger_activate()
        here.done("update_scene", delta=message_from_delta(SceneDelta(moves=(GroupMove(0, Similarity(), (stamp,)),))))
        assert [view.name for view in session.views if view.group == 0] == own[:1]


def test_a_node_that_finds_objects_itself_refuses_changes_and_says_why(shared: Ros, parameters: dict[str, Any]) -> None:
    del parameters["class_names"]
    with node_here(shared, {**parameters, "ids": "per-view"}) as here:
        for service, fields in (("update_scene", {}), ("merge_states", {"paths": ["x"]})):
            answer = here.ask(service, **fields)
            assert answer.error_code % 100 == 3 and "the parameter ids is per-view" in answer.error_msg


def test_a_scene_that_arrives_in_submaps_ends_as_if_it_had_been_there_from_the_start(
    here: NodeHere, tmp_path: Path
) -> None:
    here.done("load_scene")
    session = here.node.workspace.living_session
    source = GrowingSource(write_dataset(tmp_path / "data"), "labels", "all", "camera", "map")
    stamps, masks = itertools.count(here.stamp, SECOND // 10), 0
    before = here.inputs.accepted
    for group in source:
        stamp = stamp_message(next(stamps))
        for topic, message in group.messages:
            message.header.stamp = stamp
            if topic == "scene_delta":
                wait_until(lambda m=masks: here.inputs.accepted == before + m, "the masks so far")
                here.node._changes.on_scene_delta(message)
            else:
                here.hand({topic: message})
                masks += topic == "mask"
    here.stamp = next(stamps)
    assert here.node.workspace.changes["made"] == 6 and not here.node.workspace.changes["refused"]
    assert session.num_views == masks == 6
    assert sorted({view.group for view in session.views if view.group is not None}) == [1, 2, 3, 4]
    np.testing.assert_array_equal(votes(session), as_refused(session))
    places = session.living.places(np.arange(len(SCENE)))
    np.testing.assert_allclose(session.scene.means[places], SCENE.means, atol=1e-4)
    whole = LivingSession(SCENE)
    for view in Dataset(tmp_path / "data").views():
        whole.fuse(view)
    assert (session.codes()[places].argmax(axis=1) == whole.codes().argmax(axis=1)).mean() > 0.98


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.booleans(), st.floats(0.1, 10))
def test_a_delta_goes_through_a_message_unchanged(seed: int, adds: bool, scale: float) -> None:
    rng = np.random.default_rng(seed)
    motion = Similarity(scale, Rotation.random(random_state=seed).as_matrix(), rng.normal(size=3))
    delta = replace(COPY if adds else SceneDelta(), revision=int(rng.integers(1, 2**62)),
                    removed=rng.choice(2**40, 5, replace=False), moves=(GroupMove(3, motion, ("a", "b")),))  # fmt: skip
    again = delta_from_message(message_from_delta(delta))
    np.testing.assert_array_equal(again.removed, delta.removed)
    np.testing.assert_array_equal(again.added_ids, delta.added_ids)
    np.testing.assert_array_equal(again.added_groups, delta.added_groups)
    np.testing.assert_allclose(again.moves[0].motion.rotation, motion.rotation, atol=1e-12)
    assert (again.revision, again.moves[0].motion.scale, again.moves[0].views) == (delta.revision, scale, ("a", "b"))
    if adds:
        np.testing.assert_array_equal(again.added.means, COPY.added.means)
        np.testing.assert_allclose(again.added.opacities, COPY.added.opacities, atol=1e-6)
    with pytest.raises(InvalidRequestError):
        message = message_from_delta(delta)
        message.moves[0].motion.rotation.w = float("nan")
        delta_from_message(message)
