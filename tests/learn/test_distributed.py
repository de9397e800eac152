"""Distributed learning equals local learning bit for bit, whatever happens to the workers."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from patience import PATIENCE
from small_scenes import NUM_CLASSES, balls_on_a_table, taught, with_clutter, write_dataset, wrong_views

from gsseg_core.cli.main import main
from gsseg_core.data.dataset import Dataset
from gsseg_core.data.view import View
from gsseg_core.errors import MaskFormatError, SchedulerError
from gsseg_core.learn.distributed import dask_cluster as scheduler
from gsseg_core.learn.em.em_learner import EMLearner, EMSettings
from gsseg_core.learn.learner import Learner
from gsseg_core.learn.vote_learner import VoteLearner
from gsseg_core.scene.gaussian_scene import GaussianScene

distributed = pytest.importorskip("distributed", reason="Dask is not installed")
dask = pytest.importorskip("dask")

from gsseg_core.learn.distributed.dask_learners import DistributedEM, DistributedVotes  # noqa: E402

SCENE, _ = balls_on_a_table()
VIEWS = wrong_views(7)
VIEWS[4] = with_clutter(VIEWS[4])
SETTINGS = EMSettings(max_steps=6, tolerance=0.0)

Told = tuple[str, int, int]


@contextmanager
def three_workers() -> Iterator[str]:
    """The address of a scheduler with three workers, each a process of one thread, which come back when killed."""
    patient = {f"distributed.comm.timeouts.{name}": f"{PATIENCE:g}s" for name in ("connect", "tcp")}
    with (
        dask.config.set(patient),
        distributed.LocalCluster(
            processes=True, n_workers=3, threads_per_worker=1, dashboard_address="127.0.0.1:0", silence_logs=50
        ) as cluster,
    ):
        yield cluster.scheduler_address


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """Workers for all tests that leave them as they were."""
    with three_workers() as address:
        yield address


@pytest.fixture
def client(address: str) -> Iterator[Any]:
    with scheduler.connected(address) as client:
        yield client


@pytest.fixture
def client_of_victims() -> Iterator[Any]:
    """Workers of one test's own, which kills them: how soon they come back is nothing to the other tests."""
    with three_workers() as address, scheduler.connected(address) as client:
        yield client


def assert_same(one: Learner, other: Learner) -> None:
    for learner in (one, other):
        learner.fit()
    np.testing.assert_array_equal(one._votes, other._votes)
    np.testing.assert_array_equal(one.codes_, other.codes_)
    np.testing.assert_array_equal(one.observed_, other.observed_)
    assert one.history_ == other.history_ and one.converged_ == other.converged_
    assert one.rejected == other.rejected and list(one.views) == list(other.views)
    if isinstance(one, EMLearner) and isinstance(other, EMLearner):
        assert list(one.error_models_) == list(other.error_models_)
        for name, model in one.error_models_.items():
            np.testing.assert_array_equal(model.confusion, other.error_models_[name].confusion)
            np.testing.assert_array_equal(model.evidence.informative, other.error_models_[name].evidence.informative)


@pytest.mark.parametrize("kind", ["em", "votes"])
def test_soft_and_partial_masks_on_workers_give_the_same_bit_for_bit(client: Any, kind: str) -> None:
    views = []
    for i, view in enumerate(VIEWS):
        labels = view.read_labels()
        chances = np.stack([np.where(labels == k, 0.8, 0.2 / 3) for k in range(NUM_CLASSES)])
        some = View.from_arrays(view.camera, np.where(labels == 1 + i % 3, labels, 0), supervised=[1 + i % 3])
        views.append([view, some, View.from_probabilities(view.camera, chances)][i % 3])
    there = DistributedEM(client, SCENE, NUM_CLASSES) if kind == "em" else DistributedVotes(client, SCENE, NUM_CLASSES)
    here = EMLearner(SCENE, NUM_CLASSES) if kind == "em" else VoteLearner(SCENE, NUM_CLASSES)
    there.observe_all(views)
    assert_same(there, taught(here, views))


def with_a_useless_one() -> list[View]:
    return [*VIEWS[:3], View.from_arrays(VIEWS[3].camera, np.full((48, 64), -1, np.int32)), *VIEWS[4:]]


@pytest.mark.parametrize("errors", [True, False])
def test_em_on_workers_equals_em_here_bit_for_bit(client: Any, errors: bool) -> None:
    settings = EMSettings(errors=errors)
    there = DistributedEM(client, SCENE, NUM_CLASSES, settings)
    there.observe_all(with_a_useless_one())
    here = EMLearner(SCENE, NUM_CLASSES, settings)
    here.observe_all(with_a_useless_one())
    assert_same(there, here)
    assert there.reject_summary() == {"all pixels unknown": 1}
    assert there.error_models_[VIEWS[4].name].evidence.informative.all() != errors  # the clutter is not heard


