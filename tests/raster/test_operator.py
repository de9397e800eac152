"""The view operator, by every implementation that is present: against its naive twin, by hand, and at its edges."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from naive_rasteriser import naive_view
from operator_backends import CPU
from operator_cases import dense, make_camera, make_scene, one_gaussian, random_mask, random_view

from gsseg_core.csr_rows import CSRRows
from gsseg_core.errors import SceneValueError
from gsseg_core.raster.cpu.blending import tile_of_turn
from gsseg_core.raster.cpu.tiling import stride_of
from gsseg_core.raster.view_renderer import EVERY_PIXEL
from gsseg_core.scene.camera import Camera

SIZES = [(37, 21), (16, 16), (33, 50), (70, 5), (1, 1), (1, 40)]
COUNTS = [40, 150]  # rays that get through, and rays that end


# Against the naive twin


@pytest.mark.parametrize(("width", "height"), SIZES)
@pytest.mark.parametrize("n", COUNTS)
@pytest.mark.parametrize("seed", range(2))
def test_weights_and_transmittance_agree_with_the_naive_rasteriser(backend, seed, n, width, height):
    scene, camera = random_view(seed, n, width, height)
    operator, naive = backend.make(scene, camera), naive_view(scene, camera)
    assert (np.abs(dense(operator) - naive.weights) <= backend.weight + naive.slack[:, None]).all()
    assert (np.abs(operator.transmittance().ravel() - naive.transmittance) <= backend.weight + naive.slack).all()


def test_the_random_views_hold_what_they_are_meant_to_and_few_doubtful_pixels():
    every = [naive_view(*random_view(seed, n)) for seed in range(3) for n in COUNTS]
    slack = np.concatenate([naive.slack for naive in every])
    left_over = np.concatenate([naive.transmittance for naive in every])
    assert (slack > 0).mean() < 0.01
    assert (left_over < 1e-4).any()
    assert (left_over > 0.5).any()
    assert all(0.2 < (naive.weights == 0).all(axis=0).mean() < 0.8 for naive in every)


@pytest.mark.parametrize(("width", "height"), SIZES)
@pytest.mark.parametrize("channels", [1, 3, 40])
def test_render_and_adjoint_agree_with_the_naive_rasteriser(backend, width, height, channels):
    scene, camera = random_view(channels, 150, width, height)
    operator, naive = backend.make(scene, camera), naive_view(scene, camera)
    rng = np.random.default_rng(channels)
    codes = rng.uniform(-1, 1, (len(scene), channels))
    rendered = operator.render(codes)
    assert rendered.shape == (height, width, channels)
    assert rendered.dtype == np.float32
    error = np.abs(rendered.reshape(-1, channels) - naive.weights @ codes)
    assert (error <= backend.weight + 2 * naive.slack[:, None]).all()

    residual = rng.uniform(-1, 1, (height * width, channels)) * (naive.slack == 0)[:, None]
    carried = operator.adjoint(residual.reshape(height, width, channels))
    assert carried.shape == (len(scene), channels)
    assert carried.dtype == np.float32
    error = np.abs(carried - naive.weights.T @ residual)
    assert (error <= backend.sum * (1 + naive.weights.T @ np.abs(residual))).all()


@pytest.mark.parametrize("seed", range(4))
def test_few_channels_are_rendered_as_they_are_among_many(backend, seed):
    scene, camera = random_view(seed)
    operator = backend.make(scene, camera)
    codes = np.random.default_rng(seed).normal(size=(len(scene), 12)).astype(np.float32)
    many = operator.render(codes)
    for few in (1, 2, 3, 4, 5):
        assert np.abs(operator.render(codes[:, :few]) - many[..., :few]).max() <= backend.weight * (backend is not CPU)


def test_codes_of_some_gaussians_blend_as_those_of_all(backend):
    scene, camera = random_view(1, 150, 37, 21)
    operator, rng = backend.make(scene, camera), np.random.default_rng(1)
    codes = CSRRows.from_dense(rng.choice([0, 0.25, 1], (len(scene), 5)).astype(np.float32))
    some = np.unique(np.append(operator.ids, [0, len(scene) - 1])).astype(np.int32)
    few = codes.take(some)
    found, expected = operator.strongest(few, 5, False, EVERY_PIXEL, of=some), operator.blend_rows(codes, 5).image
    np.testing.assert_array_equal(found.on_grid, expected)
    np.testing.assert_array_equal(found.classes, operator.strongest(codes, 5, False).classes)


@pytest.mark.parametrize("seed", range(4))
def test_visibility_agrees_with_the_naive_rasteriser(backend, seed):
    scene, camera = random_view(seed)
    operator, naive = backend.make(scene, camera), naive_view(scene, camera)
    expected = naive.weights.sum(axis=0)
    doubt = naive.slack.sum()
    assert (np.abs(operator.visibility() - expected) <= backend.sum * (1 + expected) + doubt).all()


@pytest.mark.parametrize("seed", range(4))
def test_a_view_without_some_gaussians_is_the_view_of_a_scene_where_they_are_invisible(backend, seed):
    scene, camera = random_view(seed)
    hidden = np.random.default_rng(seed).random(len(scene)) < 0.5
    operator = backend.make(scene, camera)
    before = operator.transmittance()
    alone = backend.make(replace(scene, opacities=np.where(hidden, np.float32(0), scene.opacities)), camera)
    other = operator.without(hidden)
    assert np.abs(dense(other) - dense(alone)).max() <= backend.weight
    codes = np.random.default_rng(seed).uniform(-1, 1, (len(scene), 3))
    assert np.abs(other.render(codes) - alone.render(codes)).max() <= 2 * backend.weight
    assert not other.visibility()[hidden].any()
    np.testing.assert_array_equal(operator.transmittance(), before)
    with pytest.raises(SceneValueError, match=r"hidden is bool \(3,\); expected"):
        operator.without(np.zeros(3, bool))


def assert_pairs_are_what_labelled_pixels_see(seen, mask, weights, ids):
    sees = np.zeros((weights.shape[1], len(seen.classes)), bool)
    for j, label in enumerate(seen.classes):
        sees[:, j] = (weights[mask.ravel() == label] > 0).any(axis=0)
    np.testing.assert_array_equal(seen.ids, np.sort(ids[sees[ids].any(axis=1)]))
    np.testing.assert_array_equal(seen.start, np.concatenate([[0], np.cumsum(sees[seen.ids].sum(axis=1))]))
    np.testing.assert_array_equal(seen.dense(np.ones(len(seen.labels))), sees[seen.ids])


@pytest.mark.parametrize(("width", "height"), SIZES)
@pytest.mark.parametrize(("seed", "n"), [*enumerate(COUNTS)])
def test_votes_and_shares_agree_with_the_naive_rasteriser(backend, seed, n, width, height):
    scene, camera = random_view(seed, n, width, height)
    operator, naive = backend.make(scene, camera), naive_view(scene, camera, lifts=True)
    mask = random_mask(seed, width, height)
    mask[naive.slack.reshape(height, width) > 0] = -1
    seen = operator.observe(mask)
    assert seen.classes.tolist() == sorted(set(mask[mask >= 0]))
    assert seen.num_pixels == (mask >= 0).sum()
    np.testing.assert_array_equal(seen.areas, [(mask == label).sum() for label in seen.classes])
    assert seen.nbytes > 0
    assert_pairs_are_what_labelled_pixels_see(seen, mask, naive.weights, operator.ids)

    rng = np.random.default_rng(seed)
    codes = rng.uniform(0.1, 1, (len(seen.ids), len(seen.classes)))
    rest = rng.uniform(0.1, 1, len(seen.classes))
    share = seen.shares(codes[seen.rows, seen.labels], rest)
    likelihood = naive.weights[:, seen.ids] @ codes + np.outer(naive.transmittance, rest)
    near, log_likelihood = 30 * backend.sum, 0.0
    assert seen.votes().dtype == share.pairs.dtype == np.float32
    votes, shares = seen.dense(seen.votes()), seen.dense(share.pairs)
    for j, label in enumerate(seen.classes):
        pixels = np.flatnonzero(mask == label)
        counted = naive.weights[pixels][:, seen.ids].sum(axis=0)
        np.testing.assert_allclose(votes[:, j], counted, rtol=backend.sum, atol=3 * backend.sum)
        shared = (naive.weights[pixels] / likelihood[pixels, j, None]).sum(axis=0)[seen.ids]
        np.testing.assert_allclose(shares[:, j], shared, rtol=near, atol=near)
        spare = (naive.transmittance[pixels] / likelihood[pixels, j]).sum()
        np.testing.assert_allclose(share.rest[j], spare, rtol=near, atol=near)
        log_likelihood += np.log(likelihood[pixels, j]).sum()
    np.testing.assert_allclose(share.log_likelihood, log_likelihood, rtol=near, atol=near)


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_pixels_share_their_votes_by_their_weights_and_vote_without(backend, width, height):
    scene, camera = random_view(5, 120, width, height)
    operator, naive = backend.make(scene, camera), naive_view(scene, camera, lifts=True)
    mask, rng = random_mask(5, width, height), np.random.default_rng(5)
    mask[naive.slack.reshape(height, width) > 0] = -1
    blocks = rng.choice(np.float32([0, 0, 1, 4]), (-(-height // 4), -(-width // 4)))
    of_pixels = np.kron(blocks, np.ones((4, 4)))[:height, :width]
    seen, plain = operator.observe(mask, None, blocks), operator.observe(mask)
    np.testing.assert_array_equal(seen.votes(), plain.votes())
    np.testing.assert_array_equal(seen.labels, plain.labels)
    np.testing.assert_array_equal(seen.areas, plain.areas)
    np.testing.assert_allclose(seen.weighted_areas, [of_pixels[mask == label].sum() for label in seen.classes])
    codes, rest = rng.uniform(0.1, 1, (len(seen.ids), len(seen.classes))), rng.uniform(0.1, 1, len(seen.classes))
    share, weights, left_over = seen.shares(codes[seen.rows, seen.labels], rest), naive.weights, naive.transmittance
    likelihood = weights[:, seen.ids] @ codes + np.outer(left_over, rest)
    near, log_likelihood, shares = 30 * backend.sum, 0.0, seen.dense(share.pairs)
    for j, label in enumerate(seen.classes):
        pixels = np.flatnonzero(mask == label)
        each = of_pixels.ravel()[pixels] / likelihood[pixels, j]
        np.testing.assert_allclose(shares[:, j], each @ weights[pixels][:, seen.ids], rtol=near, atol=4 * near)
        np.testing.assert_allclose(share.rest[j], each @ left_over[pixels], rtol=near, atol=4 * near)
        log_likelihood += of_pixels.ravel()[pixels] @ np.log(likelihood[pixels, j])
    np.testing.assert_allclose(share.log_likelihood, log_likelihood, rtol=near, atol=near)


# By hand


def test_one_round_gaussian_has_the_weights_that_the_formula_gives(backend):
    camera = Camera("view", 20, 20, [[100, 0, 10], [0, 100, 10], [0, 0, 1]], np.eye(4))
    scene = make_scene([[0.01, 0.02, 2.0]], [[1, 0, 0, 0]], [[0.04, 0.04, 1e-6]], [0.8])  # at (10.5, 11), sigma 2 px
    weights = dense(backend.make(scene, camera)).reshape(20, 20)
    # The axis along the view is turned a little out of it, by 1/200 and 1/100; with no thickness it adds nothing.
    for row, column in [(10, 10), (11, 10), (11, 13), (7, 8)]:
        squared = ((column + 0.5 - 10.5) ** 2 + (row + 0.5 - 11) ** 2) / (2.0**2 + 0.3)
        assert weights[row, column] == pytest.approx(0.8 * np.exp(-squared / 2), rel=1e-5 + backend.weight)


def test_a_footprint_is_the_sum_of_all_alphas_but_those_below_one_in_255(backend):
    camera = Camera("view", 40, 40, [[100, 0, 20], [0, 100, 20], [0, 0, 1]], np.eye(4))
    scene = make_scene([[0, 0, 2.0], [0, 0, -1.0]], [[1, 0, 0, 0]] * 2, [[0.04, 0.06, 1e-6]] * 2, [0.6, 0.6])
    operator = backend.make(scene, camera)
    assert operator.ids.tolist() == [0]
    assert operator.footprints()[0] == pytest.approx(0.6 * 2 * np.pi * np.sqrt((2**2 + 0.3) * (3**2 + 0.3)), rel=1e-4)
    assert operator.visibility()[0] == pytest.approx(operator.footprints()[0] * (1 - 1 / 255 / 0.6), rel=5e-3)


def test_a_ray_ends_at_the_gaussian_that_brings_it_below_the_threshold(backend):
    wide = [[1e3, 1e3, 1e-3]] * 5
    scene = make_scene([[0, 0, z] for z in (1, 2, 3, 4, 5)], [[1, 0, 0, 0]] * 5, wide, [0.98] * 5)
    operator = backend.make(scene, make_camera(3, 3))
    listed = operator.weights(1, 1)
    assert listed.gaussians.tolist() == [0, 1, 2]
    np.testing.assert_allclose(listed.weights, [0.98, 0.98 * 0.02, 0.98 * 0.02**2], rtol=1e-3)
    np.testing.assert_allclose(operator.transmittance(), 0.02**3, rtol=1e-3)


def test_alpha_below_one_in_255_counts_as_zero_and_alpha_is_at_most_099(backend):
    scene = make_scene([[0, 0, 1], [0, 0, 2], [0, 0, 3]], [[1, 0, 0, 0]] * 3, [[1e3] * 3] * 3, [0.0039, 0.004, 0.9999])
    listed = backend.make(scene, make_camera(3, 3)).weights(1, 1)
    assert listed.gaussians.tolist() == [1, 2]
    np.testing.assert_allclose(listed.weights, [0.004, 0.99 * (1 - 0.004)], rtol=1e-4)


# What the interface says


def test_listed_weights_are_nearest_first(backend):
    scene, camera = random_view(5)
    operator = backend.make(scene, camera)
    _, depth = camera.project(scene.means)
    listed = operator.weights()
    assert (np.diff(listed.pixels) >= 0).all()
    same_pixel = np.diff(listed.pixels) == 0
    assert (np.diff(depth[listed.gaussians])[same_pixel] > -1e-5).all()
    assert ((listed.weights > 0) & (listed.weights <= np.float32(0.99))).all()
    assert not operator.visibility()[np.setdiff1d(np.arange(len(scene)), operator.ids)].any()


def test_the_row_of_one_pixel_is_that_row_of_all_weights(backend):
    scene, camera = random_view(6)
    operator = backend.make(scene, camera)
    listed = operator.weights()
    for row, column in [(0, 0), (0, 36), (20, 0), (20, 36), (15, 15), (16, 16), (9, 31), (9, 32)]:
        one, here = operator.weights(row, column), listed.pixels == row * 37 + column
        assert here.any()
        for got, expected in zip(one, listed, strict=True):
            np.testing.assert_array_equal(got, expected[here])


def test_label_ids_may_be_large_and_every_pixel_may_have_its_own(backend):
    scene, camera = random_view(7)
    operator = backend.make(scene, camera)
    mask = 60000 + np.random.default_rng(7).permutation(37 * 21).reshape(21, 37).astype(np.int32)
    naive = naive_view(scene, camera, lifts=True)
    mask[naive.slack.reshape(mask.shape) > 0] = -1
    seen = operator.observe(mask)
    pixel_of = np.argsort(mask.ravel())[(mask < 0).sum() :]
    np.testing.assert_array_equal(seen.classes, mask.ravel()[pixel_of])
    weights = naive.weights[:, seen.ids][pixel_of].T
    np.testing.assert_allclose(seen.dense(seen.votes()), weights, rtol=backend.sum, atol=backend.weight)
    share = seen.dense(seen.shares(np.full(len(seen.labels), 0.25), np.full(len(pixel_of), 0.25)).pairs)
    np.testing.assert_allclose(share, 4 * weights, rtol=5 * backend.sum, atol=4 * backend.weight)


def test_a_mask_with_all_pixels_unknown_gives_no_evidence(backend):
    scene, camera = random_view(8)
    seen = backend.make(scene, camera).observe(np.full((21, 37), -1, np.int32))
    assert seen.num_pixels == 0
    assert len(seen.classes) == 0
    assert seen.ids.shape == seen.votes().shape == (0,)
    share = seen.shares(np.empty(0), np.empty(0))
    assert share.pairs.shape == (0,)
    assert share.rest.shape == (0,)
    assert share.log_likelihood == 0


def test_shares_asked_again_are_the_same_and_those_of_other_codes_are_others(backend):
    scene, camera = random_view(3)
    labels = np.random.default_rng(3).integers(-1, 3, (21, 37)).astype(np.int32)
    seen = backend.make(scene, camera).observe(labels)
    said, rest = np.full(len(seen.labels), 0.5, np.float32), np.full(len(seen.classes), 0.5, np.float32)
    once = seen.shares(said, rest)
    np.testing.assert_array_equal(seen.shares(said, rest).pairs, once.pairs)
    said[: len(said) // 2] = 0.25
    other = seen.shares(said, rest)
    expected = backend.make(scene, camera).observe(labels).shares(said, rest)
    np.testing.assert_array_equal(other.pairs, expected.pairs)
    assert other.log_likelihood == expected.log_likelihood != once.log_likelihood


def test_shares_are_those_asked_for_whatever_another_thread_asks_of_the_view_meanwhile(backend):
    scene, camera = random_view(3)
    seen = backend.make(scene, camera).observe(random_mask(3))
    said, rest = np.full(len(seen.labels), 0.5), np.full(len(seen.classes), 0.5)
    expected, questions = seen.shares(said, rest).log_likelihood, [0.25 * said]

    def answer(self, answered):  # The other thread asks just when this one has its answer.
        vars(self)["answered"] = answered
        if questions:
            self.shares(questions.pop(), rest)

    seen.answered = None
    asked_twice = property(lambda self: vars(self).get("answered"), answer)
    seen.__class__ = type("AskedTwice", (type(seen),), {"answered": asked_twice})
    assert seen.shares(said, rest).log_likelihood == expected and not questions


def test_a_pixel_that_nothing_explains_gives_no_share_and_a_finite_likelihood(backend):
    scene, camera = random_view(9)
    seen = backend.make(scene, camera).observe(random_mask(9))
    share = seen.shares(np.zeros(len(seen.labels)), np.zeros(len(seen.classes)))
    assert not share.pairs.any()
    assert not share.rest.any()
    assert np.isfinite(share.log_likelihood)


@pytest.mark.parametrize(("width", "height"), [(37, 21), (1, 1)])
def test_a_view_that_sees_nothing_is_all_transmittance(backend, width, height):
    scene = make_scene([[0, 0, -3], [0.1, 0, -5]], np.eye(4)[:2] + 1, np.full((2, 3), 0.1), [0.5, 0.9])
    operator = backend.make(scene, make_camera(width, height))
    assert len(operator.ids) == 0
    assert (operator.transmittance() == 1).all()
    np.testing.assert_array_equal(operator.render(np.ones((2, 3))), np.zeros((height, width, 3)))
    np.testing.assert_array_equal(operator.adjoint(np.ones((height, width, 3))), np.zeros((2, 3)))
    np.testing.assert_array_equal(operator.visibility(), np.zeros(2))
    assert len(operator.weights().pixels) == len(operator.weights(0, 0).pixels) == 0
    mask = np.full((height, width), 3, np.int32)
    seen = operator.observe(mask)
    assert seen.votes().shape == (0,)
    share = seen.shares(np.empty(0), np.array([0.5]))
    assert share.rest == pytest.approx(2 * mask.size)
    assert share.log_likelihood == pytest.approx(mask.size * np.log(0.5))


@pytest.mark.parametrize("scale", [1e3, 1e10, 1e17])
def test_a_gaussian_may_be_as_large_as_it_likes(backend, scale):
    operator = backend.make(one_gaussian(scale=scale), make_camera(20, 20))
    np.testing.assert_allclose(operator.transmittance(), 0.5, atol=1e-3)


def test_an_endless_needle_is_seen_in_the_rows_that_it_reaches(backend):
    camera, reach = make_camera(40, 40), np.sqrt(2 * np.log(0.5 * 255) * 0.3)
    row = 16 + reach + 0.2  # Its alpha falls to 1/255 next to a border between tiles.
    scene = make_scene([[0, 0.1 * (row - camera.cy) / camera.fy, 0.1]], [[1, 0, 0, 0]], [[2e17, 1e-9, 1e-9]], [0.5])
    alpha = 0.5 * np.exp(-((np.arange(40) + 0.5 - row) ** 2) / 0.6)
    expected = np.where(alpha < 1 / 255, 0, alpha)[:, None].repeat(40, axis=1)
    assert (np.abs(dense(backend.make(scene, camera)).reshape(40, 40) - expected) <= 2 * backend.weight).all()


@given(st.integers(1, 300), st.integers(1, 40))
def test_every_tile_has_its_turn_once(rows, columns):
    tiles = SimpleNamespace(columns=columns, rows=rows, stride=stride_of(rows))
    turns = [tile_of_turn.py_func(tiles, turn) for turn in range(rows * columns)]
    assert sorted(turns) == list(range(rows * columns))


@given(st.integers(1, 300), st.integers(2, 16))
def test_every_thread_gets_rows_from_all_parts_of_the_image(rows, threads):
    stride = stride_of(rows)
    visited = np.array([turn * stride % rows for turn in range(rows)])
    for part in np.array_split(visited, threads):
        if len(part) >= 8:
            assert abs(part.mean() / rows - 0.5) < 0.2
