"""The client library against a real node in another process: results as arrays, errors by name, waits that end."""

from __future__ import annotations

import signal
import subprocess
import sys
import textwrap
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ros_helpers import REPOSITORY, Process, Ros, ros_fixture  # noqa: F401
from small_scenes import NAMES, balls_on_a_table, ring, write_dataset

pytest.importorskip("gsseg_msgs.msg", reason="gsseg_msgs is not installed")

import rclpy
from gsseg_msgs.srv import Reset
from rclpy.signals import SignalHandlerOptions

from gsseg_core.cameras import Camera
from gsseg_core.dataset import Dataset, View
from gsseg_core.errors import IntrinsicsError, PoseError
from gsseg_core.pictures import palette
from gsseg_core.segmentation import Segmentation
from gsseg_ros.client import NodeUnavailableError, SegmentationClient, SegmentationError, Viewpoint

FOREVER: dict[str, Any] = {"learner": "gradient", "max_steps": 10_000_000}
"""A goal that does not come to its end while a test waits."""


def start_node(ros: Ros, folder: Path, **parameters: Any) -> Process:
    names = list(NAMES.values())
    parameters = {"data_root": folder, "class_names": names, **parameters}
    return ros.start("segment_node", {"scene_path": folder / "data/scene.ply", **parameters})


