"""Which blocks of a mask EM goes through: all near boundaries, and of the others one for four."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_scenes import look_at

from gsseg_core.data.view import View
from gsseg_core.learn.em.block_weights import FAR, NEAR, STEP, block_weights
from gsseg_core.learn.em.em_learner import EMLearner
from gsseg_core.scene.gaussian_scene import GaussianScene


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 70), st.integers(1, 70), st.integers(0, 10**6))
def test_all_within_a_block_of_a_boundary_counts_once_and_of_the_rest_one_in_four_by_four(
    height: int, width: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    labels = np.zeros((height, width), np.int32)
    for label in range(1, 4):
        y, x = rng.integers(0, height), rng.integers(0, width)
        labels[y : y + rng.integers(0, 20), x : x + rng.integers(0, 20)] = rng.choice([label, -1])
    weights = block_weights(labels, labels)
    assert weights.shape == (-(-height // 4), -(-width // 4))
    rows, columns = np.indices(labels.shape)
    for y, x in np.ndindex(*weights.shape):
        first = (4 * (y - NEAR), 4 * (x - NEAR))
        # One px more: a boundary has two sides.
        near = (rows >= first[0] - 1) & (rows <= first[0] + 4 * (2 * NEAR + 1))
        near &= (columns >= first[1] - 1) & (columns <= first[1] + 4 * (2 * NEAR + 1))
        if len(np.unique(labels[near])) == 1:
            assert weights[y, x] in (0, FAR)
    inside = labels[8:-8, 8:-8]
    if inside.size and (labels == labels[0, 0]).all():
        assert (weights == FAR).sum() == pytest.approx(weights.size / STEP**2, abs=sum(weights.shape))
    same = labels[:, 1:] != labels[:, :-1]
    for y, x in zip(*same.nonzero(), strict=True):
        assert weights[y // 4, x // 4] == weights[y // 4, (x + 1) // 4] == 1


def test_blocks_follow_from_where_boundaries_are_whatever_the_labels_are_called_and_differ_from_view_to_view() -> None:
    masks = [np.zeros((64, 80), np.int32) for _ in range(40)]
    for i, mask in enumerate(masks):
        mask[i : i + 20, 30:50] = 1
    of_views = [block_weights(mask, mask) for mask in masks]
    assert (sum(of_views) > 0).all()
    for mask, weights in zip(masks, of_views, strict=True):
        np.testing.assert_array_equal(block_weights(7 - mask, 7 - mask), weights)


@pytest.mark.parametrize("column", [6, 10])
def test_a_gaussian_by_itself_that_only_blocks_left_out_see_keeps_its_votes(column: int) -> None:
    camera = look_at("view", np.array([0.0, 0.0, 3.0]), 16, 16, 30.0)
    at = np.linalg.inv(camera.world_to_camera) @ [*(3 / 30 * (np.array([column, 6]) + 0.5 - 8)), 3, 1]
    scene = GaussianScene.from_arrays(
        at[None, :3], np.eye(4)[:1], np.full((1, 3), 1e-4), np.ones(1), np.zeros((1, 1, 3))
    )
    learner = EMLearner(scene, 2)
    assert learner.observe(View.from_arrays(camera, np.ones((16, 16), np.int32)))
    assert learner.fit().observed_.all() and learner.codes_.tolist() == [[0, 1]]
