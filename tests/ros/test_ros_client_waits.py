"""Waits of the client end: by cancel, by Ctrl-C, by time, and where the node is absent or goes away."""

from __future__ import annotations

import signal
import subprocess
import sys
import textwrap
import threading
import time
from concurrent.futures import Future
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from gsseg_msgs.msg import SegmentationReport, StageTiming
from gsseg_msgs.srv import Reset
from patience import PATIENCE
from ros_client_cases import (  # noqa: F401
    FOREVER,
    Background,
    Place,
    failure,
    learning_forever,
    learnt_fixture,
    once_free,
    own_fixture,
    place_fixture,
    says_in_the_end,
    shared_fixture,
    start_node,
)
from ros_helpers import REPOSITORY, Ros, ros_fixture, wait_until  # noqa: F401
from sensor_msgs.msg import PointCloud2
from small_scenes import write_dataset
from std_msgs.msg import Header

from gsseg_ros.client import NodeUnavailableError, SegmentationClient, SegmentationError, calls, connection
from gsseg_ros.client.calls import Calls
from gsseg_ros.client.run_clouds import RunClouds


def test_a_question_whose_answer_is_lost_is_asked_again_for_as_long_as_the_node_is_there() -> None:
    asked: list[Future] = []

    def call_async(question: str) -> Future:
        assert question == "well?"
        asked.append(Future())
        if len(asked) == 3:
            asked[-1].set_result("yes")
        return asked[-1]

    ready = iter([True] * 99)
    client = SimpleNamespace(
        service_is_ready=lambda: next(ready, False), call_async=call_async, remove_pending_request=lambda _: None
    )
    spinner: Any = SimpleNamespace(run=lambda call: call(), wait_for=lambda settled, seconds: settled())
    calls = Calls(spinner, "/gsseg", 1.0)
    assert calls.ask(client, "well?", time.monotonic() + PATIENCE) == "yes" and len(asked) == 3
    ready = iter([True] * 4)
    assert calls.ask(client, "well?", time.monotonic() + PATIENCE) is None
    assert calls.ask(client, "well?", time.monotonic()) is None


def report(second: int, *stages: str) -> SegmentationReport:
    timings = [StageTiming(name=name) for name in stages or ("boxes", "publish")]
    return SegmentationReport(header=Header(stamp=Time(sec=second)), stages=timings)


def test_of_the_clouds_of_requests_that_overlap_without_end_only_the_last_are_kept() -> None:
    node = SimpleNamespace(create_subscription=lambda kind, topic, take, quality: take)
    spinner: Any = SimpleNamespace(node=node, wait_for=lambda condition, _: condition())
    clouds = RunClouds(spinner, "/gsseg/cloud")
    take: Any = clouds._topic
    with clouds.kept():  # One of them is always at work.
        for second in range(1, 1001):
            take(PointCloud2(header=Header(stamp=Time(sec=second))))
            found = clouds.of_run(report(second), time.monotonic())
            assert found is not None and found.header.stamp.sec == second
        assert len(clouds._clouds) < 20
        assert clouds.of_run(report(1), time.monotonic()) is None, "it is asked for again"
        assert clouds.of_run(report(2000, "boxes"), time.monotonic() + PATIENCE) is None, "it was not published"


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
    with SegmentationClient(domain_id=place.ros.domain, find_timeout=PATIENCE) as other:
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
    assert once_free(lambda: place.client.learn("data")).report.num_views == 4


