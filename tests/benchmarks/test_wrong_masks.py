"""The errors that masks are given: as many and as large as the settings say, and the same for the same seed."""

from __future__ import annotations

import zlib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage
from small_scenes import make_grid
from wrong_masks import WrongMasks, corrupt

from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.demo import mask_errors
from gsseg_core.errors import SettingsError

NONE = WrongMasks(missed=0, swapped=0, edge_px=0)


def test_no_errors_leave_the_labels_as_they_are() -> None:
    labels = make_grid()
    wrong = corrupt(labels, np.random.default_rng(0), NONE)
    np.testing.assert_array_equal(wrong, labels)
    assert wrong is not labels and wrong.dtype == np.int32


def test_the_same_seed_gives_the_same_errors_and_another_one_others() -> None:
    labels = make_grid()
    settings = WrongMasks(holes=0.5, blobs=3)
    first, again, other = (corrupt(labels, np.random.default_rng(seed), settings) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


def test_errors_of_the_demo_are_drawn_as_here() -> None:
    labels = make_grid()
    of_demo = mask_errors.corrupt(labels, np.random.default_rng(4))
    np.testing.assert_array_equal(corrupt(labels, np.random.default_rng(4)), of_demo)
    assert (of_demo != labels).any()


def test_views_drawn_from_one_generator_differ() -> None:
    rng = np.random.default_rng(0)
    assert (corrupt(make_grid(), rng) != corrupt(make_grid(), rng)).any()


def test_objects_are_missed_and_swapped_as_often_as_asked() -> None:
    labels = make_grid()
    rng = np.random.default_rng(0)
    middles = labels > 0
    missed = swapped = 0.0
    for _ in range(100):
        wrong = corrupt(labels, rng, WrongMasks(missed=0.15, swapped=0.1, edge_px=0, missed_label=99))
        assert (wrong[~middles] == 0).all()
        missed += (wrong[middles] == 99).mean() / 100
        swapped += ((wrong != labels) & (wrong != 99))[middles].mean() / 100
        assert np.isin(wrong, [0, 99, *range(1, 31)]).all()
    assert missed == pytest.approx(0.15, abs=0.03)
    assert swapped == pytest.approx(0.10, abs=0.03)


def test_every_object_has_one_label_again() -> None:
    labels = make_grid()
    wrong = corrupt(labels, np.random.default_rng(3), WrongMasks(missed=0.4, swapped=0.4, edge_px=0))
    for k in range(1, 31):
        assert len(np.unique(wrong[labels == k])) == 1


def test_edges_move_by_every_amount_up_to_the_largest_and_no_further() -> None:
    labels = make_grid(rows=10, columns=10)
    wrong = corrupt(labels, np.random.default_rng(0), WrongMasks(missed=0, swapped=0, edge_px=3))
    widths = [np.ptp(np.flatnonzero((wrong == k).any(axis=0))) + 1 for k in range(1, 101)]
    assert set(widths) == {16 + 2 * shift for shift in range(-3, 4)}
    # Distance to the nearest pixel of the other side, so no pixel further than 3 px from an outline changes.
    depth = np.maximum(*(ndimage.distance_transform_edt(side) for side in (labels > 0, labels == 0)))
    assert depth[wrong != labels].max() <= 3


def test_what_a_shrunk_object_gives_up_goes_to_its_neighbours() -> None:
    labels = np.repeat(np.array([[4, 7]], np.int32), 20, axis=1).repeat(10, axis=0)
    rng = np.random.default_rng(0)
    for _ in range(10):
        wrong = corrupt(labels, rng, WrongMasks(missed=0, swapped=0, edge_px=5))
        assert set(np.unique(wrong)) <= {4, 7}


def test_holes_and_blobs_come_where_they_are_asked_for() -> None:
    labels = make_grid()
    holed = corrupt(labels, np.random.default_rng(0), WrongMasks(0, 0, 0, holes=1, hole_px=4))
    assert (holed[labels == 0] == 0).all()
    assert all((holed[labels == k] == 0).any() for k in range(1, 31))
    blobbed = corrupt(labels, np.random.default_rng(0), WrongMasks(0, 0, 0, blobs=5, blob_px=6))
    changed = blobbed != labels
    assert 0 < changed.sum() < 20 * np.pi * 12**2
    assert (blobbed[changed] > 0).all()


def test_one_kind_of_error_does_not_change_the_draws_of_another() -> None:
    labels = make_grid()
    plain = corrupt(labels, np.random.default_rng(5), WrongMasks(edge_px=0))
    blobbed = corrupt(labels, np.random.default_rng(5), WrongMasks(edge_px=0, blobs=2, blob_px=5))
    assert 0 < (plain != blobbed).mean() < 0.05


def test_exchanged_objects_pair_up_and_keep_all_labels() -> None:
    labels = make_grid()
    rng, exchanged = np.random.default_rng(0), 0.0
    for _ in range(100):
        wrong = corrupt(labels, rng, replace(NONE, exchanged=0.4))
        seen = [int(wrong[labels == k][0]) for k in range(1, 31)]
        assert sorted(seen) == list(range(1, 31))
        assert all(seen[seen[k - 1] - 1] == k for k in range(1, 31))
        assert all((wrong[labels == k] == seen[k - 1]).all() for k in range(1, 31))
        exchanged += np.mean(np.array(seen) != np.arange(1, 31)) / 100
    assert exchanged == pytest.approx(0.4, abs=0.05)


def test_no_object_of_a_bad_frame_has_its_own_label() -> None:
    labels = make_grid()
    rng, settings = np.random.default_rng(0), replace(NONE, bad_frame=0.3)
    frames = [corrupt(labels, rng, settings) for _ in range(200)]
    bad = [frame for frame in frames if (frame != labels).any()]
    assert len(bad) / len(frames) == pytest.approx(0.3, abs=0.08)
    assert all((frame[labels > 0] != labels[labels > 0]).all() and (frame[labels == 0] == 0).all() for frame in bad)


def test_a_shifted_map_is_moved_as_a_whole_and_no_further_than_asked() -> None:
    labels = make_grid()
    wrong = corrupt(labels, np.random.default_rng(1), replace(NONE, shift_px=9))
    moves = [(y, x) for y in range(-9, 10) for x in range(-9, 10)]
    inside = slice(9, -9), slice(9, -9)
    same = [move for move in moves if (np.roll(labels, move, (0, 1))[inside] == wrong[inside]).all()]
    assert len(same) == 1 and 0 < np.hypot(*same[0]) <= 9.5
    assert np.isin(wrong, labels).all()


def test_what_is_missed_gets_the_label_of_most_pixels_where_none_is_given() -> None:
    labels = np.pad(np.full((4, 4), 3, np.int32), 6, constant_values=7)
    wrong = corrupt(labels, np.random.default_rng(0), replace(NONE, missed=1.0, missed_label=None))
    assert (wrong == 7).all()


def test_a_seed_gives_the_masks_that_it_gave_before_there_were_more_kinds() -> None:
    rng, settings = np.random.default_rng(11), WrongMasks(holes=0.3, blobs=2)
    sums = [zlib.crc32(corrupt(make_grid(), rng, settings).tobytes()) for _ in range(3)]
    assert sums == [2270022631, 720714654, 242888160]


@given(seed=st.integers(0, 10**6), height=st.integers(1, 12), width=st.integers(1, 12), classes=st.integers(1, 4))
def test_unknown_stays_unknown_and_labels_stay_labels_on_any_map(
    seed: int, height: int, width: int, classes: int
) -> None:
    rng = np.random.default_rng(seed)
    labels = rng.integers(UNKNOWN, classes, (height, width))
    wrong = corrupt(labels, rng, WrongMasks(0.3, 0.3, 4, 0.5, blobs=2, exchanged=0.5, bad_frame=0.2, shift_px=3))
    assert wrong.shape == labels.shape
    assert (wrong[labels == UNKNOWN] == UNKNOWN).all()
    assert np.isin(wrong, [UNKNOWN, 0, *np.unique(labels)]).all()


@pytest.mark.parametrize(
    "wrong",
    [
        {"missed": -0.1},
        {"swapped": 1.5},
        {"missed": 0.6, "swapped": 0.6},
        {"edge_px": -1},
        {"blobs": float("nan")},
        {"exchanged": 2},
        {"shift_px": -1},
    ],
)
def test_impossible_settings_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(SettingsError, match=next(iter(wrong))):
        WrongMasks(**wrong)  # type: ignore[arg-type]
