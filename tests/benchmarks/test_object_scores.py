"""Scores of objects cut out of a scene."""

from __future__ import annotations

import numpy as np
import pytest
from object_scores import ObjectScores, objects_of
from small_scenes import HEIGHT, WIDTH, build, look_at, ring, true_labels

from gsseg_core.errors import MaskSizeError
from gsseg_core.raster.backends import make_operator
from gsseg_core.raster.depth import surface


def test_a_silhouette_counts_what_sticks_out_and_not_what_is_hidden() -> None:
    """A small disc, wholly behind a larger one or beside it."""
    camera = look_at("front", np.array([0.0, -4.0, 0.0]))
    means = np.array([[0, 0, 0], [0, 1.0, 0]])
    scene = build(np.array([1, 2]), means, np.array([[0.5, 0.02, 0.5], [0.2, 0.02, 0.2]]))
    truth = true_labels(scene, np.array([1, 2]), camera)
    depth = surface(scene, make_operator(scene, camera)).depth
    objects = objects_of(scene, np.array([1, 2]))
    assert not (truth == 2).any()
    truth[0, 0] = 2  # so that object 2 is scored; the scene is empty there
    both = ObjectScores(3)
    both.add(objects, camera, truth, depth)
    covered = int((surface(objects[2], make_operator(objects[2], camera)).coverage > 0.5).sum())
    assert covered > 5
    assert both.whole.iou[2] == 0 and both.whole._counts[0, 2, 2] == covered
    assert both.visible._counts[0, 2, 2] == 0
    assert np.isnan(both.whole.iou[0]) and both.whole.iou[1] == both.visible.iou[1] > 0.9
    scene.means[1] = [1.5, 0, 0]
    beside = ObjectScores(3)
    beside.add(objects_of(scene, np.array([1, 2])), camera, truth, surface(scene, make_operator(scene, camera)).depth)
    assert beside.visible._counts[0, 2, 2] > 5
    lost = ObjectScores(3)
    lost.add({}, camera, truth, depth)
    assert lost.visible.iou[1] == 0 and np.isnan(lost.visible.iou[0])


def test_a_true_mask_of_another_size_is_refused() -> None:
    with pytest.raises(MaskSizeError, match=r"truth has shape \(3, 4\)"):
        ObjectScores(2).add({}, ring(1)[0], np.zeros((3, 4), np.int32), np.zeros((HEIGHT, WIDTH)))