def test_learning_that_takes_too_long_is_canceled(place: Place) -> None:
    with pytest.raises(NodeUnavailableError, match="did not answer in time during learn"):
        place.client.learn("data", **FOREVER, timeout=1.0)
    assert once_free(lambda: place.client.learn("data")).report.num_views == 4


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
        with SegmentationClient(find_timeout={PATIENCE}) as client:
            try:
                client.learn("data", **{FOREVER}, on_feedback=lambda *told: print("told", flush=True))
            except KeyboardInterrupt:
                print("interrupted")
        """,
    )
    assert script.stdout is not None and script.stdout.readline() == "told\n"
    script.send_signal(signal.SIGINT)
    output, _ = script.communicate(timeout=PATIENCE)
    assert script.returncode == 0 and output.endswith("interrupted\n"), output
    assert once_free(lambda: place.client.learn("data")).report.num_views == 4


def test_a_script_that_forgets_to_close_ends_cleanly(place: Place) -> None:
    script = run_script(
        place.ros,
        """
        from gsseg_ros.client import SegmentationClient
        client = SegmentationClient(find_timeout=300)
        client.wait_until_active(300)
        print("active")
        """,
    )
    output, _ = script.communicate(timeout=PATIENCE)
    assert (script.returncode, output) == (0, "active\n")


def test_an_absent_node_is_an_error_that_says_what_to_check(ros: Ros) -> None:
    with SegmentationClient("robot1/gsseg", domain_id=ros.domain, find_timeout=1.0) as client:
        says_in_the_end(lambda: client.wait_until_active(0.5), "nodes seen: /test")
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


def test_what_the_node_says_of_its_views_is_heard_by_every_thread_that_waits_for_them(ros: Ros) -> None:
    with SegmentationClient(domain_id=ros.domain) as client:

        def say(views: int) -> None:
            status = DiagnosticStatus(name="/gsseg", values=[KeyValue(key="views fused", value=str(views))])
            client._spinner.run(lambda: client._on_diagnostics(DiagnosticArray(status=[status])))

        told: list[list[int]] = [[], []]
        waits = [Background(lambda seen=seen: client.wait_for_views(3, PATIENCE, seen.append)) for seen in told]  # type: ignore[misc]
        wait_until(lambda: say(1) or all(told), "both to listen")  # type: ignore[func-returns-value]
        say(3)
        for wait in waits:
            wait.join()
            assert (wait.result, wait.error) == (3, None)


def test_a_node_that_has_fallen_silent_is_not_said_to_fuse(ros: Ros, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection, "SILENT_SECONDS", 0.5)
    with SegmentationClient(domain_id=ros.domain) as client:

        def say() -> None:
            status = DiagnosticStatus(name="/gsseg", message="fusing", values=[KeyValue(key="views fused", value="1")])
            client._spinner.run(lambda: client._on_diagnostics(DiagnosticArray(status=[status])))

        told: list[int] = []
        waiting = Background(lambda: client.wait_for_views(3, 3.0, told.append))
        wait_until(lambda: say() or told, "it to listen")  # type: ignore[func-returns-value]
        waiting.join()
    assert "has fused 1 of 3 views after 3 s, and has said nothing for the last " in str(waiting.error)


def test_a_node_that_is_not_active_is_waited_for_and_its_state_named(ros: Ros, tmp_path: Path) -> None:
    write_dataset(tmp_path / "data")
    node = start_node(ros, tmp_path, autostart=False)
    node.wait_for("waiting to be configured")
    with SegmentationClient(domain_id=ros.domain, find_timeout=PATIENCE) as client:
        says_in_the_end(lambda: client.wait_until_active(1.0), "/gsseg is unconfigured after 1 s; expected active")
        assert failure(client.segment).name == failure(client.learn).name == "NOT_ACTIVE"


def test_a_node_in_a_namespace_is_found_under_its_name(ros: Ros, tmp_path: Path) -> None:
    write_dataset(tmp_path / "data")
    parameters = {"scene_path": tmp_path / "data/scene.ply"}
    ros.start("segment_node", parameters, "-r", "__ns:=/robot1", "-r", "__node:=eyes")
    with SegmentationClient("robot1/eyes", domain_id=ros.domain, find_timeout=PATIENCE) as client:
        client.wait_until_active(PATIENCE)
        assert failure(client.segment).name == "NO_CODES"


def test_a_node_that_hangs_is_not_waited_for_for_ever(own: Place) -> None:
    node, client = own.node, own.client
    assert failure(client.segment).name == "NO_CODES"
    node.send(signal.SIGSTOP)
    with pytest.raises(NodeUnavailableError, match="/gsseg did not answer in time during /gsseg/segment"):
        client.segment(timeout=0.5)
    node.send(signal.SIGCONT)
    assert failure(client.segment).name == "NO_CODES"


def test_a_node_that_is_asked_to_end_cancels_learning_and_says_so(own: Place) -> None:
    node, client = own.node, own.client
    running = learning_forever(client)
    node.send(signal.SIGTERM)
    running.join()
    assert isinstance(running.error, SegmentationError), (running.error, node.output)
    assert running.error.name == "CANCELED" and node.wait() == 0


def test_learning_ends_with_an_error_where_the_node_was_killed_and_started_anew_meanwhile(
    own: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(calls, "SILENT_SECONDS", 0.02)  # Less than lies between two messages of feedback.
    node, client = own.node, own.client
    running = learning_forever(client)
    (goal,) = client._learning  # While it works, to be asked again does not disturb it.
    wait_until(lambda: len(goal._questions) > 20 or running.ended, "questions for the result")
    assert not running.ended, running.error
    node.kill()
    start_node(own.ros, own.folder)
    running.join()
    assert isinstance(running.error, NodeUnavailableError), running.error
    assert "/gsseg went away during learn" in str(running.error)
    client.wait_until_active(PATIENCE)  # The new one answers before it is.
    assert client.learn("data", timeout=PATIENCE).report.num_views == 4


def test_a_service_that_goes_away_unanswered_ends_the_wait(ros: Ros) -> None:
    silent = rclpy.create_node("gsseg", context=ros.context)  # Nobody spins it.
    service = silent.create_service(Reset, "/gsseg/reset", lambda request, response: response)
    with SegmentationClient(domain_id=ros.domain, find_timeout=PATIENCE) as client:
        running = Background(client.reset)
        ros.wait_until(lambda: service.handle.service_take_request(Reset.Request)[0] is not None, "the request")
        silent.destroy_node()
        running.join()
    assert isinstance(running.error, NodeUnavailableError)
    assert "/gsseg went away during /gsseg/reset" in str(running.error)


def test_the_end_of_the_programs_context_ends_the_wait(place: Place) -> None:
    context = rclpy.Context()
    context.init(args=[], domain_id=place.ros.domain)
    client = SegmentationClient(context=context)
    began = threading.Event()
    running = Background(lambda: client.wait_for_views(1_000_000, on_views=lambda _: began.set()))
    assert began.wait(PATIENCE), running.error
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
