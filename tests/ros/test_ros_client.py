"""The client library against a real node in another process: results as arrays, errors by name."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import rclpy
from gsseg_msgs.action import Learn
from patience import PATIENCE
from rclpy.signals import SignalHandlerOptions
from ros_client_cases import (  # noqa: F401
    FOREVER,
    Background,
    Place,
    failure,
    learnt_fixture,
    place_fixture,
    says_in_the_end,
    shared_fixture,
)
from ros_helpers import wait_until
from scene_files import write_glb, write_gsplat, write_ksplat
from small_scenes import NAMES, balls_on_a_table, ring

from gsseg_core.errors import IntrinsicsError, PoseError
from gsseg_core.export.pictures import palette
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.scene_delta import SceneDelta
from gsseg_core.segmentation import Segmentation
from gsseg_ros.client import SegmentationClient, SegmentationError, Viewpoint


def test_learning_tells_its_progress_in_the_callers_thread_and_what_it_came_to(place: Place) -> None:
    told: list[tuple[str, int, int, float]] = []
    threads = set()

    def on_feedback(stage: str, done: int, total: int, loss: float) -> None:
        told.append((stage, done, total, loss))
        threads.add(threading.current_thread())

    result = place.client.learn("data", on_feedback=on_feedback)
    assert threads == {threading.current_thread()}
    assert told[0][:3] == ("observe", 0, 4) and {stage for stage, *_ in told} >= {"observe", "em"}
    assert result.report.num_views == 4 and result.num_steps > 0
    assert np.isfinite(result.loss)
    assert {"observe", "learn"} <= result.seconds.keys() and min(result.seconds.values()) >= 0


def test_of_feedback_nothing_is_lost_while_the_client_stands_still(place: Place) -> None:
    told: list[int] = []
    go_on = threading.Event()
    heard = place.ros.collect(Learn.Impl.FeedbackMessage, "/gsseg/learn/_action/feedback", 1000)
    learning = Background(lambda: place.client.learn("data", **FOREVER, on_feedback=lambda *of: told.append(of[1])))
    wait_until(lambda: len(told) > 10 and heard, "feedback")
    place.client._spinner._executor.create_task(lambda: go_on.wait(PATIENCE))
    before = len(heard)
    wait_until(lambda: len(heard) > before + 30, "more feedback than is kept by default")
    go_on.set()
    sent = [message.feedback.done for message in heard[before : before + 30]]
    wait_until(lambda: told[-1] > sent[-1], "the client to catch up")
    assert set(sent) <= set(told)
    assert place.client.cancel()
    learning.join()
    assert isinstance(learning.error, SegmentationError) and learning.error.name == "CANCELED"


def test_fewer_views_and_steps_are_as_asked_for(place: Place) -> None:
    result = place.client.learn("data", "em", num_views=3, max_steps=1)
    assert (result.report.num_views, result.num_steps, result.converged) == (3, 1, False)


def test_every_object_comes_as_arrays(learnt: Place) -> None:
    scene, truth = balls_on_a_table()
    where = {tuple(point): i for i, point in enumerate(scene.means.tolist())}
    result = learnt.client.segment()
    count = len(result.points)
    assert result.points.shape == (count, 3) and result.points.dtype == np.float32
    assert result.labels.shape == (count,) and result.labels.dtype == np.int32
    assert result.confidence.shape == (count,) and result.confidence.dtype == np.float32
    assert result.rgb.shape == (count, 3) and result.rgb.dtype == np.uint8
    assert list(result.objects) == [NAMES[k] for k in (1, 2, 3)]
    assert sum(len(thing.points) for thing in result.objects.values()) == count
    for summary in result.report.classes[1:]:
        thing = result.objects[summary.name]
        assert (thing.class_id, thing.name, len(thing.points)) == (
            summary.class_id,
            summary.name,
            summary.num_gaussians,
        )
        true = truth[[where[tuple(point)] for point in thing.points.tolist()]] == thing.class_id
        assert true.mean() > 0.7
        np.testing.assert_array_equal(thing.color, palette(4)[thing.class_id])
        assert (thing.confidence > 0).all() and (thing.confidence <= 1).all()
        low, high = thing.box
        assert (low <= thing.centroid).all() and (thing.centroid <= high).all()
        corner = summary.box_max
        np.testing.assert_allclose(high, [corner.x, corner.y, corner.z], atol=1e-6)
    assert result.label_image is None
    assert "publish" in result.seconds


def test_a_viewpoint_gets_its_label_image(learnt: Place) -> None:
    view = learnt.views[2]
    image = learnt.client.segment(viewpoint=Viewpoint.of(view.camera)).label_image
    assert image is not None and image.dtype == np.int32
    assert (image == view.read_labels()).mean() > 0.97


def test_only_the_classes_asked_for_come_by_name_or_number(learnt: Place) -> None:
    client = learnt.client
    assert list(client.segment(["box", 1]).objects) == ["red ball", "box"]
    assert list(client.segment("box").objects) == ["box"]
    assert len(client.segment(["background"]).points) == 0


def test_an_answer_for_one_caller_is_what_would_be_published(learnt: Place) -> None:
    published = learnt.client.segment(["box", 1])
    alone = learnt.client.segment(["box", 1], publish=False)
    np.testing.assert_array_equal(alone.points, published.points)
    np.testing.assert_array_equal(alone.labels, published.labels)
    assert list(alone.objects) == ["red ball", "box"] and "publish" not in alone.seconds


def test_an_object_is_picked_by_a_mask_or_by_points_of_a_view(learnt: Place) -> None:
    _, truth = balls_on_a_table()
    view = learnt.views[0]
    labels = (view.read_labels() == 1).astype(np.int32)
    place = Viewpoint.of(view.camera)
    picked = learnt.client.pick(place, labels)
    assert (truth[picked.indices] == 1).mean() > 0.9 and len(picked.points) == len(picked.indices)
    assert picked.oriented_box is not None and (picked.confidence >= 0.5).all() and "pick" in picked.seconds
    rows, columns = np.nonzero(labels)
    clicked = learnt.client.pick(place, inside=[(np.median(columns), np.median(rows))])
    assert np.isin(picked.indices, clicked.indices).mean() > 0.5
    assert failure(lambda: learnt.client.pick(place)).name == "INVALID_REQUEST"


def test_threshold_and_refinement_are_as_asked_for(learnt: Place) -> None:
    everything, sure = learnt.client.segment(refine=False), learnt.client.segment(refine=False, min_confidence=0.95)
    assert everything.report.k == 0 and not everything.report.filtered
    assert 0 < len(sure.points) < len(everything.points) and sure.confidence.min() >= np.float32(0.95)
    assert failure(lambda: learnt.client.segment(refine="sand")).name == "INVALID_REQUEST"
    unfiltered = learnt.client.segment(filter=False).report
    assert unfiltered.k > 0 and not unfiltered.filtered


def test_each_of_several_threads_gets_the_cloud_of_its_own_request(learnt: Place) -> None:
    def ask(k: int) -> list[set[int]]:
        return [set(learnt.client.segment([k]).labels.tolist()) for _ in range(8)]

    calls = {k: Background(lambda k=k: ask(k)) for k in (1, 2, 3)}
    for k, call in calls.items():
        call.join()
        assert call.error is None and call.result == [{k}] * 8


def test_a_view_is_drawn_with_confidence_and_picture_on_request(learnt: Place) -> None:
    view = learnt.views[0]
    plain = learnt.client.render_view(Viewpoint.of(view.camera))
    assert plain.confidence is None and plain.overlay is None and "render" in plain.seconds
    assert (plain.labels == view.read_labels()).mean() > 0.97
    full = learnt.client.render_view(
        Viewpoint.of(view.camera), refine=False, filter=False, with_confidence=True, with_overlay=True
    )
    assert full.confidence is not None and full.overlay is not None
    assert full.confidence.shape == full.labels.shape == (view.camera.height, view.camera.width)
    assert full.confidence.dtype == np.float32 and 0.5 < full.confidence.max() <= 1
    assert full.overlay.shape == (*full.labels.shape, 3) and full.overlay.std() > 10


def test_what_was_learnt_can_be_saved_forgotten_and_loaded(learnt: Place) -> None:
    client, before = learnt.client, learnt.client.segment()
    saved = client.save_state("kept/state.npz")
    assert saved.path == learnt.folder / "kept/state.npz" and saved.num_bytes == saved.path.stat().st_size
    assert saved.num_views == 4
    scene = client.load_scene()
    assert scene.path == learnt.folder / "data/scene.ply" and scene.num_gaussians == len(balls_on_a_table()[0])
    assert scene.digest == balls_on_a_table()[0].digest and (scene.box[0] < scene.box[1]).all()
    assert failure(client.segment).name == "NO_CODES"
    loaded = client.load_state(saved.path)
    assert loaded.class_names == NAMES and loaded.num_views == 4 and loaded.path == saved.path
    np.testing.assert_array_equal(client.segment().points, before.points)
    client.reset()
    assert failure(client.segment).name == "NO_CODES"


def test_the_scene_is_changed_and_grown_and_states_are_added(learnt: Place) -> None:
    client, count = learnt.client, len(balls_on_a_table()[0])
    client.save_state("one.npz")
    merged = client.merge_states("one.npz")
    assert (merged.class_names, merged.num_merged) == (NAMES, merged.num_views)
    changed = client.update_scene(SceneDelta(removed=np.arange(30)))
    assert (changed.revision, changed.num_removed, changed.num_gaussians) == (1, 30, count - 30)
    SceneDelta(removed=np.arange(30, 40)).save(learnt.folder / "delta.npz")
    again = client.update_scene("delta.npz")
    assert (again.revision, again.num_gaussians) == (2, count - 40) and again.digest != changed.digest
    assert client.segment().report.num_gaussians == count - 40
    grown = client.load_scene("data/scene.ply", keep_votes=True)
    assert (grown.num_carried, grown.matched_by, grown.num_gaussians) == (count - 40, "position", count)
    assert failure(lambda: client.update_scene(SceneDelta(revision=9, removed=np.array([-1 + 2**62])))).name == (
        "INVALID_REQUEST"
    )


def test_scenes_of_other_formats_are_loaded_learnt_and_segmented(place: Place) -> None:
    client, scene = place.client, balls_on_a_table()[0]
    client.learn("data", "votes")
    expected = client.segment()
    for name, write in (("a.glb", write_glb), ("a.ksplat", write_ksplat(0)), ("a.pt", write_gsplat)):
        write(place.folder / name, scene)
        loaded = client.load_scene(name)
        assert loaded.path == place.folder / name and loaded.num_gaussians == len(scene)
        assert failure(client.segment).name == "NO_CODES"
        client.learn("data", "votes")
        result = client.segment()
        assert list(result.objects) == list(expected.objects)
        for thing in expected.objects.values():
            assert len(result.objects[thing.name].points) == pytest.approx(len(thing.points), rel=0.02)
    refused = failure(lambda: client.load_scene("data/cameras.json", keep_votes=True))
    assert refused.name == "INVALID_FILE"
    assert client.segment().report.scene_hash == loaded.digest


def test_an_export_says_which_files_it_wrote(learnt: Place) -> None:
    exported = learnt.client.export("out", ["box"])
    assert exported.folder == learnt.folder / "out"
    assert [path.name for path in exported.files] == ["segmentation.npz", "3_box.ply", "report.json"]
    assert all(path.is_file() for path in exported.files)
    labels = Segmentation.load(exported.files[0], balls_on_a_table()[0]).labels
    assert (labels == 3).sum() == exported.report.classes[0].num_gaussians
    assert "write" in exported.seconds


def test_views_are_awaited_and_counted_and_forgotten(place: Place) -> None:
    counts: list[int] = []
    replay = place.ros.start("replay_node", {"data": place.folder / "data", "rate": 50.0})
    assert place.client.wait_for_views(4, PATIENCE, counts.append) == 4
    assert counts[-1] == 4 and counts == sorted(counts)
    assert replay.wait() == 0
    assert place.client.segment().report.learner == "votes"
    assert place.client.reset() == 4
    said = "has fused 0 of 1 views after 1.5 s; it says: "
    says_in_the_end(lambda: place.client.wait_for_views(1, timeout=1.5), said)


def test_an_error_of_the_node_has_code_name_and_message(place: Place) -> None:
    error = failure(place.client.segment)
    assert (error.code, error.name) == (10205, "NO_CODES")
    assert str(error).startswith("NO_CODES (10205): no view has been fused")


@pytest.mark.parametrize(
    ("name", "call"),
    [
        ("NO_CODES", lambda client: client.render_view(Viewpoint.of(ring(1)[0]))),
        ("NO_CODES", lambda client: client.save_state()),
        ("NO_CODES", lambda client: client.export()),
        ("NO_VIEWS", lambda client: client.learn()),
        ("INVALID_REQUEST", lambda client: client.learn("data", "guess")),
        ("INVALID_REQUEST", lambda client: client.segment(min_confidence=2)),
        ("FILE_NOT_FOUND", lambda client: client.learn("nowhere")),
        ("FILE_NOT_FOUND", lambda client: client.load_state("nowhere.npz")),
        ("PATH_NOT_ALLOWED", lambda client: client.load_scene("/etc/passwd")),
        ("INVALID_FILE", lambda client: client.load_scene("data/cameras.json")),
    ],
)
def test_errors_have_the_same_name_for_every_request(
    place: Place, name: str, call: Callable[[SegmentationClient], Any]
) -> None:
    error = failure(lambda: call(place.client))
    assert error.name == name and error.code > 10000 and len(str(error)) > len(name) + 10


def test_an_unknown_class_is_named(learnt: Place) -> None:
    error = failure(lambda: learnt.client.segment(["teapot"]))
    assert error.name == "UNKNOWN_CLASS" and "teapot" in str(error)


def test_what_cannot_be_sent_is_refused_at_once(place: Place) -> None:
    with pytest.raises(ValueError, match="num_views is -1"):
        place.client.learn(num_views=-1)
    with pytest.raises(PoseError, match="viewpoint"):
        Viewpoint(2 * np.eye(4), np.eye(3), 8, 8)
    with pytest.raises(IntrinsicsError, match="width is 0"):
        Viewpoint(np.eye(4), np.eye(3), 0, 8)


def test_a_viewpoint_is_the_camera_that_it_was_made_of() -> None:
    camera = ring(3)[1]
    there = Viewpoint.of(camera).camera
    assert isinstance(there, Camera) and (there.width, there.height) == (camera.width, camera.height)
    np.testing.assert_allclose(there.world_to_camera, camera.world_to_camera, atol=1e-12)
    np.testing.assert_array_equal(there.K, camera.K)


def test_it_lives_in_a_context_of_the_program_and_leaves_that_as_it_is(place: Place) -> None:
    with SegmentationClient(context=place.ros.context, find_timeout=PATIENCE) as client:
        client.wait_until_active(PATIENCE)
        assert client.learn("data").report.num_views == 4
    assert place.ros.context.ok()
    with pytest.raises(ValueError, match="both context and domain_id"):
        SegmentationClient(context=place.ros.context, domain_id=1)


def test_it_lives_beside_the_default_context_of_the_program(place: Place) -> None:
    domain = place.ros.domain
    rclpy.init(args=[], domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = rclpy.create_node("program")
        with SegmentationClient(domain_id=domain, find_timeout=PATIENCE) as client:
            client.wait_until_active(PATIENCE)
        assert rclpy.ok()
        node.destroy_node()
    finally:
        rclpy.shutdown()
    assert place.client.learn("data").report.num_views == 4
