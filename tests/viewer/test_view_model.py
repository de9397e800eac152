"""What a viewer shows, and what it sends for that: laws of the model and of its nodes, without a viewer."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from labellings import labelled, probabilities_of
from parts_of_balls import tree_of_balls
from small_scenes import NAMES, balls_on_a_table, ring

from gsseg_core.errors import SettingsError, UnknownLabelError
from gsseg_core.export.pictures import FILL
from gsseg_core.raster.backends import make_operator
from gsseg_core.scene.living_scene import LivingScene
from gsseg_core.scene.scene_delta import SceneDelta
from gsseg_core.segmentation import REMOVED, UNOBSERVED, Segmentation
from gsseg_core.viewer.model import (
    BY_CLASS,
    BY_CONFIDENCE,
    BY_RELIABILITY,
    NOTHING_KNOWN,
    TRUE_COLOURS,
    Labelling,
    ViewModel,
    ramp,
)
from gsseg_core.viewer.picture import BANDS, Node, Picture, cut

pytest.importorskip("viser")

from gsseg_core.viewer.corrections import disc
from gsseg_core.viewer.splats import SplatNodes, Splats
from gsseg_core.viewer.state import ViewerState

SCENE, TRUTH = balls_on_a_table()
N, K = len(SCENE), len(NAMES)


def model(seed: int = 0) -> ViewModel:
    """The table, of which the first Gaussians are unobserved, and some others taken out of their objects."""
    rng = np.random.default_rng(seed)
    probabilities = rng.dirichlet(np.ones(K), N).astype(np.float32) * 0.5
    probabilities[np.arange(N), TRUTH] += 0.5
    labels = TRUTH.astype(np.int32).copy()
    labels[:7], probabilities[:7] = UNOBSERVED, 0
    labels[10:13] = REMOVED
    return ViewModel(SCENE, labelled(labels, probabilities, dict(NAMES)))


def test_the_list_has_every_class_with_its_colour_and_size_and_what_is_of_no_class() -> None:
    rows = model().rows()
    assert [(row.label, row.size) for row in rows] == [(0, 436), (1, 60), (2, 60), (3, 60), (-1, 7), (-2, 3)]
    assert sum(row.size for row in rows) == N and all(row.shown for row in rows)
    assert len({row.color for row in rows}) == 5  # what is of no class shares one


def test_a_toggle_hides_one_class_and_a_second_one_shows_it_again() -> None:
    shown = model()
    shown.toggle(2)
    assert np.array_equal(shown.shown(), shown.labelling.labels != 2)
    shown.toggle(2)
    assert shown.shown().all()


def test_an_isolated_class_is_alone_and_a_second_time_shows_all() -> None:
    shown = model()
    shown.isolate(3)
    assert np.array_equal(shown.shown(), shown.labelling.labels == 3)
    shown.isolate(3)
    assert shown.shown().all()


def test_a_removed_class_is_off_the_list_until_all_is_shown_again() -> None:
    shown = model()
    shown.remove(1)
    assert 1 not in shown.labels_in_use and not shown.shown()[shown.labelling.labels == 1].any()
    with pytest.raises(UnknownLabelError, match=r"class 1 is not in the list; expected one of \[0, 2, 3, -1, -2\]"):
        shown.toggle(1)
    shown.show_all()
    assert shown.shown().all()


def test_what_has_no_class_can_be_switched_off() -> None:
    shown = model()
    shown.toggle(UNOBSERVED)
    shown.toggle(REMOVED)
    assert np.array_equal(shown.shown(), shown.labelling.labels >= 0)


def test_the_threshold_for_confidence_hides_the_less_sure() -> None:
    shown = model()
    shown.min_confidence = 0.75
    assert np.array_equal(shown.shown(), probabilities_of(shown.labelling).max(axis=1) >= np.float32(0.75))


def test_the_threshold_for_probability_goes_by_the_shown_classes_and_not_by_labels() -> None:
    shown = model()
    shown.isolate(2)
    shown.min_probability = 0.15
    assert np.array_equal(shown.shown(), probabilities_of(shown.labelling)[:, 2] >= np.float32(0.15))
    assert (shown.labelling.labels[shown.shown()] != 2).any()


def test_colours_are_of_the_mode() -> None:
    shown = model()
    assert shown.mode == BY_CLASS and shown.colors()[TRUTH == 3].std() > 0
    grey = np.rint(SCENE.colors() * 255).mean(axis=1, keepdims=True)
    ball = grey + FILL * (np.array(shown.color(3)) - grey)  # the photo's light and shade, as in the overlays
    assert np.abs(shown.colors()[TRUTH == 3] - ball[TRUTH == 3]).max() <= 0.51
    mixed = probabilities_of(shown.labelling)[10:13] @ np.array([shown.color(k) for k in range(K)])
    seen = grey[10:13] + FILL * (mixed - grey[10:13])
    assert np.abs(shown.colors()[10:13] - seen).max() <= 1.01  # taken out: as it is rendered
    shown.mode = TRUE_COLOURS
    assert np.array_equal(shown.colors(), np.rint(SCENE.colors() * 255))
    shown.mode = BY_CONFIDENCE
    assert (shown.colors()[:7] == NOTHING_KNOWN).all() and (shown.colors()[7:] != NOTHING_KNOWN).any(axis=1).all()
    shown.mode = BY_RELIABILITY
    assert (shown.colors() == NOTHING_KNOWN).all()
    shown.reliability = np.linspace(0, 1, N, dtype=np.float32)
    assert len(np.unique(shown.colors(), axis=0)) > 100


def test_the_ramp_has_its_ends_and_grey_for_what_is_unknown() -> None:
    assert ramp(np.array([-1, 0, 1, 2, np.nan])).tolist() == [[122, 1, 30]] * 2 + [[0, 90, 130]] * 2 + [[120] * 3]


LABELS = st.lists(st.integers(-2, 30), min_size=1, max_size=200)


@given(LABELS, st.integers(0, 2**31), st.integers(1, 40))
def test_a_cut_has_every_gaussian_in_exactly_one_node_and_no_more_nodes_than_allowed(
    labels: list[int], seed: int, max_nodes: int
) -> None:
    confidence = np.random.default_rng(seed).random(len(labels)).astype(np.float32)
    parts = cut(np.array(labels, np.int32), confidence, max_nodes)
    assert len(parts) <= max_nodes
    assert np.array_equal(np.sort(np.concatenate(list(parts.values()))), np.arange(len(labels)))


class Browser:
    """A browser that keeps the splats which it is sent, for `SplatNodes` of `SCENE`."""

    def __init__(self) -> None:
        self.scene, self.sent = self, 0
        self.nodes: dict[str, Any] = {}
        self.show = SplatNodes(self, SPLATS).show  # type: ignore[arg-type]

    def add_gaussian_splats(self, name: str, *, scale: float, **gaussians: np.ndarray) -> Any:
        node = SimpleNamespace(visible=True, remove=lambda: self.nodes.pop(name))

        def set_gaussians(
            centers: np.ndarray, covariances: np.ndarray, rgbs: np.ndarray, opacities: np.ndarray
        ) -> None:
            self.sent += len(centers)
            node.members = [PLACES[center.tobytes()] for center in centers]
            node.rgba = np.concatenate([rgbs, opacities], axis=1)

        node.set_gaussians = set_gaussians
        set_gaussians(**gaussians)
        self.nodes[name] = node
        return node

    def atomic(self) -> AbstractContextManager[None]:
        return nullcontext()

    def flush(self) -> None:
        pass


SPLATS = Splats(SCENE)
PLACES = {center.tobytes(): i for i, center in enumerate(SPLATS.centers)}
OPACITIES = np.rint(255 * SCENE.opacities).astype(np.uint8)


def wanted(shown: ViewModel) -> dict[tuple[int, int], Node]:
    parts = cut(shown.labelling.labels, shown.labelling.confidence)
    return Picture(SCENE, parts, shown.shown(), shown.colors()).nodes


def test_what_the_browser_has_is_what_is_wanted_whatever_happens() -> None:
    """Random walks over all switches: a browser that gets what is sent shows what is wanted."""
    rng = np.random.default_rng(1)
    shown, browser = model(), Browser()
    for _ in range(120):
        label = int(rng.choice(shown.labels_in_use or [0]))
        step = int(rng.integers(8))
        if step == 0 and len(shown.labels_in_use) > 2:
            shown.remove(label)
        elif step == 1:
            shown.isolate(label)
        elif step == 2:
            shown.mode = str(rng.choice([BY_CLASS, BY_CONFIDENCE, TRUE_COLOURS]))
        elif step == 3:
            shown.min_confidence = float(rng.random())
        elif step == 4:
            shown.min_probability = float(rng.choice([0, rng.random()]))
        elif step == 5:
            shown.show_all()
        elif step == 6:
            shown.labelling = replace(shown.labelling, labels=np.roll(shown.labelling.labels, 3))
        else:
            shown.toggle(label)
        browser.show(wanted(shown))
        picture = np.zeros((N, 4), np.uint8)
        for node in browser.nodes.values():
            if node.visible:
                picture[node.members] = node.rgba
        expected = np.concatenate([shown.colors(), OPACITIES[:, None]], axis=1)
        assert np.array_equal(picture[shown.shown()], expected[shown.shown()])
        assert not picture[~shown.shown(), 3].any()
        sent = browser.sent
        browser.show(wanted(shown))
        assert browser.sent == sent


def test_a_class_and_a_mark_of_the_slider_are_switched_without_sending_a_gaussian() -> None:
    shown, browser = model(), Browser()
    browser.show(wanted(shown))
    assert browser.sent == N and all(node.visible for node in browser.nodes.values())
    shown.toggle(1)
    browser.show(wanted(shown))
    assert not all(node.visible for node in browser.nodes.values())
    for mark in range(BANDS + 1):
        shown.min_confidence = mark * (1 / BANDS)
        browser.show(wanted(shown))
    assert browser.sent == N


def test_what_is_shown_is_saved_with_meshes_to_collide_with_in_usd_alone(tmp_path: Path) -> None:
    from pxr import Usd

    state = ViewerState(model(), [], {}, "cpu")
    state.change(lambda shown: shown.toggle(2))
    name, content = state.selection("usd", "hull")
    (tmp_path / name).write_bytes(content)
    stage = Usd.Stage.Open(str(tmp_path / name))
    meshes = [prim.GetParent().GetName() for prim in stage.Traverse() if prim.GetName() == "collision"]
    assert sorted(meshes) == ["class_1_red_ball", "class_3_box"]
    with pytest.raises(SettingsError, match="format glb: holds no meshes to collide with"):
        state.selection("glb", "hull")


def with_parts() -> ViewerState:
    """The table, of whose red ball two halves are known, and of the others that they make a whole."""
    objects = model().labelling
    return ViewerState(ViewModel(SCENE, objects, class_ids=tuple(NAMES), tree=tree_of_balls()), [], {}, "cpu")


def test_a_level_lists_its_nodes_in_colours_that_stay() -> None:
    state = with_parts()
    colors = {row.name: row.color for row in state.model.rows()}
    state.set_level(0.85)
    fine = {row.name: row for row in state.model.rows()}
    assert set(fine) - set(colors) == {"red ball.1", "red ball.2"} and "red ball" not in fine
    assert state.model.ids() == [0, 2, 3, 4, 5]
    assert all(fine[name].color == color for name, color in colors.items() if name in fine)
    assert fine["red ball.1"].color != fine["red ball.2"].color
    np.testing.assert_allclose(
        probabilities_of(state.model.labelling).sum(axis=1), (state.objects.labels != -1), atol=1e-5
    )
    state.set_level(0.2)
    assert [row.name for row in state.model.rows() if row.label > 0] == ["red ball", "whole_001"]
    state.set_level(0.5)
    assert state.model.labelling is state.objects


def test_what_is_clicked_offers_its_parts_and_its_whole() -> None:
    state = with_parts()
    inside = int(np.flatnonzero(TRUTH == 1)[-1])
    assert state.node_of(inside) == 1
    state.show_parts(1)
    np.testing.assert_array_equal(state.model.shown(), state.objects.labels == 1)
    part = state.node_of(inside)
    assert part in (4, 5)
    state.show_whole(part)
    assert state.granularity == 0.5 and state.node_of(inside) == 1
    state.show_whole(2)
    np.testing.assert_array_equal(state.model.shown(), np.isin(state.objects.labels, [2, 3]))
    assert state.node_of(int(np.flatnonzero(TRUTH == 0)[50])) == 0
    name, content = state.selection("ply")
    assert name == "selection.ply" and content


def test_corrections_are_of_objects_on_every_level_and_the_tree_is_saved(tmp_path: Path) -> None:
    state = with_parts()
    state.set_level(0.85)
    camera = ring(1)[0]
    (uv,), _ = camera.project(SCENE.means[TRUTH == 1].mean(axis=0, keepdims=True))
    assert state.correct(disc(camera, *uv, 3, 2)) > 0
    gone = (state.objects.labels == 2) & (TRUTH == 1)
    assert gone.any() and set(np.array(state.model.ids())[state.model.labelling.labels[gone]]) == {2}
    (tmp_path / "s.npz").write_bytes(state.segmentation_npz()[1])
    saved = Segmentation.load(tmp_path / "s.npz", SCENE)
    np.testing.assert_array_equal(saved.labels, state.objects.labels)
    assert saved.tree is not None and saved.tree.names(saved.class_names)[4] == "red ball.1"
    assert state.undo()
    state.added_names[K] = "spoon"
    assert state.correct(disc(camera, *uv, 3, K)) > 0
    spoon = state.objects.labels == K
    assert state.model.name(int(state.model.labelling.labels[spoon][0])) == "spoon" and state.model.rows()
    assert all(state.node_of(int(i)) is None for i in np.flatnonzero(spoon)[:3])
    (tmp_path / "s.npz").write_bytes(state.segmentation_npz()[1])
    assert Segmentation.load(tmp_path / "s.npz", SCENE).tree is None


def test_what_is_saved_blends_into_views_as_what_was_read_but_for_what_was_corrected(tmp_path: Path) -> None:
    codes = np.random.default_rng(0).dirichlet(np.full(K, 0.7), len(SCENE)).astype(np.float32)
    read, camera = Segmentation.from_codes(SCENE, codes, NAMES).calibrated(0.3), ring(1)[0]
    operator = make_operator(SCENE, camera)
    state = ViewerState(ViewModel(SCENE, Labelling.of(read), class_ids=tuple(NAMES), read=read), [], {}, "cpu")

    def saved() -> Segmentation:
        (tmp_path / "s.npz").write_bytes(state.segmentation_npz()[1])
        return Segmentation.load(tmp_path / "s.npz", SCENE)

    for found, expected in zip(saved().render(operator), read.render(operator), strict=True):
        np.testing.assert_array_equal(found, expected)
    (uv,), _ = camera.project(SCENE.means[TRUTH == 1].mean(axis=0, keepdims=True))
    state.added_names[K] = "spoon"
    assert state.correct(disc(camera, *uv, 3, K)) > 0
    labels = saved().label_map(operator)
    assert labels[int(uv[1]), int(uv[0])] == K and (labels == read.label_map(operator)).mean() > 0.9


def test_ids_of_a_scene_that_changes_are_saved() -> None:
    grown = LivingScene.of(SCENE).apply(SceneDelta(removed=np.array([0])))[0].scene
    _, content = ViewerState(ViewModel(grown, Labelling.unknown(N - 1)), [], {}, "cpu").segmentation_npz()
    with np.load(BytesIO(content)) as saved:
        np.testing.assert_array_equal(saved["ids"], np.arange(1, N))


def test_a_class_that_was_added_stays_apart_from_those_that_turn_up_in_a_live_source_and_joins_its_namesake() -> None:
    state, camera = ViewerState(model(), [], {}, "cpu"), ring(1)[0]
    (uv,), _ = camera.project(SCENE.means[TRUTH == 1].mean(axis=0, keepdims=True))
    state.added_names[K] = "spoon"
    assert state.correct(disc(camera, *uv, 3, K)) > 0
    spoon = state.objects.labels == K
    state.model.toggle(K)
    labels, names = state._learnt.labels, state._learnt.class_names
    wider = np.pad(probabilities_of(state._learnt), ((0, 0), (0, 1)))
    state.replace(labelled(labels, wider, {**names, K: "fork"}))
    np.testing.assert_array_equal(state.objects.labels == K + 1, spoon)
    assert state.objects.class_names[K + 1] == "spoon" and state.model.hidden == {K + 1}
    state.replace(labelled(labels, np.pad(wider, ((0, 0), (0, 2))), {**names, K: "fork", K + 1: "cup", K + 2: "spoon"}))
    np.testing.assert_array_equal(state.objects.labels == K + 2, spoon)
    assert not state.added_names and state.undo() and not (state.objects.labels == K + 2).any()


def test_a_correction_may_be_of_any_class_that_a_segmentation_can_have() -> None:
    state, camera = ViewerState(model(), [], {}, "cpu"), ring(1)[0]
    (uv,), _ = camera.project(SCENE.means[TRUTH == 1].mean(axis=0, keepdims=True))
    assert state.correct(disc(camera, *uv, 3, 300)) > 0


def test_levels_need_a_tree() -> None:
    with pytest.raises(SettingsError, match="parts and wholes are not known"):
        ViewerState(model(), [], {}, "cpu").set_level(0.5)
