from __future__ import annotations

import doctest
from typing import NamedTuple

import numba as nb
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gsseg_core.csr_rows import CSRRows
from gsseg_core.errors import SettingsError
from gsseg_core.refine import knn_filter as refine
from gsseg_core.refine.knn_filter import before_clustering
from gsseg_core.refine.settings import RefineSettings
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.spatial import class_distances as class_distances_module
from gsseg_core.spatial.class_distances import class_distances
from gsseg_core.spatial.neighbourhood import HALF, Neighbours, neighbours_of


class Clustered(NamedTuple):
    probabilities: np.ndarray
    changed: np.ndarray


def among(means, k):
    return Neighbours.among(means, k) if len(means) > 1 else None


def cluster(means, probabilities, k=RefineSettings.k, *settings, neighbours=None, **named):
    codes, num_classes = CSRRows.from_dense(probabilities), probabilities.shape[1]
    rows, changed = refine.cluster(neighbours or among(means, k), codes, num_classes, *settings, **named)
    return Clustered(rows.dense(num_classes), changed)


def statistical_filter(means, labels, k=RefineSettings.k, *settings):
    return refine.statistical_filter(among(means, k), labels, *settings)


def slow_cluster(means, probabilities, each_weighs, k, beta):
    """Readable twin of `cluster`."""
    refined, changed = probabilities.astype(np.float64), np.zeros(len(means), bool)
    k = min(k, len(means) - 1)
    for i in range(len(means) if k else 0):
        if each_weighs[i] and probabilities[i].max() >= beta:
            continue
        distances = np.linalg.norm(means.astype(np.float64) - means[i], axis=1)
        distances[i] = np.inf
        radius = np.sort(distances)[k - 1]
        inside, tied = distances < radius, distances == radius
        weights = (inside + tied * (k - inside.sum()) / tied.sum()) * each_weighs
        if weights.any():
            refined[i], changed[i] = weights @ probabilities / weights.sum(), True
    return refined, changed


def slow_filter(means, labels, k, sigmas, num_classes):
    """Readable twin of `statistical_filter`."""
    removed = np.zeros(len(means), bool)
    for c in range(1, num_classes):
        members = np.flatnonzero(labels == c)
        if len(members) < 3:
            continue
        points = means[members].astype(np.float64)
        distances = np.sort(np.linalg.norm(points[:, None] - points[None], axis=2), axis=1)
        mean_distance = distances[:, 1 : k + 1].mean(axis=1)
        limit = mean_distance.mean() + sigmas * mean_distance.std()
        removed[members] = mean_distance > limit * (1 + 1e-6)
    return removed


def scene(seed, n, num_classes=5, on_grid=False):
    """Positions, codes, observed and labels; on a grid many positions and distances are the same."""
    rng = np.random.default_rng(seed)
    means = rng.integers(-4, 5, (n, 3)) if on_grid else rng.normal(size=(n, 3)) * rng.choice([0.1, 1, 5], (n, 1))
    probabilities = rng.dirichlet(np.full(num_classes, 0.3), n).astype(np.float32)
    observed = rng.random(n) < 0.8
    probabilities[~observed] = 0
    return means.astype(np.float32), probabilities, observed, rng.integers(-2, num_classes, n, np.int32)


@pytest.mark.parametrize("on_grid", [False, True])
@pytest.mark.parametrize(("n", "k"), [(1, 1), (7, 50), (40, 3), (300, 1), (300, 16), (1500, 50)])
def test_both_steps_agree_with_their_slow_twins(n, k, on_grid):
    means, probabilities, observed, labels = scene(n + k, n, on_grid=on_grid)
    result = cluster(means, probabilities, k, 0.65)
    expected, changed = slow_cluster(means, probabilities, observed, k, 0.65)
    np.testing.assert_allclose(result.probabilities, expected, atol=1e-6)
    np.testing.assert_array_equal(result.changed, changed)
    evidence = np.random.default_rng(k).exponential(2, n)
    result = cluster(means, probabilities, k, 0.65, evidence=evidence)
    weights = observed * np.maximum(evidence / (evidence + HALF), 2.0**-10)
    expected, changed = slow_cluster(means, probabilities, weights, k, 0.65)
    np.testing.assert_allclose(result.probabilities, expected, atol=1e-5)
    np.testing.assert_array_equal(result.changed, changed)
    np.testing.assert_array_equal(statistical_filter(means, labels, k, 1.0), slow_filter(means, labels, k, 1.0, 5))


