"""One thing after another in the viewer, and what happens meanwhile: nothing is told, saved or corrected wrongly."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest
from operator_cases import make_scene
from parts_of_balls import tree_of_balls
from patience import wait_until
from small_scenes import NAMES, balls_on_a_table, ring

pytest.importorskip("viser")

from gsseg_core.scene.camera import Camera
from gsseg_core.segmentation import Segmentation
from gsseg_core.viewer.access import listen
from gsseg_core.viewer.clients import SERVER, ClientRenderers
from gsseg_core.viewer.corrections import disc
from gsseg_core.viewer.model import Labelling, ViewModel
from gsseg_core.viewer.picking import Picked
from gsseg_core.viewer.state import ViewerState
from gsseg_core.viewer.viewer import Viewer

SCENE, TRUTH = balls_on_a_table()
K = len(NAMES)
LEARNT = Labelling(TRUTH.astype(np.int32), np.eye(K, dtype=np.float32)[TRUTH] * np.float32(0.9), dict(NAMES))
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


def test_a_correction_is_of_what_is_shown_and_not_of_what_is_hidden_before_it() -> None:
    scene = make_scene([[0, 0, 4], [0, 0, 5]], [[1, 0, 0, 0]] * 2, [[0.3, 0.3, 0.01], [0.3, 0.3, 0.01]], [0.97, 0.97])
    before = Labelling(np.array([1, 2], np.int32), np.eye(4, dtype=np.float32)[[1, 2]], dict(NAMES))
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
    assert (labels[TRUTH == 1] == 1).all() and (viewer.state.objects.probabilities != LEARNT.probabilities).any()


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
    state.replace(LEARNT._replace(class_names={**NAMES, 3: "spoon"}))
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
    state.replace(LEARNT._replace(labels=np.array([0, 2, 3, 1], np.int32)[TRUTH], class_names=names))
    (label,) = set(state.objects.labels[drawn].tolist())
    assert state.objects.class_names[label] == NAMES[3] and state.model.hidden == {label}
    assert label == (1 if comes_back else 4)


def test_a_class_alone_is_joined_by_all_again_though_a_hidden_one_was_corrected_away() -> None:
    state = state_of()
    state.change(lambda model: model.isolate(3))
    state.replace(LEARNT._replace(labels=np.where(TRUTH == 2, 3, TRUTH).astype(np.int32)))
    state.change(lambda model: model.isolate(3))
    assert state.model.shown().all()


def test_a_region_is_found_among_as_many_classes_as_there_may_be() -> None:
    many = 60_000
    narrow, names = LEARNT.probabilities[:, [0, 1]], {k: f"class {k}" for k in range(many)}
    wide = Labelling(np.where(TRUTH == 1, many - 1, 0).astype(np.int32), np.repeat(narrow, many // 2, axis=1), names)
    labels = state_of(wide).label_map(CAMERA)
    np.testing.assert_array_equal(labels == many - 1, state_of().label_map(CAMERA) == 1)


def test_the_answer_to_a_click_follows_corrections_and_what_takes_them_back(viewer: Viewer) -> None:
    answer, state = viewer.panel.answer, viewer.state

    def tells(name: str) -> None:
        wait_until(lambda: f"<strong>{name}</strong>" in answer._answer.content, f"the answer {name}")

    state.correct(disc(CAMERA, COLUMN, ROW, 3, 2))
    changed = int(np.flatnonzero(state.objects.labels != TRUTH)[0])
    answer.show_picked(answer.ask(), Picked(changed, 0.5))
    tells(NAMES[2])
    assert not answer._parts.visible and answer._whole.visible
    state.undo()
    tells(NAMES[1])
    assert answer._parts.visible and not answer._whole.visible


def test_an_earlier_click_says_nothing_any_more_once_a_later_one_is_answered(viewer: Viewer) -> None:
    answer = viewer.panel.answer
    first, second = answer.ask(), answer.ask()
    answer.show_picked(second, Picked(IN_BALL, 0.5))
    answer.show_picked(first, Picked(0, 0.5), [])
    assert f"Gaussian {IN_BALL}, " in answer._answer.content
    with answer.telling(None):
        viewer.state.selection("no such format")
    answer.refresh()
    assert "That did not work" in answer._answer.content and not answer._parts.visible


def test_the_class_that_corrections_are_for_stays_chosen_under_another_name_and_is_never_another_one(
    viewer: Viewer,
) -> None:
    panel, target = viewer.panel, viewer.panel._target
    viewer.state.model.tree = None  # A live source has none.
    target.value = NAMES[3]
    viewer.state.replace(LEARNT._replace(class_names={**NAMES, 3: "bottle"}))
    wait_until(lambda: target.value != NAMES[3], "the other name")
    assert target.value == "bottle" and panel._label() == 3
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


def test_a_scene_of_one_gaussian_is_looked_at_from_outside() -> None:
    scene = make_scene([[0, 0, 4]], [[1, 0, 0, 0]], [[0.3, 0.3, 0.01]], [0.97])
    with closing(Viewer(ViewModel(scene, Labelling.unknown(1)), listener=listen(port=18300), draw=SERVER)) as viewer:
        start = viewer.server.initial_camera
        assert start.near > 0 and np.linalg.norm(start.position - start.look_at) > 0.3


def test_nothing_is_drawn_for_a_browser_that_left_before_it_was_known() -> None:
    server, client = MagicMock(), MagicMock()
    server.get_clients.return_value = {}
    renderers = ClientRenderers(server, SCENE, SERVER, "cpu")
    renderers._leave(client)
    renderers._join(client)
    assert not renderers.by_client
