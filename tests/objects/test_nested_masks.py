"""Masks that lie in each other: a view votes by its finest ones and by its outermost ones, for objects and wholes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from per_view_ids import agreement, in_halves
from small_scenes import NUM_CLASSES, balls_on_a_table, clean_views

from gsseg_core.data.soft_masks import SeenLabels
from gsseg_core.data.view import View
from gsseg_core.objects.lifted_segments import Lifted
from gsseg_core.objects.object_table import find_objects
from gsseg_core.objects.tree_growing import grow_tree
from gsseg_core.raster.backends import make_operator

SCENE, TRUTH = balls_on_a_table()


def in_halves_of_one_whole(view: View, wholes: tuple[int, ...]) -> View:
    """The first ball under two ids; masks around some of the objects, of which all lies in one, have the id 1."""
    cut = in_halves(view, 1).read_labels()
    outermost = np.arange(cut.max() + 1, dtype=np.int32)
    outermost[[*wholes]] = 1
    return View.from_seen(view.camera, SeenLabels(cut, outermost=outermost))


def test_parts_that_lie_in_a_mask_of_the_whole_are_one_object() -> None:
    wholes = [in_halves_of_one_whole(view, (51,) if i % 8 else ()) for i, view in enumerate(clean_views(16))]
    table = find_objects(SCENE, wholes)
    assert table.num_objects == 3 and agreement(table, clean_views(16)) == 1.0
    flat = find_objects(SCENE, [View.from_arrays(view.camera, view.read_labels()) for view in wholes])
    assert flat.num_objects > 3


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
    lifted = {v.name: Lifted.of(make_operator(SCENE, v.camera).observe(v.read_labels())) for v in clean_views(12)}
    nested = {name: replace(view, wholes=np.where(view.ids == 2, 1, view.ids)) for name, view in lifted.items()}
    tree = grow_tree(SCENE.means, TRUTH, NUM_CLASSES, nested, 0.6)
    assert tree.parents.tolist() == [-1, NUM_CLASSES, NUM_CLASSES, -1, -1]
    assert tree.agreement[NUM_CLASSES] == pytest.approx(0.5, abs=0.1)
