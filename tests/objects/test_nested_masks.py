"""Masks that lie in each other: a view votes by its finest ones and by its outermost ones, for objects and wholes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from per_view_ids import agreement, in_halves
from small_scenes import NUM_CLASSES, balls_on_a_table, clean_views

from gsseg_core.data.soft_masks import SeenLabels
from gsseg_core.data.view import View
from gsseg_core.learn.em.em_learner import EMLearner
from gsseg_core.objects.lifted_segments import Lifted
from gsseg_core.objects.object_table import find_objects
from gsseg_core.objects.tree_growing import grow_tree
from gsseg_core.raster.backends import make_operator
from gsseg_core.segmentation import Segmentation

SCENE, TRUTH = balls_on_a_table()


def in_halves_of_one_whole(view: View, wholes: tuple[int, ...]) -> View:
    """The first ball under two ids; masks around some of the objects, of which all lies in one, have the id 1."""
    cut = in_halves(view, 1).read_labels()
    outermost = np.arange(cut.max() + 1, dtype=np.int32)
    outermost[[*wholes]] = 1
    return View.from_seen(view.camera, SeenLabels(cut, outermost=outermost))


def test_parts_that_lie_in_a_mask_of_the_whole_are_one_object_if_some_views_show_it_in_one_piece() -> None:
    views = [in_halves_of_one_whole(view, (51,)) if i % 4 else view for i, view in enumerate(clean_views(16))]
    table = find_objects(SCENE, views)
    assert table.num_objects == 3 and agreement(table, clean_views(16)) == 1.0
    flat = find_objects(SCENE, [View.from_arrays(view.camera, view.read_labels()) for view in views])
    assert flat.num_objects > 3


def test_parts_that_all_views_show_apart_are_parts_of_a_whole_and_no_object() -> None:
    views = [in_halves_of_one_whole(view, (51,)) for view in clean_views(16)]
    table = find_objects(SCENE, views)
    assert table.num_objects == 4
    learner = EMLearner(SCENE, 5)
    learner.observe_all([table.relabelled(view) for view in views])
    tree = table.with_tree(Segmentation.from_codes(SCENE, learner.fit().codes_, table.class_names)).tree
    assert tree is not None
    halves = {k for k in range(1, 5) if tree.parents[k] >= 5}
    assert len(halves) == 2 and len({tree.parents[k] for k in halves}) == 1


def test_objects_that_lie_in_one_mask_while_each_has_its_own_stay_two() -> None:
    """The halves of the first are one in a third of the views; it and the second are so in none."""
    views = [
        in_halves_of_one_whole(view, (51, 2)) if i % 3 else View.from_seen(
            view.camera, SeenLabels(view.read_labels(), outermost=np.array([0, 1, 1, 3], np.int32))
        )
        for i, view in enumerate(clean_views(16))
    ]  # fmt: skip
    table = find_objects(SCENE, views)
    assert table.num_objects == 3 and agreement(table, clean_views(16)) == 1.0


def test_objects_that_lie_in_one_mask_make_a_whole_of_half_that_agreement() -> None:
    lifted = {v.name: Lifted.of(make_operator(SCENE, v.camera).lift(v.read_labels())) for v in clean_views(12)}
    nested = {name: replace(view, wholes=np.where(view.ids == 2, 1, view.ids)) for name, view in lifted.items()}
    tree = grow_tree(SCENE.means, TRUTH, NUM_CLASSES, nested, 0.6)
    assert tree.parents.tolist() == [-1, NUM_CLASSES, NUM_CLASSES, -1, -1]
    assert tree.agreement[NUM_CLASSES] == pytest.approx(0.5, abs=0.1)
