"""One thing after another in the viewer, and what happens meanwhile: nothing is told, saved or corrected wrongly."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from labellings import labelled, probabilities_of
from operator_cases import make_scene
from parts_of_balls import tree_of_balls
from patience import wait_until
from small_scenes import NAMES, balls_on_a_table, ring

pytest.importorskip("viser")

from gsseg_core.csr_rows import CSRRows, largest
from gsseg_core.export import class_files
from gsseg_core.scene.camera import Camera
from gsseg_core.segmentation import Segmentation
from gsseg_core.viewer import corrections as view_corrections
from gsseg_core.viewer import model as view_model
from gsseg_core.viewer import panel as view_panel
from gsseg_core.viewer.access import listen
from gsseg_core.viewer.clients import SERVER
from gsseg_core.viewer.corrections import disc
from gsseg_core.viewer.model import ClassRow, Labelling, ViewModel
from gsseg_core.viewer.state import ViewerState
from gsseg_core.viewer.viewer import Viewer

SCENE, TRUTH = balls_on_a_table()
K = len(NAMES)
LEARNT = labelled(TRUTH.astype(np.int32), np.eye(K, dtype=np.float32)[TRUTH] * np.float32(0.9), dict(NAMES))
CAMERA = ring(1)[0]
((COLUMN, ROW),), _ = CAMERA.project(SCENE.means[TRUTH == 1].mean(axis=0, keepdims=True))
IN_BALL = int(np.flatnonzero(TRUTH == 1)[-1])


@pytest.fixture
def viewer() -> Iterator[Viewer]:
    model = ViewModel(SCENE, LEARNT, class_ids=tuple(NAMES), tree=tree_of_balls())
    with closing(Viewer(model, listener=listen(port=18300), draw=SERVER)) as opened:
        yield opened


def state_of(labelling: Labelling = LEARNT) -> ViewerState:
    return ViewerState(ViewModel(SCENE, labelling), [], {}, "cpu")


def meanwhile(viewed: ViewerState, action: Callable[[], object]) -> Callable[[], None]:
    """What another thread does here, once: nothing where this one holds the state, so that the other has to wait."""
    done: list[object] = []

    def do() -> None:
        if not viewed.lock.held() and not done:
            done.append(None)
            action()

    return do


def test_a_correction_is_of_what_is_shown_and_not_of_what_is_hidden_before_it() -> None:
    scene = make_scene([[0, 0, 4], [0, 0, 5]], [[1, 0, 0, 0]] * 2, [[0.3, 0.3, 0.01], [0.3, 0.3, 0.01]], [0.97, 0.97])
    before = labelled(np.array([1, 2], np.int32), np.eye(4, dtype=np.float32)[[1, 2]], dict(NAMES))
    state = ViewerState(ViewModel(scene, before), [], {}, "cpu")
    state.change(lambda model: model.toggle(1))
    front = Camera("front", 64, 48, np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]), np.eye(4))
    assert state.correct(disc(front, 32, 24, 6, 3)) == 1
    assert state.objects.labels.tolist() == [1, 3]


@pytest.mark.parametrize("tool", ["the whole region", "a disc", "all that looks alike there"])
def test_every_tool_leaves_what_is_hidden_as_it_is(viewer: Viewer, tool: str) -> None:
    viewer.state.change(lambda model: model.toggle(1))
    viewer.panel._target.value, viewer.panel._tool.value = NAMES[3], tool
    viewer.panel.correct_at(CAMERA, COLUMN, ROW)
    labels = viewer.state.objects.labels
    assert (labels[TRUTH == 1] == 1).all() and (
        probabilities_of(viewer.state.objects) != probabilities_of(LEARNT)
    ).any()


def test_a_class_that_was_added_is_no_node_of_the_tree_and_keeps_its_id_and_colour_on_every_level_and_in_the_file(
    tmp_path: Path,
) -> None:
    tree = tree_of_balls()
    state = ViewerState(ViewModel(SCENE, LEARNT, class_ids=tuple(NAMES), tree=tree), [], {}, "cpu")
    state.added_names[K] = "spoon"
    state.correct(disc(CAMERA, COLUMN, ROW, 3, K))
    spoon = int(np.flatnonzero(state.objects.labels == K)[0])
    found = set()
    for level in tree.granularities:
        state.set_level(level)
        label = int(state.model.labelling.labels[spoon])
        found.add((state.model.ids()[label], state.model.color(label)))
        assert state.node_of(spoon) is None
        (tmp_path / "s.npz").write_bytes(state.segmentation_npz()[1])
        saved = Segmentation.load(tmp_path / "s.npz", SCENE)
        assert int(saved.labels[spoon]) == state.model.ids()[label] and saved.class_names[len(tree)] == "spoon"
    assert len(found) == 1


def test_a_class_that_was_added_joins_its_namesake_wherever_that_turns_up() -> None:
    state = state_of()
    state.added_names[K] = "spoon"
    state.correct(disc(CAMERA, COLUMN, ROW, 3, K))
    spoon = state.objects.labels == K
    state.replace(replace(LEARNT, class_names={**NAMES, 3: "spoon"}))
    assert state.objects.class_names == {**NAMES, 3: "spoon"} and (state.objects.labels[spoon] == 3).all()


@pytest.mark.parametrize("seen_reset", [True, False])
@pytest.mark.parametrize("comes_back", [True, False])
def test_corrections_and_switches_stay_with_their_class_though_a_robot_that_was_reset_numbers_its_classes_anew(
    seen_reset: bool, comes_back: bool
) -> None:
    state = state_of()
    state.correct(disc(CAMERA, COLUMN, ROW, 3, 3))
    drawn = state.objects.labels != TRUTH
    state.change(lambda model: model.toggle(3))
    if seen_reset:
        state.replace(Labelling.unknown(len(SCENE)))
        assert state.objects.class_names[3] == NAMES[3] and (state.objects.labels[drawn] == 3).all()
    names = {0: NAMES[0], 1: NAMES[3] if comes_back else "chair", 2: NAMES[1], 3: NAMES[2]}
    state.replace(replace(LEARNT, labels=np.array([0, 2, 3, 1], np.int32)[TRUTH], class_names=names))
    (label,) = set(state.objects.labels[drawn].tolist())
    assert state.objects.class_names[label] == NAMES[3] and state.model.hidden == {label}
    assert label == (1 if comes_back else 4)


def test_a_class_alone_is_joined_by_all_again_though_a_hidden_one_was_corrected_away() -> None:
    state = state_of()
    state.change(lambda model: model.isolate(3))
    state.replace(replace(LEARNT, labels=np.where(TRUTH == 2, 3, TRUTH).astype(np.int32)))
    state.change(lambda model: model.isolate(3))
    assert state.model.shown().all()


def test_a_region_is_found_among_as_many_classes_as_there_may_be() -> None:
    many = 60_000
    narrow, names = probabilities_of(LEARNT)[:, [0, 1]], {k: f"class {k}" for k in range(many)}
    wide = labelled(np.where(TRUTH == 1, many - 1, 0).astype(np.int32), np.repeat(narrow, many // 2, axis=1), names)
    labels = state_of(wide).label_map(CAMERA)
    np.testing.assert_array_equal(labels == many - 1, state_of().label_map(CAMERA) == 1)


def test_the_class_that_corrections_are_for_stays_chosen_under_another_name_and_is_never_another_one(
    viewer: Viewer,
) -> None:
    panel, target = viewer.panel, viewer.panel._target
    viewer.state.model.tree = None  # A live source has none.
    target.value = NAMES[3]
    viewer.state.replace(replace(LEARNT, class_names={**NAMES, 3: "bottle"}))
    wait_until(lambda: target.value != NAMES[3], "the other name")
    assert target.value == "bottle" and panel._label(target.value) == 3
    viewer.state.replace(Labelling.unknown(len(SCENE)))
    wait_until(lambda: len(target.options) == 1, "the classes that are left")
    with panel.answer.telling(None):
        panel.correct_at(CAMERA, COLUMN, ROW)
    assert target.value == "bottle" and not len(viewer.state.corrections)
    assert "&#x27;bottle&#x27;; expected one of the list" in panel.answer._answer.content


def test_levels_of_nearly_one_granularity_can_all_be_chosen_and_opened() -> None:
    tree = tree_of_balls()
    parents = np.array([*tree.parents, 4, 4, 7, 7], np.int32)
    agreement = np.array([*tree.agreement, 1, 1, 1, 1], np.float32)
    agreement[[1, 4, 7]] = 0.996, 0.997, 0.998
    leaves = tree.leaves.copy()
    in_lower = np.flatnonzero(leaves == 4)
    leaves[in_lower] = np.resize([8, 9, 10], len(in_lower))
    tree = replace(tree, parents=parents, agreement=agreement, leaves=leaves)
    model = ViewModel(SCENE, LEARNT, class_ids=tuple(NAMES), tree=tree)
    with closing(Viewer(model, listener=listen(port=18300), draw=SERVER)) as viewer:
        assert sorted(viewer.panel._levels.values()) == list(tree.granularities)
        for node in (1, 4, 7):
            viewer.state.show_parts(node)
            viewer.panel._show_level()
            assert viewer.panel._levels[viewer.panel._level.value] == viewer.state.granularity


def test_a_level_that_is_chosen_while_parts_are_shown_is_the_one_that_is_shown(
    viewer: Viewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    panel, viewed, set_to = viewer.panel, viewer.state, view_panel._set
    coarsest = next(iter(panel._levels))

    def choose() -> None:
        panel._level._impl.value = coarsest  # as viser does where a browser says so
        for callback in panel._level._impl.update_cb:
            callback(MagicMock())

    at_once = meanwhile(viewed, choose)

    def set_late(*of: Any) -> None:
        at_once()
        set_to(*of)

    monkeypatch.setattr(view_panel, "_set", set_late)
    panel.answer._node = 1
    panel.answer._show_offered(None, viewed.show_parts)
    at_once()
    assert viewed.granularity == panel._levels[panel._level.value] == panel._levels[coarsest]


def test_a_scene_of_one_gaussian_is_looked_at_from_outside() -> None:
    scene = make_scene([[0, 0, 4]], [[1, 0, 0, 0]], [[0.3, 0.3, 0.01]], [0.97])
    with closing(Viewer(ViewModel(scene, Labelling.unknown(1)), listener=listen(port=18300), draw=SERVER)) as viewer:
        start = viewer.server.initial_camera
        assert start.near > 0 and np.linalg.norm(start.position - start.look_at) > 0.3


@pytest.mark.parametrize("tool", ["the whole region", "a disc", "all that looks alike there", "a box"])
def test_a_correction_is_of_the_class_that_was_chosen_though_classes_are_renumbered_meanwhile(
    viewer: Viewer, tool: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    panel, viewed = viewer.panel, viewer.state
    viewed.model.tree = None  # A live source has none.
    panel._new.value = "spoon"
    panel._add_class()
    learnt = labelled(LEARNT.labels, np.pad(probabilities_of(LEARNT), ((0, 0), (0, 1))), {**NAMES, K: "fork"})
    at_once, draw = meanwhile(viewed, lambda: viewed.replace(learnt)), view_corrections._view

    def drawn(*of: Any) -> Any:
        at_once()
        return draw(*of)

    monkeypatch.setattr(view_corrections, "_view", drawn)
    if tool == "a box":
        panel.correct_box(CAMERA, (COLUMN - 3, ROW - 3), (COLUMN + 3, ROW + 3))
    else:
        panel._tool.value, panel._radius.value = tool, 10.0
        panel.correct_at(CAMERA, COLUMN, ROW)
    at_once()
    assert viewed.objects.class_names[K] == "fork"
    changed = viewed.objects.labels[viewed.objects.labels != TRUTH]
    assert {viewed.objects.class_names[k] for k in changed} == {"spoon"}


def test_a_segmentation_is_saved_as_it_was_though_a_live_source_has_more_classes_meanwhile(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    viewed, ids_of = state_of(), ViewModel.ids
    more = Labelling.unknown(len(SCENE), {**NAMES, K: "fork"})
    at_once = meanwhile(viewed, lambda: viewed.replace(more))

    def ids(model: ViewModel) -> list[int]:
        at_once()
        return ids_of(model)

    monkeypatch.setattr(ViewModel, "ids", ids)
    (tmp_path / "s.npz").write_bytes(viewed.segmentation_npz()[1])
    at_once()
    saved = Segmentation.load(tmp_path / "s.npz", SCENE)
    assert viewed.objects is more and saved.class_names == NAMES
    np.testing.assert_array_equal(saved.labels, TRUTH)


def test_meshes_are_of_what_was_sure_when_saving_began_though_a_live_source_is_less_sure_meanwhile(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    viewed, given, choose = state_of(), list[np.ndarray](), np.where
    at_once = meanwhile(viewed, lambda: viewed.replace(Labelling.unknown(len(SCENE), NAMES)))

    def where(*of: Any) -> Any:
        at_once()
        return choose(*of)

    def meshes(scene: object, labels: object, confidence: np.ndarray, *_: object) -> dict[int, object]:
        given.append(confidence)
        return {}

    monkeypatch.setattr(np, "where", where)
    monkeypatch.setattr(class_files, "collision_meshes", meshes)
    viewed.selection("ply")
    assert (viewed.model.labelling.confidence == 0).all() and (given[0] == np.float32(0.9)).all()


def test_what_a_click_looks_through_is_known_anew_though_a_live_source_was_less_sure_meanwhile(
    viewer: Viewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    viewed = viewer.state
    viewed.model.tree, viewed.model.min_confidence = None, 0.5
    less_sure = replace(LEARNT, shares=LEARNT.shares.with_data(LEARNT.shares.data / 2))
    at_once = meanwhile(viewed, lambda: viewed.replace(less_sure))

    def known(shares: CSRRows) -> tuple[np.ndarray, np.ndarray]:
        found = largest(shares)
        at_once()
        return found

    viewed.model.labelling = replace(LEARNT)  # whose confidence nobody has asked for yet
    monkeypatch.setattr(view_model, "largest", known)
    seen = MagicMock(fov=1.0, aspect=1.0, image_height=48, position=CAMERA.center, wxyz=np.eye(4)[0])
    viewer._on_click(MagicMock(client=MagicMock(camera=seen), ray_origin=np.zeros(3), ray_direction=np.eye(3)[2]))
    at_once()
    assert viewed.objects is less_sure and not viewed.model.shown().any()


def test_a_search_waits_for_the_list_that_is_being_rebuilt(viewer: Viewer, monkeypatch: pytest.MonkeyPatch) -> None:
    panel, add = viewer.panel, viewer.panel._add_row
    rows = [row._replace(name=f"new {row.name}") for row in viewer.state.seen()[1]]
    panel._search.value = "mug"
    at_once = meanwhile(viewer.state, panel._filter)

    def added(row: ClassRow) -> Any:
        at_once()
        return add(row)

    monkeypatch.setattr(panel, "_add_row", added)
    panel.show_classes(rows)
    assert [row.name for row, button in panel._rows.values() if button.visible] == ["new cup/mug"]


def test_the_list_is_not_rebuilt_while_it_is_searched(viewer: Viewer) -> None:
    panel = viewer.panel
    rows = [row._replace(name=f"new {row.name}") for row in viewer.state.seen()[1]]
    at_once = meanwhile(viewer.state, lambda: panel.show_classes(rows))

    class Search:
        """What is searched for, in the moment in which it is read."""

        @property
        def value(self) -> str:
            at_once()
            return "mug"

    panel._search = Search()  # type: ignore[assignment]
    panel._filter()
    at_once()
    assert [row.name for row, button in panel._rows.values() if button.visible] == ["new cup/mug"]


def test_a_large_scene_is_within_what_a_browser_draws() -> None:
    scene = make_scene([[0, 0, 4e4], [0, 5e4, 9e4]], [[1, 0, 0, 0]] * 2, [[300, 300, 10]] * 2, [0.97] * 2)
    with closing(Viewer(ViewModel(scene, Labelling.unknown(2)), listener=listen(port=18300), draw=SERVER)) as viewer:
        start = viewer.server.initial_camera
        assert start.far > 2 * np.linalg.norm(scene.means - start.position, axis=1).max()


def test_a_class_that_turns_up_leaves_the_buttons_before_it_to_be_pressed() -> None:
    with closing(Viewer(ViewModel(SCENE, LEARNT), listener=listen(port=18310), draw=SERVER)) as viewer:
        panel, rows = viewer.panel, viewer.state.seen()[1]
        spoon = rows[2]._replace(label=K, name="spoon")
        before = {label: button for label, (_, button) in panel._rows.items()}
        for listed, stay in (([*rows, spoon], 4), ([*rows[:2], spoon], 2), (rows[1:], 0), (rows, 0), (rows[:1], 1)):
            panel.show_classes(listed)
            buttons = {label: button for label, (_, button) in panel._rows.items()}
            assert [*buttons] == [row.label for row in listed]
            assert sum(buttons.get(label) is button for label, button in before.items()) == stay
            orders = [button.order for button in buttons.values()]
            assert orders == sorted(orders)
            before = buttons