class Place:
    """A node that is active, a client, and a dataset `data` below the node's data_root."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        write_dataset(folder / "data")
        self.ros = Ros(folder)
        self.node = start_node(self.ros, folder)
        self.client = SegmentationClient(domain_id=self.ros.domain)

    @property
    def views(self) -> list[View]:
        return Dataset(self.folder / "data").views("all")

    def close(self) -> None:
        self.client.close()
        self.ros.close()


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Place]:
    folder = tmp_path_factory.mktemp("client")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        patch.setenv("ROS_LOG_DIR", str(folder / "ros_log"))
        place = Place(folder)
        place.client.wait_until_active()
        yield place
        place.close()


@pytest.fixture
def place(shared: Place) -> Place:
    """The node without views and codes."""
    shared.client.load_scene("data/scene.ply")
    return shared


@pytest.fixture
def learnt(place: Place) -> Place:
    place.client.learn("data")
    return place


class Background:
    """A call in a thread of its own, and what came of it."""

    def __init__(self, function: Callable[[], Any]) -> None:
        self.result: Any = None
        self.error: BaseException | None = None
        self._function = function
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def join(self) -> None:
        self._thread.join(30)
        assert not self._thread.is_alive(), "the call does not return"

    def _run(self) -> None:
        try:
            self.result = self._function()
        except BaseException as error:
            self.error = error


def learning_forever(client: SegmentationClient) -> Background:
    """A `learn` that is under way."""
    began = threading.Event()
    running = Background(lambda: client.learn("data", **FOREVER, on_feedback=lambda *_: began.set()))
    assert began.wait(30), running.error
    return running


def failure(call: Callable[[], Any]) -> SegmentationError:
    with pytest.raises(SegmentationError) as caught:
        call()
    return caught.value


# Results


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


def test_threshold_and_refinement_are_as_asked_for(learnt: Place) -> None:
    everything, sure = learnt.client.segment(refine=False), learnt.client.segment(refine=False, min_confidence=0.95)
    assert everything.report.k == 0 and not everything.report.filtered
    assert 0 < len(sure.points) < len(everything.points) and sure.confidence.min() >= np.float32(0.95)
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
    assert place.client.wait_for_views(4, on_views=counts.append) == 4
    assert counts[-1] == 4 and counts == sorted(counts)
    assert replay.wait() == 0
    assert place.client.segment().report.learner == "votes"
    assert place.client.reset() == 4
    with pytest.raises(NodeUnavailableError, match=r"has fused 0 of 1 views after 1\.5 s; it says: "):
        place.client.wait_for_views(1, timeout=1.5)


# Errors


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


# Cancel


def test_cancel_from_another_thread_ends_learning_and_changes_nothing(learnt: Place) -> None:
    before = learnt.client.segment().points
    running = learning_forever(learnt.client)
    assert len(learnt.client.segment().points) == len(before)  # It answers meanwhile.
    assert learnt.client.cancel()
    running.join()
    assert isinstance(running.error, SegmentationError) and running.error.name == "CANCELED"
    np.testing.assert_array_equal(learnt.client.segment().points, before)
    assert not learnt.client.cancel()


def test_a_second_learn_is_refused_while_one_runs(place: Place) -> None:
    running = learning_forever(place.client)
    with SegmentationClient(domain_id=place.ros.domain) as other:
        assert failure(lambda: other.learn("data")).name == "BUSY"
        assert failure(other.reset).name == "BUSY"
        assert not other.cancel()  # It is not this client's.
    place.client.cancel()
    running.join()


def test_an_error_in_the_feedback_cancels_and_comes_out(place: Place) -> None:
    def complain(*_: object) -> None:
        raise LookupError("enough")

    with pytest.raises(LookupError, match="enough"):
        place.client.learn("data", **FOREVER, on_feedback=complain)
    assert place.client.learn("data").report.num_views == 4


def test_learning_that_takes_too_long_is_canceled(place: Place) -> None:
    with pytest.raises(NodeUnavailableError, match="did not answer in time during learn"):
        place.client.learn("data", **FOREVER, timeout=1.0)
    assert place.client.learn("data").report.num_views == 4


def run_script(ros: Ros, text: str) -> subprocess.Popen[str]:
    environment = {**ros.environment, "PYTHONPATH": str(REPOSITORY)}
    return subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(text)], env=environment, text=True, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )  # fmt: skip


def test_ctrl_c_in_a_plain_script_cancels_learning(place: Place) -> None:
    script = run_script(
        place.ros,
        f"""
        from gsseg_ros.client import SegmentationClient
        with SegmentationClient() as client:
            try:
                client.learn("data", **{FOREVER}, on_feedback=lambda *told: print("told", flush=True))
            except KeyboardInterrupt:
                print("interrupted")
        """,
    )
    assert script.stdout is not None and script.stdout.readline() == "told\n"
    script.send_signal(signal.SIGINT)
    output, _ = script.communicate(timeout=30)
    assert script.returncode == 0 and output.endswith("interrupted\n"), output
    assert place.client.learn("data").report.num_views == 4


def test_a_script_that_forgets_to_close_ends_cleanly(place: Place) -> None:
    script = run_script(
        place.ros,
        """
        from gsseg_ros.client import SegmentationClient
        client = SegmentationClient()
        client.wait_until_active()
        print("active")
        """,
    )
    output, _ = script.communicate(timeout=60)
    assert (script.returncode, output) == (0, "active\n")


# Who is there


def test_an_absent_node_is_an_error_that_says_what_to_check(ros: Ros) -> None:
    with SegmentationClient("robot1/gsseg", domain_id=ros.domain, find_timeout=1.0) as client:
        # So that the two have found each other.
        ros.wait_until(lambda: "gsseg_client" in ros.node.get_node_names(), "the client")
        for call, what in (
            (client.segment, "service /robot1/gsseg/segment"),
            (client.learn, "action /robot1/gsseg/learn"),
            (lambda: client.wait_until_active(0.5), "service /robot1/gsseg/get_state"),
            (lambda: client.wait_for_views(1, 0.5), "its status on /diagnostics"),
        ):
            with pytest.raises(TimeoutError) as caught:
                call()
            assert isinstance(caught.value, NodeUnavailableError)
            message = str(caught.value)
            assert message.startswith(f"/robot1/gsseg: {what} was not there within ")
            assert f"ROS_DOMAIN_ID ({ros.domain})" in message and message.endswith("nodes seen: /test")


def test_a_node_that_is_not_active_is_waited_for_and_its_state_named(ros: Ros, tmp_path: Path) -> None:
    write_dataset(tmp_path / "data")
    node = start_node(ros, tmp_path, autostart=False)
    node.wait_for("waiting to be configured")
    with SegmentationClient(domain_id=ros.domain) as client:
        with pytest.raises(NodeUnavailableError, match="/gsseg is unconfigured after 1 s; expected active"):
            client.wait_until_active(1.0)
        assert failure(client.segment).name == "NOT_ACTIVE"


def test_a_node_in_a_namespace_is_found_under_its_name(ros: Ros, tmp_path: Path) -> None:
    write_dataset(tmp_path / "data")
    parameters = {"scene_path": tmp_path / "data/scene.ply"}
    ros.start("segment_node", parameters, "-r", "__ns:=/robot1", "-r", "__node:=eyes")
    with SegmentationClient("robot1/eyes", domain_id=ros.domain) as client:
        client.wait_until_active()
        assert failure(client.segment).name == "NO_CODES"


def test_a_node_that_hangs_is_not_waited_for_for_ever(ros: Ros, tmp_path: Path) -> None:
    write_dataset(tmp_path / "data")
    node = start_node(ros, tmp_path)
    with SegmentationClient(domain_id=ros.domain) as client:
        client.wait_until_active()
        node.send(signal.SIGSTOP)
        with pytest.raises(NodeUnavailableError, match="/gsseg did not answer in time during /gsseg/segment"):
            client.segment(timeout=0.5)
        node.send(signal.SIGCONT)
        assert failure(client.segment).name == "NO_CODES"


def test_a_node_that_is_asked_to_end_cancels_learning_and_says_so(ros: Ros, tmp_path: Path) -> None:
    write_dataset(tmp_path / "data")
    node = start_node(ros, tmp_path)
    with SegmentationClient(domain_id=ros.domain) as client:
        client.wait_until_active()
        running = learning_forever(client)
        node.send(signal.SIGTERM)
        running.join()
        assert isinstance(running.error, SegmentationError) and running.error.name == "CANCELED"
        assert node.wait() == 0


def test_a_service_that_goes_away_unanswered_ends_the_wait(ros: Ros) -> None:
    silent = rclpy.create_node("gsseg", context=ros.context)  # Nobody spins it.
    service = silent.create_service(Reset, "/gsseg/reset", lambda request, response: response)
    with SegmentationClient(domain_id=ros.domain) as client:
        running = Background(client.reset)
        ros.wait_until(lambda: service.handle.service_take_request(Reset.Request)[0] is not None, "the request")
        silent.destroy_node()
        running.join()
    assert isinstance(running.error, NodeUnavailableError)
    assert "/gsseg went away during /gsseg/reset" in str(running.error)


# Beside other things of ROS


def test_it_lives_in_a_context_of_the_program_and_leaves_that_as_it_is(place: Place) -> None:
    with SegmentationClient(context=place.ros.context) as client:
        client.wait_until_active()
        assert client.learn("data").report.num_views == 4
    assert place.ros.context.ok()
    with pytest.raises(ValueError, match="both context and domain_id"):
        SegmentationClient(context=place.ros.context, domain_id=1)


def test_it_lives_beside_the_default_context_of_the_program(place: Place) -> None:
    domain = place.ros.domain
    rclpy.init(args=[], domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = rclpy.create_node("program")
        with SegmentationClient(domain_id=domain) as client:
            client.wait_until_active()
        assert rclpy.ok()
        node.destroy_node()
    finally:
        rclpy.shutdown()
    assert place.client.learn("data").report.num_views == 4


def test_the_end_of_the_programs_context_ends_the_wait(place: Place) -> None:
    context = rclpy.Context()
    context.init(args=[], domain_id=place.ros.domain)
    client = SegmentationClient(context=context)
    began = threading.Event()
    running = Background(lambda: client.wait_for_views(1_000_000, on_views=lambda _: began.set()))
    assert began.wait(30), running.error
    context.try_shutdown()
    running.join()
    assert isinstance(running.error, RuntimeError) and "its ROS context was shut down" in str(running.error)
    client.close()


def test_a_closed_client_says_so_and_can_be_closed_again(place: Place) -> None:
    client = SegmentationClient(domain_id=place.ros.domain)
    client.close()
    client.close()
    with pytest.raises(RuntimeError, match="is closed"):
        client.segment()