def test_votes_on_workers_equal_votes_here_as_views_come_and_go(client: Any) -> None:
    there, here = DistributedVotes(client, SCENE, NUM_CLASSES - 2), VoteLearner(SCENE, NUM_CLASSES - 2)
    for learner in (there, here):
        learner.grow(NUM_CLASSES)
        learner.observe_all(VIEWS[:4])
        assert learner.observe(VIEWS[5])
        learner.retract(VIEWS[1].name)
        assert learner.observe(View.from_arrays(VIEWS[2].camera, VIEWS[3].read_labels()))
    assert_same(there, here)


def test_without_memory_for_prepared_views_the_result_is_the_same(client: Any) -> None:
    there = DistributedEM(client, SCENE, NUM_CLASSES, SETTINGS, memory_budget=0)
    there.observe_all(VIEWS)
    assert_same(there, taught(EMLearner(SCENE, NUM_CLASSES, SETTINGS), VIEWS))


def test_fewer_views_than_workers_are_enough(client: Any) -> None:
    there = DistributedEM(client, SCENE, NUM_CLASSES, SETTINGS)
    there.observe_all(VIEWS[:1])
    assert_same(there, taught(EMLearner(SCENE, NUM_CLASSES, SETTINGS), VIEWS[:1]))


@contextmanager
def changed(client: Any, workers: Iterable[str], module: str, name: str, value: Any) -> Iterator[None]:
    """Replace something in workers while the body runs, as `monkeypatch` does here."""

    def change() -> None:
        import importlib

        there = importlib.import_module(module)
        there.kept_for_later = getattr(there, name)
        setattr(there, name, value)

    def undo() -> None:
        import importlib

        there = importlib.import_module(module)
        if hasattr(there, "kept_for_later"):  # Not so in a worker that has taken the place of a killed one.
            setattr(there, name, there.kept_for_later)
            del there.kept_for_later

    client.run(change, workers=list(workers))
    yield
    client.run(undo)


@pytest.mark.parametrize("many", [1, 3], ids=["one", "all"])
def test_the_views_of_killed_workers_are_done_again_elsewhere(
    client_of_victims: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, many: int
) -> None:
    client = client_of_victims
    monkeypatch.setattr(scheduler, "PATIENCE", PATIENCE)
    here = taught(EMLearner(SCENE, NUM_CLASSES, SETTINGS), VIEWS).fit()
    there = DistributedEM(client, SCENE, NUM_CLASSES, SETTINGS)
    there.observe_all(VIEWS)
    victims = dict(list(client.run(os.getpid).items())[:many])
    killed: list[int] = []
    marks = str(tmp_path)

    def mix(*_: object) -> None:  # In place of a kernel: says that it is at work, and then works on and on.
        import os
        import time
        from pathlib import Path

        Path(marks, str(os.getpid())).touch()
        time.sleep(60)

    lull = changed(client, victims, "gsseg_core.learn.em.em_learner", "mix", mix)
    steps: list[int] = []

    def kill_at_work(stage: str, done: int, total: int) -> None:
        if done == 2 and 2 not in steps:
            lull.__enter__()  # For good: these workers do not outlive the step.
        steps.append(done)
        # One at work is enough: what was meant for the others may have been handed to it by the scheduler.
        if any(tmp_path.iterdir()) and not killed:
            killed.extend(victims.values())
            for process in killed:
                os.kill(process, signal.SIGKILL)

    there.fit(kill_at_work)
    assert len(killed) == many and steps[-1] == SETTINGS.max_steps
    np.testing.assert_array_equal(there.codes_, here.codes_)
    assert there.history_ == here.history_
    client.wait_for_workers(1, timeout=PATIENCE)
    assert_same(there, here)  # Where all were killed, by workers that came back.


def test_a_worker_killed_while_views_are_observed_changes_nothing(client_of_victims: Any) -> None:
    client = client_of_victims
    process = next(iter(client.run(os.getpid).values()))
    told: list[Told] = []

    def kill(*call: Any) -> None:
        if not told:
            os.kill(process, signal.SIGKILL)
        told.append(call)

    there = DistributedVotes(client, SCENE, NUM_CLASSES)
    there.observe_all(VIEWS, kill)
    assert told[-1] == ("observe", len(VIEWS), len(VIEWS))
    assert_same(there, taught(VoteLearner(SCENE, NUM_CLASSES), VIEWS))


class EnoughError(Exception):
    """Raised by who listens to the progress."""


