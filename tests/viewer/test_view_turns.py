"""What is asked of a viewer that is busy with something else: it comes later, and is what was asked for."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from labellings import labelled
from parts_of_balls import tree_of_balls
from patience import PATIENCE, wait_until
from small_scenes import NAMES, balls_on_a_table, clean_views, ring

pytest.importorskip("viser")

from gsseg_core.viewer.access import listen
from gsseg_core.viewer.clients import SERVER
from gsseg_core.viewer.corrections import Corrections, disc
from gsseg_core.viewer.model import BY_CLASS, BY_CONFIDENCE, BY_RELIABILITY, ViewModel
from gsseg_core.viewer.picking import ViewVotes
from gsseg_core.viewer.state import ViewerState
from gsseg_core.viewer.turns import Turns
from gsseg_core.viewer.viewer import Viewer

SCENE, TRUTH = balls_on_a_table()
LEARNT = labelled(TRUTH.astype(np.int32), np.eye(4, dtype=np.float32)[TRUTH] * np.float32(0.9), dict(NAMES))
CAMERA = ring(1)[0]
((COLUMN, ROW),), _ = CAMERA.project(SCENE.means[TRUTH == 1].mean(axis=0, keepdims=True))


@pytest.fixture
def viewer() -> Iterator[Viewer]:
    model = ViewModel(SCENE, LEARNT, class_ids=tuple(NAMES), tree=tree_of_balls())
    views = clean_views(2)
    trust = {view.name: 0.5 for view in views}
    with closing(Viewer(model, views, trust, listener=listen(port=18650), draw=SERVER)) as opened:
        yield opened


@contextmanager
def busy(state: ViewerState, ask: Callable[[], object]) -> Iterator[None]:
    """Have a thread ask for something that has to wait for the body, which may change the state."""
    lock, waits = state.lock, threading.Event()

    class Telling:
        """The lock, which tells of the thread that asks for it."""

        def __enter__(self) -> None:
            if threading.current_thread() is asking:
                waits.set()
            lock.__enter__()

        def __exit__(self, *_: object) -> None:
            lock.__exit__()

    asking = threading.Thread(target=ask)
    with lock:
        state.lock = Telling()  # type: ignore[assignment]
        asking.start()
        assert waits.wait(PATIENCE)
        yield
    asking.join()
    state.lock = lock


def test_what_is_drawn_while_something_takes_long_is_learnt_in_its_order_and_taken_back_from_the_last() -> None:
    state, drawn = ViewerState(ViewModel(SCENE, LEARNT), [], {}, "cpu"), [3, 1, 2, 0, 2, 3, 1, 0]

    def correct(label: int) -> None:
        state.correct(disc(CAMERA, COLUMN, ROW, 3, label))

    asked = [*(threading.Thread(target=correct, args=(label,)) for label in drawn), threading.Thread(target=state.undo)]
    with state.lock:
        for count, one in enumerate(asked, start=1):
            one.start()
            wait_until(lambda count=count: len(state.lock._waiting) == count, "it to wait")  # type: ignore[misc]
    for one in asked:
        one.join()
    assert [int(one.labels[0]) for one in state.corrections.drawn] == drawn[:-1]


@pytest.mark.parametrize("had_its_turn", [False, True])
def test_who_is_interrupted_while_waiting_keeps_nobody_waiting(
    monkeypatch: pytest.MonkeyPatch, had_its_turn: bool
) -> None:
    lock = Turns()

    class Interrupted(threading.Event):
        def wait(self, timeout: float | None = None) -> bool:
            if had_its_turn:
                lock.__exit__()  # as the thread that holds it does, just before
            raise KeyboardInterrupt

    lock.__enter__()
    lock._holder = -1  # another thread
    with monkeypatch.context() as patched:
        patched.setattr(threading, "Event", Interrupted)
        with pytest.raises(KeyboardInterrupt):
            lock.__enter__()
    if not had_its_turn:
        lock.__exit__()
    assert lock._holder is None and not lock._waiting


def widget(viewer: Viewer, label: str) -> Any:
    handles = viewer.server.gui._gui_input_handle_from_uuid.values()
    return next(handle for handle in handles if getattr(handle, "label", None) == label)


def told(handle: Any) -> None:
    """Tell the viewer that a browser has used a widget."""
    for callback in handle._impl.update_cb:
        callback(MagicMock(client=MagicMock(), target=handle))


@pytest.mark.parametrize("by", ["click", "box"])
def test_a_correction_is_of_the_class_that_was_chosen_when_it_was_drawn(viewer: Viewer, by: str) -> None:
    panel, state = viewer.panel, viewer.state
    panel._target.value = NAMES[3]

    def draw() -> None:
        if by == "box":
            panel.correct_box(CAMERA, (COLUMN - 3, ROW - 3), (COLUMN + 3, ROW + 3))
        else:
            panel.correct_at(CAMERA, COLUMN, ROW)

    with busy(state, draw):
        panel._target.value = NAMES[2]
    assert set(state.objects.labels[state.objects.labels != TRUTH].tolist()) == {3}


def test_a_correction_is_drawn_as_a_click_meant_when_it_was_made(viewer: Viewer) -> None:
    panel, state = viewer.panel, viewer.state
    drawn = Corrections(SCENE)
    drawn.add(disc(CAMERA, COLUMN, ROW, 0.1 * CAMERA.height, 3))
    panel._target.value, panel._tool.value, panel._radius.value = NAMES[3], "a disc", 10.0
    with busy(state, lambda: panel.correct_at(CAMERA, COLUMN, ROW)):
        panel._tool.value, panel._radius.value = "the whole region", 20.0
    np.testing.assert_array_equal(state.objects.labels, drawn.apply(LEARNT).labels)


def test_a_press_on_a_class_is_for_no_other_one_that_has_its_number_by_then(viewer: Viewer) -> None:
    state, (row, button) = viewer.state, viewer.panel._rows[1]
    with busy(state, lambda: told(button)):
        state.show_parts(1)  # which takes the ball apart: its number is the mug's now
        state.change(lambda model: model.show_all())
    assert state.model.name(1) != row.name and not state.model.hidden
    assert "red ball" in viewer.panel.answer._answer.content


def test_the_level_that_was_chosen_last_is_shown(viewer: Viewer) -> None:
    state, level, levels = viewer.state, viewer.panel._level, viewer.panel._levels
    coarse, *_, fine = levels
    level.value = coarse
    with busy(state, lambda: told(level)):
        level.value = fine
        told(level)
    assert state.granularity == levels[level.value] == levels[fine]


def test_parts_of_what_has_none_are_not_shown_though_a_browser_still_offers_those_of_something_else(
    viewer: Viewer,
) -> None:
    state, answer = viewer.state, viewer.panel.answer
    state.change(lambda model: model.toggle(3))
    answer._node = 2  # which another browser has clicked on meanwhile
    told(answer._parts)
    assert state.granularity == 0.5 and state.model.hidden == {3}


@pytest.mark.parametrize("name", ["confidence", "probability"])
def test_a_slider_that_is_dragged_on_acts_as_it_stands_last(viewer: Viewer, name: str) -> None:
    state, slider = viewer.state, widget(viewer, name)
    slider._impl.value = 0.25
    with busy(state, lambda: told(slider)):
        slider._impl.value = 0.75
        told(slider)
    assert getattr(state.model, f"min_{name}") == slider.value == 0.75


@pytest.mark.parametrize("then", [BY_CLASS, BY_CONFIDENCE])
def test_the_colours_that_were_chosen_last_are_shown_though_votes_for_earlier_ones_took_long(
    viewer: Viewer, then: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    state, mode, collect = viewer.state, widget(viewer, "colour by"), ViewVotes.__init__
    asked, chosen = threading.Event(), threading.Event()

    def slowly(*args: Any, **options: Any) -> None:
        asked.set()
        assert chosen.wait(PATIENCE)
        collect(*args, **options)

    monkeypatch.setattr(ViewVotes, "__init__", slowly)
    mode._impl.value = BY_RELIABILITY
    first = threading.Thread(target=told, args=(mode,))
    first.start()
    assert asked.wait(PATIENCE)
    mode._impl.value = then
    told(mode)
    chosen.set()
    first.join()
    assert state.model.mode == mode.value == then
