"""Workers of Dask for the tests of distributed learning, and what those learn from.

Importing this module skips the importing test file where Dask is not installed. A test file imports the fixtures that
its tests take:

    from dask_workers import address_fixture, client_fixture  # noqa: F401
"""

from __future__ import annotations

import multiprocessing
import subprocess
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock

import numpy as np
import pytest
from patience import PATIENCE
from small_scenes import balls_on_a_table, with_clutter, wrong_views

from gsseg_core.learn.distributed import dask_cluster as scheduler
from gsseg_core.learn.em.em_learner import EMLearner, EMSettings
from gsseg_core.learn.learner import Learner

distributed = pytest.importorskip("distributed", reason="Dask is not installed")
dask = pytest.importorskip("dask")

_NEEDED = ["distributed", "gsseg_core.learn.distributed.dask_worker", "gsseg_core.raster.cpu.tile_operator"]

SCENE, _ = balls_on_a_table()
VIEWS = wrong_views(7)
VIEWS[4] = with_clutter(VIEWS[4])
SETTINGS = EMSettings(max_steps=6, tolerance=0.0)


@contextmanager
def workers(count: int) -> Iterator[str]:
    """The address of a scheduler with some workers, each a process of one thread."""
    multiprocessing.get_context("forkserver").set_forkserver_preload(_NEEDED)
    settings = {f"distributed.comm.timeouts.{name}": f"{PATIENCE:g}s" for name in ("connect", "tcp")}
    with (
        # They begin as copies of a process that has imported what they need.
        dask.config.set({**settings, "distributed.worker.multiprocessing-method": "forkserver"}),
        mock.patch.object(distributed.utils, "_forkserver_preload_set", True),
        mock.patch.object(scheduler, "PATIENCE", PATIENCE),
        distributed.LocalCluster(
            processes=True, n_workers=count, threads_per_worker=1, dashboard_address="127.0.0.1:0", silence_logs=50
        ) as cluster,
    ):
        yield cluster.scheduler_address


@contextmanager
def newcomer(client: Any) -> Iterator[None]:
    """One more worker. Killed ones mostly come back, but on a busy machine what watches over them may give up."""
    command = [sys.executable, "-m", "dask", "worker", client.scheduler.address, "--nthreads", "1", "--no-dashboard"]
    with subprocess.Popen([*command, "--no-nanny"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            yield
        finally:
            process.kill()


@pytest.fixture(name="address", scope="module")
def address_fixture() -> Iterator[str]:
    """Workers for all tests that leave them as they were."""
    with workers(2) as address:
        yield address


@pytest.fixture(name="client")
def client_fixture(address: str) -> Iterator[Any]:
    with scheduler.connected(address) as client:
        yield client


@pytest.fixture(name="client_of_victims")
def client_of_victims_fixture() -> Iterator[Any]:
    """Workers of one test's own, which kills them: how soon they come back is nothing to the other tests."""
    with workers(2) as address, scheduler.connected(address) as client:
        yield client


def assert_same(one: Learner, other: Learner) -> None:
    for learner in (one, other):
        learner.fit()
    np.testing.assert_array_equal(one._votes.dense(), other._votes.dense())
    np.testing.assert_array_equal(one.codes_, other.codes_)
    np.testing.assert_array_equal(one.observed_, other.observed_)
    assert one.history_ == other.history_ and one.converged_ == other.converged_
    assert one.rejected == other.rejected and list(one.views) == list(other.views)
    if isinstance(one, EMLearner) and isinstance(other, EMLearner):
        assert list(one.error_models_) == list(other.error_models_)
        for name, model in one.error_models_.items():
            np.testing.assert_array_equal(model.confusion, other.error_models_[name].confusion)
            np.testing.assert_array_equal(model.evidence.nameless, other.error_models_[name].evidence.nameless)


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