@settings(max_examples=15)
@given(seed=st.integers(0, 10**6), n=st.integers(1, 400), k=st.integers(1, 60), on_grid=st.booleans())
def test_order_of_gaussians_and_number_of_threads_change_no_bit(seed, n, k, on_grid):
    means, probabilities, _, labels = scene(seed, n, on_grid=on_grid)
    result, removed = cluster(means, probabilities, k), statistical_filter(means, labels, k)
    shuffled = np.random.default_rng(seed).permutation(n)
    threads = nb.get_num_threads()
    nb.set_num_threads(1)
    try:
        again = cluster(means[shuffled], probabilities[shuffled], k)
        removed_again = statistical_filter(means[shuffled], labels[shuffled], k)
    finally:
        nb.set_num_threads(threads)
    np.testing.assert_array_equal(again.probabilities, result.probabilities[shuffled])
    np.testing.assert_array_equal(again.changed, result.changed[shuffled])
    np.testing.assert_array_equal(removed_again, removed[shuffled])


@settings(max_examples=15)
@given(seed=st.integers(0, 10**6))
def test_a_rigid_motion_changes_nothing(seed):
    means, probabilities, _, labels = scene(seed, 300)
    rotation = Rotation.random(random_state=seed).as_matrix()
    moved = (means.astype(np.float64) @ rotation.T + [0.3, -2, 1]).astype(np.float32)
    before, after = cluster(means, probabilities, 10), cluster(moved, probabilities, 10)
    # Rounding of the positions may swap neighbours that are all but tied, of one Gaussian in hundreds.
    same = np.isclose(before.probabilities, after.probabilities, atol=1e-5).all(axis=1)
    assert same.sum() >= len(same) - 2
    np.testing.assert_array_equal(before.changed, after.changed)
    assert (statistical_filter(means, labels, 10) != statistical_filter(moved, labels, 10)).sum() <= 1


def test_sure_gaussians_keep_their_codes_and_rows_sum_to_one():
    means, probabilities, observed, _ = scene(0, 2000)
    result = cluster(means, probabilities, 50, 0.65)
    np.testing.assert_array_equal(result.changed, ~observed | (probabilities.max(axis=1) < 0.65))
    np.testing.assert_array_equal(result.probabilities[~result.changed], probabilities[~result.changed])
    np.testing.assert_allclose(result.probabilities.sum(axis=1), 1, atol=1e-6)


@settings(max_examples=25)
@given(seed=st.integers(0, 10**6), n=st.integers(2, 400), k=st.integers(1, 60), on_grid=st.booleans())
def test_distances_after_some_labels_have_changed_are_those_found_from_nothing(seed, n, k, on_grid):
    means, _, _, labels = scene(seed, n, on_grid=on_grid)
    rng, kept = np.random.default_rng(seed), Neighbours.among(means, k)
    if not on_grid:
        labels = np.digitize(means[:, 0], [-1, 0, 1]).astype(np.int32)  # Most are among their like.
    for share in (0.0, 0.0, 0.01, 0.1, 1.0, 0.02):
        moved = rng.random(n) < share
        labels = np.where(moved, rng.integers(-2, 6, n, np.int32), labels)
        np.testing.assert_array_equal(
            class_distances(kept, labels), class_distances(Neighbours.among(means, k), labels)
        )


