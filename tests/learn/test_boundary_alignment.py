"""Outlines of masks: moved to where the scene has edges, and left alone where they are right."""

from __future__ import annotations

from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from scipy import ndimage
from small_scenes import NUM_CLASSES, balls_on_a_table, clean_views, mean_iou

from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.data.view import View
from gsseg_core.demo.mask_errors import resize
from gsseg_core.errors import SettingsError
from gsseg_core.learn.em import boundary_alignment
from gsseg_core.learn.em.boundary_alignment import _boundary_strengths, _nearest_regions, align_boundaries, reach
from gsseg_core.learn.em.em_learner import EMLearner, EMSettings
from gsseg_core.learn.em.mask_offset import move_mask
from gsseg_core.learn.em.rejected_regions import connected_pixels
from gsseg_core.learn.em.scene_edges import scene_edges
from gsseg_core.raster.backends import make_operator
from gsseg_core.scene.gaussian_scene import GaussianScene

SCENE, _ = balls_on_a_table()
FARTHEST = 3
whatever_edges_tell = patch.object(boundary_alignment, "TELLING", 0)
SMALL_MASKS = arrays.arrays(np.int32, st.tuples(st.integers(1, 20), st.integers(1, 20)), elements=st.integers(-1, 2))


def discs(rows: int = 96, columns: int = 128) -> np.ndarray:
    """Four discs, two of which touch, on a background of two halves."""
    y, x = np.indices((rows, columns))
    labels = (x > columns // 2).astype(np.int32)
    for k, (row, column, radius) in enumerate(((26, 28, 15), (62, 34, 17), (62, 66, 15), (28, 100, 13))):
        labels[np.hypot(y - row, x - column) <= radius] = k + 2
    return labels


def edges_of(labels: np.ndarray) -> np.ndarray:
    """Edges where labels change, as a picture has them: two px wide, and some noise."""
    steps = sum(np.abs(np.gradient((labels == k).astype(np.float32), axis=axis)) for k in range(6) for axis in (0, 1))
    noise = np.random.default_rng(0).uniform(0, 0.3, labels.shape)
    edges: np.ndarray = (np.minimum(2 * steps, 2) + noise).astype(np.float32)
    return edges


def drawn_too_wide(labels: np.ndarray, shifts: dict[int, int]) -> np.ndarray:
    """Grow objects by so many px all around, or shrink them."""
    wrong = labels.copy()
    for k, shift in shifts.items():
        resize(wrong, k, shift)
    return wrong


@pytest.mark.parametrize(
    "shifts", [{2: 3}, {2: -3}, {3: 2, 4: -2}, {2: 1, 3: -1, 4: 2, 5: -3}, {2: 3, 3: 3, 4: 3, 5: 3}]
)
def test_objects_drawn_too_wide_or_too_narrow_get_their_outlines_back(shifts: dict[int, int]) -> None:
    labels = discs()
    wrong = drawn_too_wide(labels, shifts)
    aligned = align_boundaries(wrong, edges_of(labels), FARTHEST)
    assert (aligned != labels).sum() < 0.25 * (wrong != labels).sum()


def test_right_outlines_stay_where_they_are() -> None:
    labels = discs()
    np.testing.assert_array_equal(align_boundaries(labels, edges_of(labels), FARTHEST), labels)


@pytest.mark.parametrize("offset", [(0, 2), (-3, 4), (8, -8)])
def test_a_mask_beside_its_image_is_moved_as_a_whole(offset: tuple[int, int]) -> None:
    labels = discs()
    aligned = align_boundaries(move_mask(labels, offset), edges_of(labels), FARTHEST)
    there = move_mask(move_mask(np.zeros_like(labels), offset), (-offset[0], -offset[1])) == 0
    np.testing.assert_array_equal(aligned, np.where(there, labels, UNKNOWN))


def test_objects_drawn_too_wide_in_a_mask_beside_its_image_get_their_outlines_back() -> None:
    labels, shifts = discs(), {3: 2, 4: -2}
    wrong = move_mask(drawn_too_wide(labels, shifts), (4, 3))
    aligned = align_boundaries(wrong, edges_of(labels), FARTHEST)
    known = aligned >= 0
    assert (aligned != labels)[known].sum() < 0.25 * (wrong != labels)[known].sum()


@given(SMALL_MASKS, st.integers(-8, 8), st.integers(-8, 8))
def test_a_moved_mask_keeps_what_stays_in_the_image(labels: np.ndarray, rows: int, columns: int) -> None:
    moved = move_mask(labels, (rows, columns))
    for (y, x), label in np.ndenumerate(moved):
        inside = 0 <= y - rows < labels.shape[0] and 0 <= x - columns < labels.shape[1]
        assert label == (labels[y - rows, x - columns] if inside else UNKNOWN)


def test_a_little_evidence_moves_nothing() -> None:
    labels = discs()
    wrong = drawn_too_wide(labels, {2: 3})
    edges = edges_of(labels)
    assert (align_boundaries(wrong, edges, FARTHEST) != wrong).any()
    faint = np.full_like(edges, 0.1) + 0.2 * edges * (edges > 0.5)
    np.testing.assert_array_equal(align_boundaries(wrong, faint, FARTHEST), wrong)


def test_a_little_that_each_of_many_boundaries_gains_moves_none() -> None:
    y, x = np.indices((96, 128))
    inside = 11.5 - np.hypot((y % 32) - 16, (x % 32) - 16)  # px from the outlines of twelve discs
    labels = np.where(inside > 0, 1 + 4 * (y // 32) + x // 32, 0).astype(np.int32)

    def moved(stronger: float) -> bool:
        """Whether outlines go to edges that are a little farther inside, and so much stronger there."""
        edges = (np.abs(inside) < 2) * 1.0 + ((inside > 1) & (inside < 2)) * stronger
        return bool((align_boundaries(labels, edges.astype(np.float32), FARTHEST) != labels).any())

    assert moved(1.0) and not moved(0.5)
    with patch.object(boundary_alignment, "EACH_CLEAR", 0.0):
        assert moved(0.5)


def test_without_edges_nothing_moves() -> None:
    labels = discs()
    np.testing.assert_array_equal(align_boundaries(labels, np.zeros(labels.shape, np.float32), FARTHEST), labels)


def test_where_edges_are_no_stronger_along_boundaries_than_elsewhere_nothing_moves() -> None:
    labels = discs()
    posters = 12 * ndimage.gaussian_filter(np.random.default_rng(2).random(labels.shape, np.float32), 1)
    with whatever_edges_tell:
        assert (align_boundaries(labels, posters, FARTHEST) != labels).any()
    np.testing.assert_array_equal(align_boundaries(labels, posters, FARTHEST), labels)


@whatever_edges_tell
@given(SMALL_MASKS, st.integers(1, 3), st.integers(0, 2**32 - 1))
def test_pixels_move_to_regions_near_by_and_the_unknown_stays_unknown(
    labels: np.ndarray, farthest: int, seed: int
) -> None:
    edges = np.random.default_rng(seed).random(labels.shape, np.float32)
    before = labels.copy()
    aligned = align_boundaries(labels, edges, farthest)
    np.testing.assert_array_equal(labels, before)
    np.testing.assert_array_equal(aligned < 0, labels < 0)
    for row, column in np.argwhere(aligned != labels):
        y, x = np.indices(labels.shape)
        near = (y - row) ** 2 + (x - column) ** 2 <= (2 * farthest) ** 2
        assert aligned[row, column] in labels[near]


@whatever_edges_tell
@given(st.lists(st.integers(1, 19), min_size=1, max_size=30), st.integers(1, 3), st.integers(0, 2**32 - 1))
def test_a_view_turned_around_settles_turned_around(widths: list[int], farthest: int, seed: int) -> None:
    # Two regions, side by side: where there are more, some pixels are equally near to two, and either may be named.
    labels = (np.arange(20) < np.array(widths)[:, None]).astype(np.int32)
    edges = np.random.default_rng(seed).random(labels.shape, np.float32)
    aligned = align_boundaries(labels, edges, farthest)
    turned = align_boundaries(labels[::-1, ::-1].copy(), edges[::-1, ::-1].copy(), farthest)[::-1, ::-1]
    np.testing.assert_array_equal(aligned, turned)


@given(
    arrays.arrays(np.int32, st.tuples(st.integers(1, 90), st.integers(1, 20)), elements=st.integers(0, 1)),
    st.integers(1, 6),
)
def test_the_nearest_region_is_as_far_as_by_looking_at_all_pixels(labels: np.ndarray, farthest: int) -> None:
    region, _, _ = connected_pixels(labels)
    other, ring = _nearest_regions(region, farthest)
    pixels = np.stack(np.indices(labels.shape), axis=-1).reshape(-1, 2)
    away = np.sqrt(((pixels[:, None] - pixels) ** 2).sum(axis=2))
    away[region.ravel()[:, None] == region.ravel()] = np.inf
    nearest = away.min(axis=1)
    found = other.ravel() >= 0
    np.testing.assert_array_equal(found, nearest <= farthest)
    np.testing.assert_array_equal(ring.ravel()[found], np.ceil(nearest[found]))
    back = away == np.where(found, nearest, -1)[:, None]  # those that are nearest
    assert (back & (region.ravel() == other.ravel()[:, None])).any(axis=1)[found].all()
    assert (other.ravel()[found] != region.ravel()[found]).all()


def test_edges_are_summed_by_pair_and_ring_as_by_looking_at_all_pixels() -> None:
    labels, farthest = discs(), 6
    region, _, area = connected_pixels(labels)
    edges = np.random.default_rng(1).random(labels.shape, np.float32)
    other, ring = _nearest_regions(region, farthest)
    pairs, pair, lengths, strengths = _boundary_strengths(region, other, ring, edges, len(area), farthest)
    assert {tuple(sorted(p)) for p in np.stack([region, other], axis=-1)[other >= 0].tolist()} == set(
        map(tuple, pairs.tolist())
    )
    np.testing.assert_array_equal(pair.reshape(labels.shape) >= 0, other >= 0)
    for k, (low, high) in enumerate(pairs):
        for d in range(1, farthest + 1):
            for mine, theirs, column in ((low, high, farthest + d - 1), (high, low, farthest - d)):
                there = (region == mine) & (other == theirs) & (ring == d)
                assert lengths[k, column] == there.sum()
                assert strengths[k, column] == pytest.approx(edges[there].sum(dtype=np.float64))


def test_edges_of_a_scene_lie_along_its_objects() -> None:
    view = clean_views(1)[0]
    labels = view.read_labels()
    edges = scene_edges(make_operator(SCENE, view.camera), SCENE, labels, max(labels.shape))
    outline = ndimage.morphological_gradient(labels, size=3) > 0
    assert edges.shape == labels.shape and edges.dtype == np.float32 and edges.min() >= 0
    assert edges[outline].mean() > 2 * edges[~ndimage.binary_dilation(outline, iterations=2)].mean()


def test_a_scene_without_colour_has_no_edges() -> None:
    grey = GaussianScene.from_arrays(SCENE.means, SCENE.quats, SCENE.scales, SCENE.opacities, np.zeros_like(SCENE.sh))
    view = clean_views(1)[0]
    assert not scene_edges(make_operator(grey, view.camera), grey, view.read_labels(), 9).any()


def test_em_learns_more_from_masks_that_are_off_since_it_moves_them() -> None:
    rng = np.random.default_rng(3)
    wrong = [
        View.from_arrays(
            view.camera,
            drawn_too_wide(view.read_labels(), {k: int(rng.integers(-2, 3)) for k in range(1, NUM_CLASSES)}),
        )
        for view in clean_views(4)
    ]

    def learnt(edge_px: int) -> float:
        learner = EMLearner(SCENE, NUM_CLASSES, EMSettings(edge_px=edge_px))
        learner.observe_all(wrong)
        return mean_iou(learner.fit())

    assert learnt(3) > learnt(0)


def test_a_view_is_taken_back_as_exactly_as_it_was_added() -> None:
    learner = EMLearner(SCENE, NUM_CLASSES, EMSettings())
    views = clean_views(3)
    learner.observe_all(views[:2])
    before = learner._votes.dense()
    learner.observe(views[2])
    learner.retract(views[2].name)
    np.testing.assert_array_equal(learner._votes.dense(), before)


def test_a_negative_width_is_refused() -> None:
    with pytest.raises(SettingsError, match="edge_px"):
        EMSettings(edge_px=-1)


@pytest.mark.parametrize("seed", range(4))
def test_edges_near_boundaries_are_all_that_moving_them_takes(seed: int) -> None:
    """A mask is aligned with edges that are drawn near its boundaries as with those of the whole view."""
    rng = np.random.default_rng(seed)
    view = clean_views(4)[seed]
    camera = replace(view.camera, width=480, height=448, K=view.camera.K * [[7], [7], [1]])
    operator, labels = make_operator(SCENE, camera), np.zeros((448, 480), np.int32)
    for label in range(1, 4):
        y, x = rng.integers(0, 400, 2)
        labels[y : y + 30, x : x + 25] = label
    edges, some = (scene_edges(operator, SCENE, labels, distance) for distance in (max(labels.shape), reach(3) + 1))
    assert (some != edges).any()
    np.testing.assert_array_equal(align_boundaries(labels, some, 3), align_boundaries(labels, edges, 3))
