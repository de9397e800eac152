"""Distributed learning by the command line: the same files, and one clear line for what cannot be."""

from __future__ import annotations

import itertools
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from dask_workers import SCENE, SETTINGS, VIEWS, address_fixture, assert_same, changed, client_fixture, distributed  # noqa: F401
from patience import PATIENCE, wait_until
from small_scenes import NUM_CLASSES, balls_on_a_table, taught, write_dataset

from gsseg_core.cli.main import main
from gsseg_core.data.dataset import Dataset
from gsseg_core.errors import MaskFormatError, SchedulerError
from gsseg_core.learn.distributed import dask_cluster as scheduler
from gsseg_core.learn.distributed.dask_learners import DistributedEM, DistributedVotes
from gsseg_core.learn.em.em_learner import EMLearner
from gsseg_core.learn.vote_learner import VoteLearner
from gsseg_core.scene.gaussian_scene import GaussianScene


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


def test_a_scene_that_a_worker_has_not_or_has_different_is_sent(client: Any, data: Path) -> None:
    scene, views = GaussianScene.load(data / "scene.ply"), Dataset(data).views("train")
    here = taught(EMLearner(scene, NUM_CLASSES, SETTINGS), views)
    balls_on_a_table(seed=1)[0].save(data / "scene.ply")
    there = DistributedEM(client, scene, NUM_CLASSES, SETTINGS)
    there.observe_all(views)
    assert_same(there, here)


def test_votes_are_taken_back_as_they_were_cast_whatever_became_of_the_file_of_the_mask(
    client: Any, data: Path
) -> None:
    scene, views = GaussianScene.load(data / "scene.ply"), Dataset(data).views("train")
    there, here = (
        make(NUM_CLASSES) for make in (partial(DistributedVotes, client, scene), partial(VoteLearner, scene))
    )
    for learner in (there, here):
        learner.observe_all(views)
    shutil.copy(data / "labels/view3.png", data / "labels/view0.png")
    (data / "labels/view1.png").unlink()
    for learner in (there, here):
        learner.retract("view1")
        assert learner.observe(Dataset(data).views("train")[0])  # of the name view0, by the mask that is there now
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
    assert not there.views and not there._votes.dense().any()


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
    [(None, "does not answer within "), (b"HTTP/1.1 400 Bad Request\r\n\r\n" * 9, "what answers is no scheduler")],
)
def test_a_port_where_no_scheduler_answers_is_one_clear_line_in_time(
    data: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    answer: bytes | None,
    says: str,
) -> None:
    monkeypatch.setattr(scheduler, "PATIENCE", PATIENCE if answer else 0.5)
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
        server.shutdown(socket.SHUT_RDWR)  # On a busy machine nobody may have come so far as to connect.
        thread.join(PATIENCE)
    stderr = capfd.readouterr().err
    assert stderr.startswith(f"gsseg: error: scheduler {address}: {says}") and stderr.count("\n") == 1
    assert not thread.is_alive() and not (data.parent / "out").exists()


def test_an_address_of_a_worker_is_said_to_be_none_of_a_scheduler(client: Any) -> None:
    worker = next(iter(client.nthreads()))
    with pytest.raises(SchedulerError, match="is a worker; expected the address that"), scheduler.connected(worker):
        pass


def test_ctrl_c_while_workers_learn_ends_with_130_and_not_a_word(client: Any, address: str, data: Path) -> None:
    arguments = [option for option in segment(data, "out", "--scheduler", address) if option != "--quiet"]
    ended = str(data / "ended")

    def work(*_: object) -> None:  # Until the signal has had its effect, however late it comes.
        import time
        from pathlib import Path

        while not Path(ended).exists():
            time.sleep(0.01)

    with (
        changed(client, client.nthreads(), "gsseg_core.learn.distributed.dask_worker", "sum_votes", work),
        subprocess.Popen(
            [sys.executable, "-m", "gsseg_core.cli", *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE
        ) as process,
    ):
        try:
            assert process.stderr is not None
            stderr = b""
            while b"observe:" not in stderr and process.poll() is None:
                stderr += os.read(process.stderr.fileno(), 4096)
            process.send_signal(signal.SIGINT)
            out, rest = process.communicate(timeout=PATIENCE)
        finally:
            Path(ended).touch()
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
    # Workers are waited for a second, the scheduler for as long as a busy machine needs.
    fast = SimpleNamespace(monotonic=lambda: PATIENCE * time.monotonic(), sleep=time.sleep)
    monkeypatch.setattr(scheduler, "time", fast)
    monkeypatch.setattr(scheduler, "PATIENCE", PATIENCE)
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
                with distributed.Client(address, timeout=PATIENCE, set_as_default=False) as client:
                    client.wait_for_workers(1, timeout=PATIENCE)
                with scheduler.connected(address) as client:
                    there = DistributedEM(client, SCENE, NUM_CLASSES, SETTINGS)
                    there.observe_all(VIEWS)
                    assert_same(there, taught(EMLearner(SCENE, NUM_CLASSES, SETTINGS), VIEWS))
                    worker.terminate()
                    wait_until(lambda client=client: not client.nthreads(), "the worker to leave")  # type: ignore[misc]
                    with pytest.raises(SchedulerError, match="has no workers"):
                        there.fit()
                    first.kill()
                    client.rpc.timeout = 1  # Else it is looked for as long as a busy machine needs.
                    with pytest.raises(SchedulerError, match="does not answer any more"):
                        there.fit()
        finally:
            first.kill()


def test_a_worker_that_is_there_is_found_however_late_one_comes_to_look(monkeypatch: pytest.MonkeyPatch) -> None:
    hours = itertools.count(0, 3600)
    monkeypatch.setattr(scheduler, "time", SimpleNamespace(monotonic=lambda: next(hours)))
    client: Any = SimpleNamespace(nthreads=lambda: {"tcp://here:1": 2})
    assert scheduler.find_workers(client) == {"tcp://here:1": 2}


def written(path: Path) -> str:
    """The address in a scheduler's file, as soon as it is there."""
    wait_until(lambda: path.is_file() and path.stat().st_size, f"a scheduler that writes {path}")
    return str(json.loads(path.read_text())["address"])


def test_dask_is_not_imported_where_nothing_is_distributed() -> None:
    program = "import sys, gsseg_core.cli.main, gsseg_core.pipeline; sys.exit('distributed' in sys.modules)"
    subprocess.run([sys.executable, "-c", program], check=True)
