"""The scene is put elsewhere in the map while the node is active: views follow, nothing is lost, outputs come anew."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import Point, Pose, Quaternion
from gsseg_msgs.msg import ObjectArray, SegmentationReport
from hypothesis import given
from hypothesis import strategies as st
from patience import PATIENCE
from rcl_interfaces.msg import SetParametersResult
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter
from ros_fixtures import parameters_fixture, root_fixture, scene_fixture, shared_fixture  # noqa: F401
from ros_helpers import Ros, wait_until
from ros_node_here import node_here
from ros_robot import CLASSES, IDENTITY, LATCHED, core_session, messages
from sensor_msgs.msg import PointCloud2
from small_scenes import balls_on_a_table, clean_views

from gsseg_core.data.view import View
from gsseg_core.errors import UnknownLabelError
from gsseg_core.live.living_session import LivingSession
from gsseg_core.live.per_view_session import PerViewSession
from gsseg_core.refine.settings import UNREFINED
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.scene_delta import GroupMove, SceneDelta
from gsseg_core.scene.similarity import Similarity as CoreSimilarity
from gsseg_ros.cloud_messages import arrays_from_cloud
from gsseg_ros.conversions import viewpoint_messages
from gsseg_ros.delta_messages import message_from_delta
from gsseg_ros.errors import BusyError
from gsseg_ros.frames import Similarity
from gsseg_ros.node import services, viewpoints
from gsseg_ros.node.placement import Placement
from gsseg_ros.node.services import AT_WORK, WAITING
from gsseg_ros.node.workspace import Workspace

ASIDE = Similarity.from_parameters(1.0, [0.05, -0.02, 0.03], [0.0, 0.0, 0.02, 1.0])
FAR = Similarity.from_parameters(1.0, [1e4, 0, 0], [0.0, 0.0, 0.0, 1.0])


def placed_views(views: list[View], now: Similarity) -> list[View]:
    """The views as they are once the scene, which lay at the origin, lies elsewhere."""
    return [
        replace(view, camera=replace(view.camera, world_to_camera=now.world_to_camera(
            IDENTITY.camera_in_map(view.camera.world_to_camera))))
        for view in views
    ]  # fmt: skip


def placement_of(session: LivingSession) -> tuple[Placement, list[int]]:
    settled: list[int] = []
    placement = Placement(lambda: session)
    placement.settled = lambda: settled.append(session.num_views)
    return placement, settled


SCENE, _ = balls_on_a_table()


def living_session(views: list[View]) -> LivingSession:
    session = LivingSession(SCENE, dict(enumerate(CLASSES)))
    for view in views:
        assert session.fuse(view) is None
    return session


@given(st.lists(st.sampled_from([ASIDE, FAR, IDENTITY]), min_size=1, max_size=3))
def test_after_any_moves_votes_are_those_of_views_that_came_at_the_last_place(places: list[Similarity]) -> None:
    views = clean_views(3)
    session = living_session(views)
    placement, settled = placement_of(session)
    before, told = IDENTITY, []
    for after in places:
        placement.change(before, after, lambda after=after: told.append(after))  # type: ignore[misc]
        before = after
    wait_until(lambda: not placement._moved_from and settled, "the views to follow")
    assert told == places
    assert session.num_views == session.num_fused == 3
    expected = LivingSession(SCENE, session.class_names)
    for view in placed_views(views, places[-1]):
        expected.fuse(view)
    found = session._live._votes.dense()
    np.testing.assert_allclose(found, expected._live._votes.dense(), rtol=0, atol=2e-3 * abs(found).max() + 1)
    if places[-1] is FAR:
        assert not found.any() and expected.num_fused == 0, "nothing is seen from there, and nothing is lost"
        return
    assert list(session._live.views) == [view.name for view in views]


def test_views_of_a_state_that_is_loaded_meanwhile_stay_where_they_are() -> None:
    views = clean_views(2)
    session = living_session(views)
    codes = session.codes()
    placement, settled = placement_of(session)
    with placement.fusing:
        placement.change(IDENTITY, FAR, lambda: None)
        placement.forget()
    wait_until(lambda: settled, "the thread to end")
    np.testing.assert_array_equal(session.codes(), codes)


def test_views_of_a_state_stay_where_they_are_though_the_scene_is_put_elsewhere_meanwhile(tmp_path: Path) -> None:
    session = living_session(clean_views(2))
    session.save(tmp_path / "state.npz")
    codes, load = session.codes(), session.load
    placement, settled = placement_of(session)

    def moved(path: Path, within: Path | None) -> int:
        with session._lock:  # So that views of these names follow only when those of the state are there.
            placement.change(IDENTITY, FAR, lambda: None)
            return load(path, within)

    session.load = moved  # type: ignore[method-assign]
    workspace: Any = SimpleNamespace(session=session, placement=placement, forget_waiting=lambda: None)
    assert Workspace.load_state(workspace, tmp_path / "state.npz") == 2
    wait_until(lambda: settled, "the thread to end")
    np.testing.assert_array_equal(session.codes(), codes)


def test_a_state_that_is_loaded_between_two_looks_at_what_has_to_follow_ends_it_quietly() -> None:
    session, settled = living_session(clean_views(2)), threading.Event()

    def loaded() -> LivingSession:
        placement.forget()
        return session

    placement = Placement(loaded)
    placement.settled = settled.set
    with placement.fusing:
        placement._moved_from = {name: (IDENTITY, FAR) for name in session.view_names}
        placement._begin()
    assert settled.wait(PATIENCE)


def test_views_of_a_scene_that_is_put_back_before_they_followed_stay_as_they_are() -> None:
    session = living_session(clean_views(2))
    views = session.views
    placement, settled = placement_of(session)
    with placement.fusing:
        placement.change(IDENTITY, FAR, lambda: None)
        placement.change(FAR, IDENTITY, lambda: None)
    wait_until(lambda: settled, "the thread to end")
    assert all(now is before for now, before in zip(session.views, views, strict=True))


def test_a_view_does_not_follow_once_what_is_known_was_replaced() -> None:
    session = living_session(clean_views(1))
    era = session.era
    session.retire()
    assert not session.move_view(session.view_names[0], lambda camera: pytest.fail("moved"), era)  # type: ignore[arg-type]
    assert session.move_view("not kept any more", lambda camera: pytest.fail("moved"), session.era)  # type: ignore[arg-type]


def test_objects_of_ids_per_view_follow_too() -> None:
    views, session = clean_views(3), PerViewSession(SCENE)
    for view in views:
        assert session.fuse(view) is None
    placement, settled = placement_of(session)
    placement.change(IDENTITY, ASIDE, lambda: None)
    wait_until(lambda: settled, "the views to follow")
    kept = [view.camera.world_to_camera for view in session._live.views.values()]
    np.testing.assert_allclose(kept, [view.camera.world_to_camera for view in placed_views(views, ASIDE)])


def test_a_view_that_cannot_follow_is_named_and_follows_the_next_change(monkeypatch: pytest.MonkeyPatch) -> None:
    views = clean_views(3)
    session, move, told = living_session(views), LivingSession.move_view, []

    def move_view(self: LivingSession, name: str, *args: Any) -> bool:
        if name == views[0].name and not told:
            raise UnknownLabelError(f"view '{name}': too many objects")
        return move(self, name, *args)

    monkeypatch.setattr(LivingSession, "move_view", move_view)
    placement, settled = placement_of(session)
    placement.refused = told.append
    for before, after in ((IDENTITY, FAR), (FAR, ASIDE)):
        settled.clear()
        placement.change(before, after, lambda: None)
        wait_until(lambda: settled, "the views to follow")
    name = views[0].name
    assert told == [f"a view cannot follow the scene and stays where it was: view '{name}': too many objects"]
    kept = [view.camera.world_to_camera for view in session.views]
    np.testing.assert_allclose(kept, [view.camera.world_to_camera for view in placed_views(views, ASIDE)], atol=1e-6)


def test_objects_that_nothing_is_seen_of_for_now_lose_their_votes_and_get_them_back() -> None:
    session = PerViewSession(SCENE)
    for view in clean_views(3):
        assert session.fuse(view) is None
    before, order = session.codes(), session.view_names
    placement, settled = placement_of(session)  # type: ignore[arg-type]
    placement.change(IDENTITY, FAR, lambda: None)
    wait_until(lambda: settled, "the views to follow")
    session.repair()
    assert not session.codes().any() and session.view_names == order
    settled.clear()
    placement.change(FAR, IDENTITY, lambda: None)
    wait_until(lambda: settled, "the views to come back")
    assert session.view_names == order and session.num_fused == 3
    np.testing.assert_allclose(session.codes().any(axis=1), before.any(axis=1))


def parameters_of(similarity: Similarity, z: float) -> list[Parameter]:
    return [
        Parameter("scene_to_map.translation", value=similarity.translation.tolist()),
        Parameter("scene_to_map.rotation", value=[0.0, 0.0, z, 1.0]),
        Parameter("scene_to_map.scale", value=similarity.scale),
    ]


def test_while_active_views_follow_and_all_that_is_latched_comes_anew(
    shared: Ros, parameters: dict[str, Any], scene: GaussianScene
) -> None:
    views = clean_views(3)
    with node_here(shared, parameters) as here:
        here.fuse(views)
        first = here.done("segment", skip_refinement=True, classes=["box"]).report
        heard: dict[str, list[Any]] = {"report": [], "cloud": [], "objects": []}
        kinds = {"report": SegmentationReport, "cloud": PointCloud2, "objects": ObjectArray}
        subscriptions = [
            shared.node.create_subscription(kinds[name], f"/gsseg/{name}", seen.append, LATCHED)
            for name, seen in heard.items()
        ]
        for parameter in parameters_of(ASIDE, 0.02):  # One at a time, as `ros2 param set` does.
            (result,) = here.node.set_parameters([parameter])
            assert result.successful, result.reason
        (result,) = here.node.set_parameters([Parameter("scene_to_map.rotation", value=[0.0] * 4)])
        assert not result.successful and "scene_to_map.rotation is all zeros" in result.reason

        def anew() -> bool:
            if not (heard["cloud"] and heard["report"]) or heard["report"][-1].revision <= first.revision:
                return False
            now = here.done("segment", skip_refinement=True, publish_nothing=True).cloud
            return heard["cloud"][-1].data == now.data

        wait_until(anew, "the cloud where the scene is now")
        at = here.node.workspace.session.segmentation(UNREFINED).labels > 0
        points = arrays_from_cloud(heard["cloud"][-1]).points
        moved = ASIDE.points_to_map(scene.means[at])
        np.testing.assert_allclose(np.sort(points, axis=0), np.sort(moved, axis=0), atol=1e-4)
        here.fuse(clean_views(1, "late"))  # Its pose is in the map.
        names = [replace(view, camera=replace(view.camera, name=str(i))) for i, view in enumerate(
            placed_views([*views, *clean_views(1, "late")], ASIDE))]  # fmt: skip
        np.testing.assert_allclose(here.node.workspace.session.codes(), core_session(scene, names).codes(), atol=5e-3)
        for subscription in subscriptions:
            shared.node.destroy_subscription(subscription)


def test_what_is_latched_comes_anew_though_too_many_requests_were_at_work(
    shared: Ros, parameters: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    with node_here(shared, parameters) as here:
        here.fuse(clean_views(2))
        first = here.done("segment", skip_refinement=True).report.revision
        places, tries = here.node._requests.turns._places, []
        monkeypatch.setattr(services, "explain", lambda node, error: tries.append(error) or str(error))
        while places.acquire(blocking=False):
            pass
        here.node.set_parameters_atomically(parameters_of(ASIDE, 0.02))
        wait_until(lambda: tries, "the first try")
        wait_until(lambda: places._cond._waiters, "it waits for room, and does not ask again and again")
        places.release(AT_WORK + WAITING)
        wait_until(lambda: here.outputs._revision > first, "the clouds where the scene is now")
        assert [type(error) for error in tries] == [BusyError], "it asks anew only when there is room"


def test_a_label_image_and_a_cloud_of_one_answer_have_the_scene_in_one_place(
    shared: Ros, parameters: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    segmentation, drawn_at, (pose, info) = LivingSession.segmentation, [], viewpoint_messages(clean_views(1)[0].camera)
    with node_here(shared, parameters) as here:
        here.fuse(clean_views(2))

        def moved(self: LivingSession, *arguments: Any) -> Any:
            here.node.set_parameters_atomically(parameters_of(ASIDE, 0.02))
            return segmentation(self, *arguments)

        def viewpoint(request: Any, settings: Any, lookup: Any) -> Any:
            drawn_at.append(settings.scene_to_map)
            return viewpoints.viewpoint(request, settings, lookup)

        monkeypatch.setattr(LivingSession, "segmentation", moved)
        monkeypatch.setattr(services, "viewpoint", viewpoint)
        here.done("segment", skip_refinement=True, publish_nothing=True, viewpoint_pose=pose, viewpoint_camera=info)
        assert [at is here.node.workspace.settings.scene_to_map for at in drawn_at] == [True]


def test_what_was_published_before_the_node_was_cleaned_up_does_not_come_anew(
    shared: Ros, parameters: dict[str, Any]
) -> None:
    with node_here(shared, parameters) as here:
        here.fuse(clean_views(2))
        here.done("segment", skip_refinement=True)
        assert here.node.trigger_deactivate() == here.node.trigger_cleanup() == TransitionCallbackReturn.SUCCESS
        here.configure()
        here.fuse(clean_views(2))
        here.node.set_parameters_atomically(parameters_of(ASIDE, 0.02))
        wait_until(lambda: here.outputs.objects_count, "the objects where the scene is now")
        assert here.outputs._revision == 0, "clouds that nobody has asked for"


def test_a_scene_is_loaded_to_a_place_of_its_own(
    shared: Ros, parameters: dict[str, Any], scene: GaussianScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    views = clean_views(2)
    with node_here(shared, parameters) as here:
        pose = Pose(position=Point(x=4.0, y=-1.0, z=0.5), orientation=Quaternion(x=0.0, y=0.0, z=0.6, w=0.8))
        for spoil, why in (
            ({"scene_to_map_scale": -1.0}, "scene_to_map_scale is -1; expected 0, or"),
            ({"scene_to_map_scale": float("nan")}, "scene_to_map_scale is nan"),
            ({"scene_to_map_scale": 1e12}, "scene_to_map_scale is 1e\\+12"),
            ({"scene_to_map_scale": 1.0, "scene_to_map": Pose(orientation=Quaternion(w=0.0))}, "all zeros"),
        ):
            refused = here.ask("load_scene", **spoil)
            assert refused.error_code == refused.INVALID_REQUEST
            assert why.replace("\\", "") in refused.error_msg
        asked = {"scene_to_map": pose, "scene_to_map_scale": 2.5}
        with monkeypatch.context() as patch:
            refusal = SetParametersResult(successful=False, reason="not now")
            patch.setattr(here.node, "set_parameters_atomically", lambda wanted: refusal)
            refused = here.ask("load_scene", **asked)
        assert refused.error_code == refused.INVALID_REQUEST and refused.error_msg.endswith("was refused: not now")
        similarity = Similarity.from_parameters(2.5, [4.0, -1.0, 0.5], [0.0, 0.0, 0.6, 0.8])
        response = here.done("load_scene", **asked)
        corner = similarity.points_to_map(scene.means).max(axis=0)
        np.testing.assert_allclose([response.box_max.x, response.box_max.y, response.box_max.z], corner, atol=1e-4)
        assert here.node.get_parameter("scene_to_map.scale").value == 2.5
        for i, view in enumerate(views):
            here.hand(messages(view, here.stamp + i, similarity))
        wait_until(lambda: here.inputs.accepted == 2, "two views")
        np.testing.assert_allclose(here.node.workspace.session.codes(), core_session(scene, views).codes(), atol=1e-4)
        here.done("load_scene")
        assert here.node.get_parameter("scene_to_map.scale").value == 2.5, "a request that says nothing changes nothing"


@pytest.mark.parametrize("fails", ["the place", "the scene"])
def test_to_grow_and_to_be_put_elsewhere_is_all_or_nothing(
    shared: Ros, parameters: dict[str, Any], monkeypatch: pytest.MonkeyPatch, fails: str
) -> None:
    with node_here(shared, parameters) as here:
        here.fuse(clean_views(2))
        session = here.node.workspace.living_session
        before, views = session.living, session.views
        asked = {"keep_votes": True, "scene_to_map": Pose(position=Point(x=4.0)), "scene_to_map_scale": 2.5}
        if fails == "the place":
            refusal = SetParametersResult(successful=False, reason="not now")
            monkeypatch.setattr(here.node, "set_parameters_atomically", lambda wanted: refusal)
        else:
            asked["tolerance"] = -1.0
        refused = here.ask("load_scene", **asked)
        assert refused.error_code == refused.INVALID_REQUEST
        assert ("not now" if fails == "the place" else "tolerance is -1") in refused.error_msg
        assert not here.node.workspace.placement._moved_from, "views have nowhere to go"
        assert here.node.get_parameter("scene_to_map.scale").value == 1.0
        assert here.node.workspace.settings.scene_to_map == IDENTITY
        assert session.living is before and all(now is was for now, was in zip(session.views, views, strict=True))


def test_what_happens_before_all_views_have_followed_leaves_them_where_they_were_measured(
    shared: Ros, parameters: dict[str, Any]
) -> None:
    with node_here(shared, parameters) as here:
        views = clean_views(3)
        here.fuse(views)
        workspace, place = here.node.workspace, ASIDE
        session, stamp = workspace.living_session, workspace.living_session.view_names[1].split("_")[-1]
        (workspace.root / "broken.npz").write_bytes(b"no state")
        far = Similarity.from_parameters(1.0, [9.0, 0, 0], [0.0, 0.0, 0.0, 1.0])
        with workspace.placement.fusing:
            here.node.set_parameters_atomically(parameters_of(place, 0.02))
            refused = here.ask("load_state", path="broken.npz")
            assert refused.error_code == refused.INVALID_FILE
            move = GroupMove(0, CoreSimilarity(translation=np.array([50.0, 0, 0])), (stamp,))
            here.done("update_scene", delta=message_from_delta(SceneDelta(moves=(move,))))
            here.node.set_parameters_atomically(parameters_of(far, 0.0))
            here.node.set_parameters_atomically(parameters_of(place, 0.02))
        wait_until(lambda: not workspace.placement._moved_from, "the views to follow")
        kept = session.views
        assert [view.group for view in kept] == [None, 0, None]
        expected = [view.camera.world_to_camera for view in placed_views(views, place)]
        np.testing.assert_allclose([view.camera.world_to_camera for view in kept], expected, atol=1e-6)