def test_whoever_listens_can_end_the_work_and_begin_anew(client: Any) -> None:
    there = DistributedEM(client, SCENE, NUM_CLASSES, SETTINGS)

    def stop(stage: str, done: int, total: int) -> None:
        if stage == "em" and done == 2:
            raise EnoughError

    there.observe_all(VIEWS, stop)
    with pytest.raises(EnoughError):
        there.fit(stop)
    assert not hasattr(there, "codes_")
    assert_same(there, taught(EMLearner(SCENE, NUM_CLASSES, SETTINGS), VIEWS))


@pytest.fixture
def data(tmp_path: Path) -> Path:
    return write_dataset(tmp_path / "data")


def segment(data: Path, out: str, *more: str) -> list[str]:
    return ["segment", f"{data}/scene.ply", "--data", str(data), "--out", f"{data.parent}/{out}", "--quiet", *more]


@pytest.mark.parametrize("learner", ["em", "votes"])
def test_the_command_gives_the_same_files_with_a_scheduler(address: str, data: Path, learner: str) -> None:
    assert main(segment(data, "here", "--learner", learner)) == 0
    assert main(segment(data, "there", "--learner", learner, "--scheduler", address)) == 0
    here, there = data.parent / "here", data.parent / "there"
    with np.load(here / "segmentation.npz") as one, np.load(there / "segmentation.npz") as other:
        for name in set(one.files) - {"header"}:  # It names the run.
            np.testing.assert_array_equal(one[name], other[name])
    reports = [json.loads((out / "report.json").read_text()) for out in (here, there)]
    assert reports[1]["settings"]["scheduler"] == address
    reports[0]["views"].pop("reliability", None)  # The asking process has no view prepared that it could check.
    for key in ("objective", "views", "gaussians", "classes"):
        assert reports[0][key] == reports[1][key]


@pytest.mark.parametrize("elsewhere", ["scene", "masks", "both"])
def test_files_that_a_worker_has_not_or_has_different_are_sent(client: Any, data: Path, elsewhere: str) -> None:
    scene, views = GaussianScene.load(data / "scene.ply"), Dataset(data).views("train")
    here = taught(EMLearner(scene, NUM_CLASSES, SETTINGS), views)
    if elsewhere != "masks":
        balls_on_a_table(seed=1)[0].save(data / "scene.ply")
    one = list(client.nthreads())[:1] if elsewhere != "scene" else []
    with (
        changed(client, one, "gsseg_core.learn.distributed.dask_worker", "digest_of", lambda path: "another")
        if one
        else nullcontext()
    ):
        there = DistributedEM(client, scene, NUM_CLASSES, SETTINGS)
        there.observe_all(views)
        assert_same(there, here)