def test_only_what_lies_near_a_changed_label_is_found_anew():
    means = scene(5, 5000)[0]
    labels, neighbours = np.digitize(means[:, 0], [-1, 0, 1]).astype(np.int32), Neighbours.among(means, 10)
    class_distances(neighbours, labels)
    of_point = labels[neighbours.tree.order]
    assert not class_distances_module._to_be_found(neighbours.tree, of_point, neighbours.by_class, 10).any()
    of_point[700] = 4 - of_point[700]
    found = class_distances_module._to_be_found(neighbours.tree, of_point, neighbours.by_class, 10)
    assert 0 < found.sum() < 100


def test_the_codes_given_stay_as_they_were():
    means, probabilities, _, _ = scene(3, 700)
    kept = probabilities.copy()
    result = cluster(means, probabilities, 20, 0.65)
    assert result.changed.any() and not result.changed.all()
    np.testing.assert_array_equal(probabilities, kept)


@pytest.mark.parametrize(("n", "seen"), [(0, False), (1, False), (60, False), (1, True), (60, True)])
def test_nothing_changes_where_all_are_unobserved_or_all_are_sure(n, seen):
    means, probabilities, _, _ = scene(2, n)
    probabilities = np.random.default_rng(2).dirichlet(np.ones(5), n).astype(np.float32) * np.float32(seen)
    result = cluster(means, probabilities, 50, beta=0.0)
    assert not result.changed.any()
    np.testing.assert_array_equal(result.probabilities, probabilities)


def test_classes_of_one_or_two_the_background_and_negative_labels_are_left_alone():
    means = scene(3, 400)[0]
    labels = np.repeat(np.array([0, -1, -2], np.int32), [200, 100, 100])
    labels[:3] = 1, 2, 2
    means[0] = 1000
    assert not statistical_filter(means, labels, 50, 0.0).any()
    assert statistical_filter(np.empty((0, 3), np.float32), np.empty(0, np.int32)).shape == (0,)


def test_a_far_floater_is_removed_and_its_dense_blob_stays():
    rng = np.random.default_rng(4)
    blob = rng.uniform(-1, 1, (3000, 3))
    means = np.concatenate([blob, [[1e4, -2e4, 1e4]]]).astype(np.float32)
    labels = np.ones(len(means), np.int32)
    np.testing.assert_array_equal(np.flatnonzero(statistical_filter(means, labels)), [3000])


@pytest.mark.parametrize("position", [0.0, 7.3])
def test_gaussians_at_one_position_and_equal_spacings_stay(position):
    same = np.full((5000, 3), position, np.float32)
    assert not statistical_filter(same, np.ones(5000, np.int32)).any()
    corners = np.eye(3, dtype=np.float32) * 0.1 + np.float32(position)
    assert not statistical_filter(corners, np.ones(3, np.int32), 50, 0.0).any()
    _, probabilities, observed, _ = scene(5, 5000)
    result = cluster(same, probabilities)
    total = probabilities[observed].sum(axis=0, dtype=np.float64)
    own = np.where(observed[:, None], probabilities, 0)
    expected = (total - own) / (observed.sum() - observed)[:, None]
    np.testing.assert_allclose(result.probabilities[result.changed], expected[result.changed], atol=1e-6)


def test_what_is_far_from_all_that_was_observed_stays_unobserved():
    means, probabilities, _, _ = scene(7, 400)
    observed = np.arange(400) < 200
    probabilities = np.random.default_rng(7).dirichlet(np.ones(5), 400).astype(np.float32) * observed[:, None]
    means[~observed] += 1e4
    result = cluster(means, probabilities, 20)
    assert not result.changed[~observed].any() and result.changed[observed].any()
    np.testing.assert_array_equal(result.probabilities[~observed], probabilities[~observed])


