"""A viewer of thousands of objects: memory and answers go by those that a Gaussian has."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from labellings import labelled, probabilities_of
from parts_of_balls import tree_of_balls
from small_scenes import NAMES, balls_on_a_table, many_classes, ring

from gsseg_core import csr_rows
from gsseg_core.raster.backends import make_operator
from gsseg_core.segmentation import REMOVED, UNOBSERVED, Segmentation
from gsseg_core.viewer import model as view_model
from gsseg_core.viewer.corrections import disc, region
from gsseg_core.viewer.model import Labelling, ViewModel
from gsseg_core.viewer.state import ViewerState

SCENE, TRUTH = balls_on_a_table()
K, MANY = len(NAMES), 5000
CAMERA = ring(1)[0]
((COLUMN, ROW),), _ = CAMERA.project(SCENE.means[TRUTH == 1].mean(axis=0, keepdims=True))


def many_objects() -> ViewerState:
    """The balls on a table among thousands of objects that have no Gaussian; two halves are known of the first ball."""
    tree = tree_of_balls()
    parents, agreement = np.full(MANY + 2, -1, np.int32), np.ones(MANY + 2, np.float32)
    parents[MANY:], agreement[1] = 1, 0.7
    leaves = np.where(TRUTH == 1, tree.leaves - K + MANY, TRUTH).astype(np.int32)
    tree = replace(tree, parents=parents, agreement=agreement, leaves=leaves, num_classes=MANY)
    read = Segmentation.from_codes(SCENE, np.eye(K, dtype=np.float32)[TRUTH], NAMES)
    names = {k: NAMES.get(k, f"object {k}") for k in range(MANY)}
    read = replace(read, labels=np.where(TRUTH == 3, np.int32(REMOVED), read.labels), class_names=names, tree=tree)
    return ViewerState(
        ViewModel(SCENE, Labelling.of(read), class_ids=tuple(names), tree=tree, read=read), [], {}, "cpu"
    )


def test_nothing_that_a_viewer_does_takes_memory_for_objects_that_no_gaussian_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(csr_rows, "_AT_A_TIME", 1 << 14)
    tracemalloc.start()
    try:
        state = many_objects()
        state.change(lambda model: setattr(model, "min_probability", 0.5))
        assert state.seen()[0].shown.all()
        assert state.correct(region(CAMERA, state.label_map(CAMERA), COLUMN, ROW, 2)) > 0
        moved = (state.objects.labels == 2) & (TRUTH == 1)
        state.set_level(0.85)
        of_ball, labels = TRUTH == 1, np.array(state.model.ids())[state.model.labelling.labels]
        assert moved.any() and (labels[moved] == 2).all() and set(labels[of_ball & ~moved].tolist()) == {MANY, MANY + 1}
        (tmp_path / "s.npz").write_bytes(state.segmentation_npz()[1])
        assert Segmentation.load(tmp_path / "s.npz", SCENE).labels[moved].max() == 2
        assert tracemalloc.get_traced_memory()[1] < len(SCENE) * MANY * 4 / 2
    finally:
        tracemalloc.stop()


def test_corrections_are_the_same_however_few_gaussians_are_mixed_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    found = []
    for at_a_time in (1 << 22, 3 * K):
        monkeypatch.setattr(csr_rows, "_AT_A_TIME", at_a_time)
        labels = np.where(TRUTH == 2, REMOVED, np.where(TRUTH == 3, UNOBSERVED, TRUTH)).astype(np.int32)
        known = np.eye(K, dtype=np.float32)[TRUTH] * (TRUTH != 3)[:, None]
        state = ViewerState(ViewModel(SCENE, labelled(labels, known, dict(NAMES))), [], {}, "cpu")
        for radius, label in ((30, 2), (12, 1), (7, 2)):
            state.correct(disc(CAMERA, COLUMN, ROW, radius, label))
        found.append((state.objects.labels, probabilities_of(state.objects)))
    for few, all_at_once in zip(*found, strict=True):
        np.testing.assert_array_equal(few, all_at_once)


def test_a_map_of_labels_has_the_label_that_is_seen_most_and_says_where_nothing_is() -> None:
    state = many_objects()
    state.change(lambda model: model.toggle(0))
    labels, shown = np.maximum(state.model.labelling.labels, -1), state.model.shown()
    used, place = np.unique(labels, return_inverse=True)
    image = make_operator(SCENE, CAMERA).without(~shown).render(np.eye(len(used), dtype=np.float32)[place])
    expected = np.where(image.max(axis=2) > 0, used[image.argmax(axis=2)], -1)
    assert {-1, 1, 2} <= set(np.unique(expected).tolist())
    np.testing.assert_array_equal(state.label_map(CAMERA), expected)


def test_a_press_on_one_of_many_classes_takes_time_by_their_number_and_not_by_its_square(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scene, truth = many_classes(count := 200)
    looks, palette = [], view_model.palette

    class Id(int):
        """An id that knows how often it was compared."""

        __hash__ = int.__hash__

        def __eq__(self, other: object) -> bool:
            looks.append("an id")
            return int(self) == other

    monkeypatch.setattr(view_model, "palette", lambda size: looks.extend(["a colour"] * size) or palette(size))
    names = {k: f"object {k}" for k in range(count)}
    segmentation = Segmentation.from_codes(scene, np.eye(count, dtype=np.float32)[truth], names)
    model = ViewModel(scene, Labelling.of(segmentation), class_ids=tuple(Id(k + 5 * (k > 0)) for k in range(count)))
    model.isolate(7)
    model.remove(8)
    assert len(model.rows()) == count - 1 and model.ids()[-1] == count + 4
    model.labelling = Labelling.of(segmentation)
    model.toggle(9)
    assert len(looks) <= 5 * count
