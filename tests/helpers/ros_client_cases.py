"""A node in another process with a client, and calls that run in the background.

A test file imports the fixtures and its tests take `place` or `learnt`; all tests of the file share the node:

    from ros_client_cases import Place, learnt_fixture, place_fixture, shared_fixture  # noqa: F401
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import pytest
from patience import PATIENCE
from ros_helpers import Process, Ros, private_ros, wait_until
from small_scenes import NAMES, write_dataset

from gsseg_core.data.dataset import Dataset
from gsseg_core.data.view import View
from gsseg_ros.client import NodeUnavailableError, SegmentationClient, SegmentationError

T = TypeVar("T")

FOREVER: dict[str, Any] = {"learner": "gradient", "max_steps": 1_000_000}
"""A goal that does not come to its end while a test waits."""


def start_node(ros: Ros, folder: Path, **parameters: Any) -> Process:
    names = list(NAMES.values())
    parameters = {"data_root": folder, "class_names": names, **parameters}
    return ros.start("segment_node", {"scene_path": folder / "data/scene.ply", **parameters})


class Place:
    """A node that is active, a client, and a dataset `data` below the node's data_root."""

    def __init__(self, folder: Path, ros: Ros, client: SegmentationClient) -> None:
        self.folder, self.ros, self.client = folder, ros, client
        write_dataset(folder / "data")
        self.node = start_node(ros, folder)
        client.wait_until_active(PATIENCE)

    @property
    def views(self) -> list[View]:
        return Dataset(self.folder / "data").views("all")


@contextmanager
def placed(ros: Ros, folder: Path) -> Iterator[Place]:
    with SegmentationClient(domain_id=ros.domain, find_timeout=PATIENCE) as client:
        yield Place(folder, ros, client)


@pytest.fixture(name="shared", scope="module")
def shared_fixture(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Place]:
    folder = tmp_path_factory.mktemp("client")
    with private_ros(folder) as ros, placed(ros, folder) as place:
        yield place


@pytest.fixture(name="own")
def own_fixture(ros: Ros, tmp_path: Path) -> Iterator[Place]:
    """A place of one test's own, whose node it may stop."""
    with placed(ros, tmp_path) as place:
        yield place


@pytest.fixture(name="place")
def place_fixture(shared: Place) -> Place:
    """The node without views and codes."""
    once_free(lambda: shared.client.load_scene("data/scene.ply"))
    return shared


@pytest.fixture(name="learnt")
def learnt_fixture(place: Place) -> Place:
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
        self._thread.join(PATIENCE)
        assert not self._thread.is_alive(), "the call does not return"

    @property
    def ended(self) -> bool:
        return not self._thread.is_alive()

    def _run(self) -> None:
        try:
            self.result = self._function()
        except BaseException as error:
            self.error = error


def learning_forever(client: SegmentationClient) -> Background:
    """A `learn` that is in its steps: before, kernels are loaded, which nothing can stop."""
    began = threading.Event()

    def told(stage: str, done: int, *_: float) -> None:
        if stage == "gradient" and done > 1:
            began.set()

    running = Background(lambda: client.learn("data", **FOREVER, on_feedback=told))
    wait_until(lambda: began.wait(0.1) or running.ended, "steps of learning")
    assert began.is_set(), running.error
    return running


def once_free(call: Callable[[], T]) -> T:
    """Call again while the node is busy: a job that was given up may take its time to stop."""
    answers: list[T] = []

    def answered() -> bool:
        try:
            answers.append(call())
        except SegmentationError as error:
            if error.name != "BUSY":
                raise
        return bool(answers)

    wait_until(answered, "the node to be free")
    return answers[0]


def failure(call: Callable[[], Any]) -> SegmentationError:
    with pytest.raises(SegmentationError) as caught:
        call()
    return caught.value


def says_in_the_end(call: Callable[[], Any], what: str) -> None:
    """Repeat a call, which must fail, until its error says something: what it knows of the node comes in time."""

    def says() -> bool:
        with pytest.raises(NodeUnavailableError) as caught:
            call()
        return what in str(caught.value)

    wait_until(says, f"an error that says {what!r}")