def test_neighbours_are_found_once_per_scene_and_give_the_same_result():
    means, probabilities, _, labels = scene(8, 600)
    given_scene = GaussianScene.from_arrays(
        means, np.tile([1.0, 0, 0, 0], (600, 1)), np.ones((600, 3)), np.full(600, 0.5), np.zeros((600, 1, 3))
    )
    neighbours = neighbours_of(given_scene, 20)
    assert neighbours_of(given_scene, 20) is neighbours and neighbours_of(given_scene, 21) is not neighbours
    with_them = cluster(means, probabilities, 20, neighbours=neighbours)
    np.testing.assert_array_equal(with_them.probabilities, cluster(means, probabilities, 20).probabilities)
    removed = refine.statistical_filter(neighbours, labels)
    np.testing.assert_array_equal(removed, statistical_filter(means, labels, 20))
    assert neighbours_of(given_scene.subset([0]), 20) is None


def test_only_what_is_asked_for_is_looked_for_and_it_is_the_same_in_any_portions():
    means = scene(9, 700)[0]
    at_once = Neighbours.among(means, 20).look_for()
    in_portions, rng = Neighbours.among(means, 20), np.random.default_rng(9)
    asked = np.zeros(700, bool)
    for share in (0.02, 0.3, 0.3, 1.0):
        wanted = rng.random(700) < share
        asked |= wanted
        assert in_portions.look_for(wanted) is in_portions
        np.testing.assert_array_equal(np.isnan(in_portions.radii), ~asked)
        for name in ("radii", "distances"):
            some, every = getattr(in_portions, name), getattr(at_once, name)
            np.testing.assert_array_equal(some[asked], every[asked], err_msg=name)


def test_background_that_is_sure_of_itself_is_never_looked_for():
    means, _, _, labels = scene(10, 600)
    known = Neighbours.among(means, 20)
    labels = np.where(np.arange(600) < 300, 0, np.maximum(labels, 1))
    refine.statistical_filter(known, labels)
    np.testing.assert_array_equal(np.isnan(known.radii), labels[known.tree.order] == 0)


@pytest.mark.parametrize("scale", [1e-25, 1e30])
def test_scenes_of_any_size_give_the_same_result(scale):
    means, probabilities, _, labels = scene(6, 300)
    means, scale = means * np.float32(2**-10), np.float32(2.0 ** np.round(np.log2(scale)))
    scaled, plain = cluster(means * scale, probabilities), cluster(means, probabilities)
    np.testing.assert_array_equal(scaled.probabilities, plain.probabilities)
    np.testing.assert_array_equal(statistical_filter(means * scale, labels), statistical_filter(means, labels))


@pytest.mark.parametrize(
    "wrong",
    [{"k": 0}, {"k": 2.5}, {"k": 1 << 21}, {"k": float("nan")}, {"k": float("inf")}, {"beta": -0.1},
     {"beta": float("nan")}, {"filter_sigmas": -1.0}, {"filter_sigmas": float("inf")}, {"carve_views": 0},
     {"carve_views": 2.5}, {"carve_views": float("nan")}, {"carve_views": float("inf")}, {"k": 5.0}, {"k": "5"},
     {"carve_views": 3.0}],
)  # fmt: skip
def test_settings_out_of_range_are_refused_by_name(wrong):
    with pytest.raises(SettingsError, match=f"found {next(iter(wrong))} = .*; expected"):
        RefineSettings(**wrong)


def test_examples_in_the_documentation_hold():
    assert doctest.testmod(refine).failed == 0


@pytest.mark.parametrize("count", [0, 1, 40])
def test_codes_of_before_clustering_are_those_learnt_and_where_there_were_none_the_new_ones(
    count: int,
) -> None:
    rng = np.random.default_rng(count)
    codes, clustered = rng.dirichlet(np.ones(5), count).astype(np.float32), rng.random(count) < 0.5
    learnt = rng.dirichlet(np.ones(5), int(clustered.sum())).astype(np.float32)
    learnt[::2] = 0
    expected = codes.copy()
    expected[clustered] = np.where(learnt.any(axis=1, keepdims=True), learnt, codes[clustered])
    found = before_clustering(CSRRows.from_dense(codes), clustered, CSRRows.from_dense(learnt))
    np.testing.assert_array_equal(found.dense(5), expected)
