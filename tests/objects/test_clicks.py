"""Clicks become masks: regions merge as the energy says, the one that lasts is taken, and clicks outside are obeyed."""

from __future__ import annotations

import functools

import numpy as np
import pytest
import small_scenes
from hypothesis import given, settings
from hypothesis import strategies as st

from gsseg_core.errors import NoUsableViewsError, SettingsError
from gsseg_core.objects.clicks import click_labels, longest_lived, merge_tree
from gsseg_core.objects.pick import pick_clicks

SCENE, TRUTH = small_scenes.balls_on_a_table()
CAMERA = small_scenes.ring(1)[0]
LABELS = small_scenes.true_labels(SCENE, TRUTH, CAMERA)


def middle(label: int) -> tuple[int, int]:
    rows, columns = np.nonzero(label == LABELS)
    place = np.hypot(rows - rows.mean(), columns - columns.mean()).argmin()
    return int(rows[place]), int(columns[place])


def iou(found: np.ndarray, true: np.ndarray) -> float:
    return float((found & true).sum() / (found | true).sum())


def slow_tree(features: np.ndarray) -> list[tuple[frozenset[int], float]]:
    """Regions and prices in the order in which they come to be, all pairs looked at before every merge."""
    height, width, _ = features.shape
    flat = features.reshape(height * width, -1)
    regions = [frozenset([i]) for i in range(height * width)]
    touching = [(i, j) for i in range(height * width) for j in (i + 1, i + width)
                if j < height * width and (j == i + width or j % width)]  # fmt: skip
    out, highest = [], 0.0

    @functools.cache  # All pairs are looked at before every merge, and most of them have been before.
    def price(a: frozenset[int], b: frozenset[int]) -> float:
        border = sum((i in a and j in b) or (i in b and j in a) for i, j in touching)
        apart = ((flat[list(a)].mean(axis=0) - flat[list(b)].mean(axis=0)) ** 2).sum()
        return float(len(a) * len(b) / (len(a) + len(b)) * apart / border) if border else np.inf

    while len(regions) > 1:
        pairs = [(price(a, b), i, j) for i, a in enumerate(regions) for j, b in enumerate(regions[:i])]
        least, i, j = min(pairs)
        highest = max(highest, least)
        out.append((regions[i] | regions[j], highest))
        regions = [region for k, region in enumerate(regions) if k not in (i, j)] + [out[-1][0]]
    return out


@settings(max_examples=8)
@given(seed=st.integers(0, 1000), height=st.integers(1, 4), width=st.integers(2, 4))
def test_regions_merge_in_the_order_of_the_slow_twin(seed: int, height: int, width: int) -> None:
    features = np.random.default_rng(seed).normal(size=(height, width, 2))
    tree, slow = merge_tree(features), slow_tree(features)
    n = height * width
    for new, (cells, price) in enumerate(slow, n):
        part = np.arange(2 * n - 1) == new
        for below in range(new - 1, -1, -1):
            part[below] |= part[tree.parent[below]]
        assert frozenset(np.flatnonzero(part[:n]).tolist()) == cells
        assert tree.price[new] == pytest.approx(price) and tree.size[new] == len(cells)
    assert (np.diff(tree.price[n:]) >= 0).all()


def test_the_region_that_lasts_is_the_one_that_stands_out_at_whatever_contrast() -> None:
    noise = np.random.default_rng(0).normal(size=(24, 24, 3))
    square = np.zeros((24, 24), bool)
    square[6:14, 8:18] = True
    for contrast in (1.0, 1e-3, 1e3):
        features = contrast * (0.02 * noise + square[..., None])
        tree = merge_tree(features)
        assert tree.size[longest_lived(tree, 10 * 24 + 12)] == square.sum()


@pytest.mark.parametrize("label", [1, 2, 3])
def test_a_click_gives_the_object_around_it(label: int) -> None:
    found = click_labels(SCENE, CAMERA, [middle(label)])
    known = found >= 0
    assert iou((found == 1) & known, (label == LABELS) & known) > 0.7
    assert found[middle(label)] == 1


def test_several_clicks_add_up_and_one_outside_takes_its_region_away() -> None:
    both = click_labels(SCENE, CAMERA, [middle(1), middle(2)])
    assert both[middle(1)] == both[middle(2)] == 1
    without = click_labels(SCENE, CAMERA, [middle(1)], [middle(2)])
    assert without[middle(1)] == 1 and without[middle(2)] == 0


def test_a_click_in_one_view_gives_the_object_in_3d() -> None:
    picked = pick_clicks(SCENE, CAMERA, [middle(1)], [middle(2), middle(3)])
    assert iou(picked.membership >= 0.5, TRUTH == 1) > 0.6


def test_clicks_are_the_same_as_tuples_as_lists_of_json_and_as_rows_of_an_array() -> None:
    clicks = [(24, 20), (26, 21)], [(1, 1)]
    expected = click_labels(SCENE, CAMERA, *clicks)
    for other in ([[list(click) for click in part] for part in clicks], [np.array(part) for part in clicks]):
        np.testing.assert_array_equal(click_labels(SCENE, CAMERA, *other), expected)


def test_clicks_that_say_nothing_are_refused() -> None:
    with pytest.raises(SettingsError, match="expected a row from 0 to"):
        click_labels(SCENE, CAMERA, [(-1, 0)])
    with pytest.raises(SettingsError, match="at least one inside"):
        click_labels(SCENE, CAMERA, [], [(0, 0)])
    with pytest.raises(SettingsError, match="none that is both"):
        click_labels(SCENE, CAMERA, [(1, 1)], [(1, 1)])
    nothing = SCENE.subset(np.arange(len(SCENE)) == len(SCENE) - 1)  # one Gaussian, high above
    with pytest.raises(NoUsableViewsError, match="expected a click on something"):
        click_labels(nothing, CAMERA, [(0, 0)])