def test_a_broken_mask_is_one_clear_error_and_changes_nothing(
    client: Any, address: str, data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (data / "labels/view1.png").write_bytes(b"\x89PNG")
    assert main(segment(data, "out", "--scheduler", address)) == 2
    stderr = capsys.readouterr().err
    assert stderr.startswith("gsseg: error: ") and "view1.png" in stderr and stderr.count("\n") == 1
    assert not (data.parent / "out").exists()
    there = DistributedVotes(client, GaussianScene.load(data / "scene.ply"), NUM_CLASSES)
    with pytest.raises(MaskFormatError, match=r"view1\.png"):
        there.observe_all(Dataset(data).views("train"))
    assert not there.views and not there._votes.any()


@pytest.mark.parametrize(("version", "says"), [(None, "no gsseg"), ("0.0.1", "gsseg 0.0.1")])
def test_a_worker_without_this_gsseg_is_refused_by_name(
    client: Any, address: str, data: Path, version: str | None, says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    def version_there(name: str) -> str:
        import importlib.metadata

        if version is None:
            raise importlib.metadata.PackageNotFoundError(name)
        return version

    worker = list(client.nthreads())[1]
    with changed(client, [worker], "importlib.metadata", "version", version_there):
        assert main(segment(data, "out", "--scheduler", address)) == 2
    stderr = capsys.readouterr().err
    assert f"worker {worker} has {says}; expected gsseg" in stderr and stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("options", "says"),
    [(["--scheduler", "tcp://127.0.0.1:9"], "does not answer within 0.5 s"),
     (["--scheduler", "nonsense"], "scheduler is 'nonsense'; expected an address"),
     (["--scheduler", "ucx://host:1"], "expected an address such as tcp://host:8786"),
     (["--scheduler", "tcp://127.0.0.1:9", "--learner", "gradient"], "gradient takes one view after the other")],
)  # fmt: skip
def test_what_cannot_be_distributed_is_one_clear_line(
    data: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    options: list[str],
    says: str,
) -> None:
    monkeypatch.setattr(scheduler, "PATIENCE", 0.5)
    assert main(segment(data, "out", *options)) == 2
    stderr = capsys.readouterr().err
    assert stderr.startswith("gsseg: error: ") and says in stderr and stderr.count("\n") == 1
    assert not (data.parent / "out").exists()


@pytest.mark.parametrize(
    ("answer", "says"),
    [(None, "does not answer within 0.5 s"), (b"HTTP/1.1 400 Bad Request\r\n\r\n" * 9, "what answers is no scheduler")],
)
def test_a_port_where_no_scheduler_answers_is_one_clear_line_in_time(
    data: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    answer: bytes | None,
    says: str,
) -> None:
    monkeypatch.setattr(scheduler, "PATIENCE", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            with suppress(OSError), server.accept()[0] as connection:
                if answer:
                    connection.sendall(answer)
                connection.recv(1 << 20)
                connection.recv(1 << 20)

        thread = threading.Thread(target=serve)
        thread.start()
        address = f"127.0.0.1:{server.getsockname()[1]}"
        assert main(segment(data, "out", "--scheduler", address)) == 2
        thread.join(20)
    stderr = capfd.readouterr().err
    assert stderr.startswith(f"gsseg: error: scheduler {address}: {says}") and stderr.count("\n") == 1
    assert not thread.is_alive() and not (data.parent / "out").exists()


def test_an_address_of_a_worker_is_said_to_be_none_of_a_scheduler(client: Any) -> None:
    worker = next(iter(client.nthreads()))
    with pytest.raises(SchedulerError, match="is a worker; expected the address that"), scheduler.connected(worker):
        pass


def test_ctrl_c_while_workers_learn_ends_with_130_and_not_a_word(address: str, data: Path) -> None:
    arguments = [option for option in segment(data, "out", "--scheduler", address) if option != "--quiet"]
    with subprocess.Popen(
        [sys.executable, "-m", "gsseg_core.cli", *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        assert process.stderr is not None
        stderr = b""
        while b"observe:" not in stderr and process.poll() is None:
            stderr += os.read(process.stderr.fileno(), 4096)
        process.send_signal(signal.SIGINT)
        out, rest = process.communicate(timeout=PATIENCE)
    assert (process.returncode, out) == (130, b""), stderr + rest
    assert not re.search(rb"Traceback|Exception|Error|distributed", stderr + rest), stderr + rest


def test_without_dask_the_error_says_what_to_install(
    data: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert main(segment(data, "out", "--scheduler", "tcp://127.0.0.1:9")) == 2
    assert "pip install 'gsseg[distributed]'" in capsys.readouterr().err


def test_the_documented_commands_make_a_cluster_and_its_loss_is_one_clear_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scheduler, "PATIENCE", 1.0)
    run, quiet = [sys.executable, "-m", "dask"], {"stderr": subprocess.DEVNULL, "stdout": subprocess.DEVNULL}
    found = tmp_path / "scheduler.json"
    options = [
        "--host",
        "127.0.0.1",
        "--port",
        "0",
        "--dashboard-address",
        "127.0.0.1:0",
        "--scheduler-file",
        str(found),
    ]
    with subprocess.Popen([*run, "scheduler", *options], **quiet) as first:
        try:
            address = written(found)
            with pytest.raises(SchedulerError, match="has no workers"), scheduler.connected(address):
                pass
            with subprocess.Popen([*run, "worker", address, "--no-dashboard", "--nthreads", "1"], **quiet) as worker:
                with distributed.Client(address, set_as_default=False) as client:
                    client.wait_for_workers(1, timeout=PATIENCE)
                with scheduler.connected(address) as client:
                    there = DistributedEM(client, SCENE, NUM_CLASSES, SETTINGS)
                    there.observe_all(VIEWS)
                    assert_same(there, taught(EMLearner(SCENE, NUM_CLASSES, SETTINGS), VIEWS))
                    worker.terminate()
                    with pytest.raises(SchedulerError, match="has no workers"):
                        there.fit()
                    first.kill()
                    with pytest.raises(SchedulerError, match="does not answer any more"):
                        there.fit()
        finally:
            first.kill()


def written(path: Path) -> str:
    """The address in a scheduler's file, as soon as it is there."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        if path.is_file() and path.stat().st_size:
            return str(json.loads(path.read_text())["address"])
        time.sleep(0.1)
    raise AssertionError(f"{path}: no scheduler in {PATIENCE:g} s")


def test_dask_is_not_imported_where_nothing_is_distributed() -> None:
    program = "import sys, gsseg_core.cli.main, gsseg_core.pipeline; sys.exit('distributed' in sys.modules)"
    subprocess.run([sys.executable, "-c", program], check=True)
