"""A viewer for which memory runs out: what was asked for is not done, that is told, and all goes on."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from labellings import labelled, probabilities_of
from parts_of_balls import tree_of_balls
from patience import wait_until
from small_scenes import NAMES, balls_on_a_table, ring

pytest.importorskip("viser")

from gsseg_core.viewer import server_frames
from gsseg_core.viewer import state as view_state
from gsseg_core.viewer.access import listen
from gsseg_core.viewer.clients import SERVER
from gsseg_core.viewer.live_source import LiveUpdate
from gsseg_core.viewer.model import Labelling, ViewModel
from gsseg_core.viewer.picture import Picture
from gsseg_core.viewer.viewer import Viewer

SCENE, TRUTH = balls_on_a_table()
CAMERA = ring(1)[0]
((COLUMN, ROW),), _ = CAMERA.project(SCENE.means[TRUTH == 1].mean(axis=0, keepdims=True))


@pytest.fixture
def viewer() -> Iterator[Viewer]:
    learnt = labelled(TRUTH.astype(np.int32), np.eye(len(NAMES), dtype=np.float32)[TRUTH], dict(NAMES))
    model = ViewModel(SCENE, learnt, class_ids=tuple(NAMES), tree=tree_of_balls())
    with closing(Viewer(model, listener=listen(port=18500), draw=SERVER)) as opened:
        yield opened


def starved(*_: Any, **__: Any) -> Any:
    raise MemoryError("Unable to allocate 1.35 GiB")


def starved_gpu(*_: Any, **__: Any) -> Any:
    raise type("OutOfMemoryError", (RuntimeError,), {})("CUDA out of memory")  # as PyTorch's own is


@pytest.mark.parametrize("step", ["at_level", "cut"])
def test_a_correction_or_level_that_memory_does_not_suffice_for_changes_nothing_and_is_told(
    viewer: Viewer, step: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    state, panel = viewer.state, viewer.panel
    before, shown, client = state.objects, state.model.labelling, MagicMock()
    panel._tool.value, panel._target.value = "a disc", NAMES[2]
    with monkeypatch.context() as patch:
        patch.setattr(view_state, step, starved)
        for act in (lambda: panel.correct_at(CAMERA, COLUMN, ROW), lambda: state.set_level(0.85)):
            with panel.answer.telling(client):
                act()
            assert "memory is not enough (Unable to allocate 1.35 GiB)" in client.add_notification.call_args[0][1]
            assert "memory is not enough" in panel.answer._answer.content
            assert not len(state.corrections) and state.granularity == 0.5
            assert state.objects is before and state.model.labelling is shown
    panel.correct_at(CAMERA, COLUMN, ROW)
    state.set_level(0.85)
    assert (probabilities_of(state.objects) != probabilities_of(before)).any() and len(state.corrections) == 1


def test_what_cannot_be_taken_back_or_learnt_for_want_of_memory_is_there_as_before(
    viewer: Viewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    state, panel = viewer.state, viewer.panel
    panel._tool.value, panel._target.value = "a disc", NAMES[2]
    panel.correct_at(CAMERA, COLUMN, ROW)
    state.change(lambda model: model.toggle(1))
    corrected, drawn = state.objects, state.corrections.drawn
    other = labelled(np.zeros(len(SCENE), np.int32), np.ones((len(SCENE), 1), np.float32), {0: "background"})
    with monkeypatch.context() as patch:
        patch.setattr(view_state, "cut", starved)
        for act in (state.undo, lambda: state.replace(other)):
            with pytest.raises(MemoryError):
                act()  # type: ignore[operator]
            assert state.corrections.drawn is drawn and state.objects is corrected and state.model.hidden == {1}
    assert state.undo() and not len(state.corrections) and np.array_equal(state.objects.labels, TRUTH)


def test_the_viewer_goes_on_showing_after_a_picture_for_which_there_was_no_memory(
    viewer: Viewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    answer = viewer.panel.answer
    with monkeypatch.context() as patch:
        patch.setattr(viewer.state, "seen", starved)
        viewer.state.change(lambda model: model.toggle(1))
        wait_until(lambda: "memory is not enough" in answer._answer.content, "the error")
    viewer.state.change(lambda model: model.toggle(2))
    wait_until(lambda: not viewer.panel._rows[2][0].shown, "the class that was switched off")


@pytest.mark.parametrize("starve", [starved, starved_gpu])
def test_images_are_drawn_again_after_one_for_which_there_was_no_memory(
    starve: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    client, picture = MagicMock(), Picture(SCENE, {}, np.ones(len(SCENE), bool), np.zeros((len(SCENE), 3), np.uint8))
    drawn: list[int] = []
    monkeypatch.setattr(server_frames.Frames, "_draw", lambda *of: drawn.append(len(drawn)) or starve())
    frames = server_frames.Frames(client)
    try:
        for _ in range(2):
            count = len(drawn)
            frames.show(picture)
            wait_until(lambda: len(drawn) > count, "an image")  # noqa: B023
        wait_until(lambda: len(drawn) > 2, "one more")
        assert frames._thread.is_alive()
    finally:
        frames.close()


def test_a_source_is_asked_again_after_a_gpu_had_no_memory() -> None:
    asked = threading.Event()

    class Source:
        def wait(self, timeout: float) -> LiveUpdate:
            if not asked.is_set():
                asked.set()
                starved_gpu()
            time.sleep(0.02)
            return LiveUpdate(labelled(TRUTH.astype(np.int32), np.eye(4, dtype=np.float32)[TRUTH], dict(NAMES)), 1)

        def close(self) -> None:
            pass

    unknown = ViewModel(SCENE, Labelling.unknown(len(SCENE)))
    with closing(Viewer(unknown, source=Source(), listener=listen(port=18520), draw=SERVER)) as viewer:
        assert viewer.panel._live is not None
        wait_until(lambda: "1 view so far" in viewer.panel._live.content, "what the source has")  # type: ignore[union-attr]
