"""Laws that hold for the view operator, whatever the scene, by every implementation that is present."""

from __future__ import annotations

import itertools

import numba
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from naive_rasteriser import naive_view
from operator_backends import CPU
from operator_cases import dense, make_camera, make_scene, moved, random_mask, random_view, rigid, spread

from gsseg_core.data.label_evidence import LabelEvidence
from gsseg_core.raster.view_renderer import PixelGrid
from gsseg_core.raster.vote_total import VoteTotal
from gsseg_core.scene.camera import Camera

views = st.fixed_dictionaries(
    {
        "seed": st.integers(0, 2**32 - 1),
        "n": st.integers(1, 80),
        "width": st.integers(1, 40),
        "height": st.integers(1, 40),
    }
)
few = settings(max_examples=15)


@few
@given(views, st.integers(1, 40))
def test_adjoint_is_the_transpose_of_render(backend, view, channels):
    scene, camera = random_view(**view)
    operator = backend.make(scene, camera)
    rng = np.random.default_rng(view["seed"])
    codes = rng.normal(size=(len(scene), channels)).astype(np.float32)
    residual = rng.normal(size=(camera.height, camera.width, channels)).astype(np.float32)
    left = (operator.render(codes).astype(np.float64) * residual).sum()
    right = (codes * operator.adjoint(residual).astype(np.float64)).sum()
    size = (operator.render(np.abs(codes)) * np.abs(residual)).sum()
    assert abs(left - right) <= backend.sum * size


@few
@given(views)
def test_rows_sum_to_one_minus_the_transmittance_left_over(backend, view):
    scene, camera = random_view(**view)
    operator = backend.make(scene, camera)
    total = operator.render(np.ones((len(scene), 1)))[..., 0]
    np.testing.assert_allclose(total, 1 - operator.transmittance(), atol=backend.sum)
    np.testing.assert_allclose(dense(operator).sum(axis=1).reshape(total.shape), total, atol=backend.sum)


@few
@given(views, st.floats(-3, 3), st.floats(-3, 3))
def test_render_and_adjoint_are_linear(backend, view, a, b):
    scene, camera = random_view(**view)
    operator = backend.make(scene, camera)
    rng = np.random.default_rng(view["seed"])
    p, q = rng.uniform(-1, 1, (2, len(scene), 3))
    np.testing.assert_allclose(
        operator.render(a * p + b * q), a * operator.render(p) + b * operator.render(q), atol=5 * backend.sum
    )
    r, s = rng.uniform(-1, 1, (2, camera.height, camera.width, 3))
    np.testing.assert_allclose(
        operator.adjoint(a * r + b * s),
        a * operator.adjoint(r) + b * operator.adjoint(s),
        atol=5 * backend.sum * (1 + operator.visibility().max()),
    )


def everything(operator, codes, residual, mask):
    """Every result, the rows of Gaussians in the order of the scene."""
    seen = operator.observe(mask)
    # Codes that depend on the Gaussian alone, whatever its place in the order.
    share = seen.shares(codes[seen.ids[seen.rows], seen.labels], np.full(len(seen.classes), 0.3))
    return {
        "ids": operator.ids,
        "render": operator.render(codes),
        "adjoint": operator.adjoint(residual),
        "transmittance": operator.transmittance(),
        "weights": operator.weights().weights,
        "gaussians": operator.weights().gaussians,
        "votes": spread(operator, seen, seen.votes(), 9),
        "shares": spread(operator, seen, share.pairs, 9),
        "rest": share.rest,
        "log likelihood": share.log_likelihood,
    }


def inputs(scene, camera, seed):
    rng = np.random.default_rng(seed)
    codes = rng.random((len(scene), 9)).astype(np.float32)
    residual = rng.normal(size=(camera.height, camera.width, 3)).astype(np.float32)
    return codes, residual, random_mask(seed, camera.width, camera.height, ids=(0, 2, 3, 8))


def assert_same_in_any_order(backend, scene, camera, seed):
    codes, residual, mask = inputs(scene, camera, seed)
    order = np.random.default_rng(seed + 1).permutation(len(scene))
    first = everything(backend.make(scene, camera), codes, residual, mask)
    second = everything(backend.make(scene.subset(order), camera), codes[order], residual, mask)
    for name in ("ids", "gaussians"):
        second[name] = order[second[name]]
    first["ids"], second["ids"] = np.sort(first["ids"]), np.sort(second["ids"])
    for name in ("adjoint", "votes", "shares"):
        first[name] = first[name][order]
    for name, expected in first.items():
        np.testing.assert_array_equal(second[name], expected, err_msg=name)


@few
@given(views)
def test_the_order_of_the_gaussians_changes_nothing(backend, view):
    assert_same_in_any_order(backend, *random_view(**view), view["seed"])


def test_the_order_of_many_gaussians_changes_nothing(backend):
    assert_same_in_any_order(backend, *random_view(11, 3000, 70, 50), 11)


@pytest.mark.parametrize("seed", range(5))
def test_the_order_of_gaussians_at_the_same_depth_changes_nothing(backend, seed):
    rng = np.random.default_rng(seed)
    n = 200
    means = np.c_[rng.uniform(-1, 1, (n, 2)), rng.choice([1.5, 2.0, 4.0], n)]
    means[: n // 2] = means[rng.integers(0, 5, n // 2)]  # some in the very same place
    scene = make_scene(means, rng.normal(size=(n, 4)), rng.uniform(0.02, 0.5, (n, 3)), rng.uniform(0.1, 0.9, n))
    assert_same_in_any_order(backend, scene, make_camera(37, 21), seed)


def test_the_order_of_twins_changes_no_pixel_when_their_codes_are_the_same(backend):
    scene, camera = random_view(13, 60)
    twice = scene.subset(np.arange(120) // 2)
    codes = np.random.default_rng(13).random((60, 4))[np.arange(120) // 2]
    order = np.random.default_rng(14).permutation(120)
    first, second = backend.make(twice, camera), backend.make(twice.subset(order), camera)
    np.testing.assert_array_equal(first.render(codes), second.render(codes[order]))
    np.testing.assert_array_equal(first.transmittance(), second.transmittance())


def test_runs_and_numbers_of_threads_change_no_bit_on_the_cpu():
    scene, camera = random_view(15, 2000, 90, 70)
    arguments = inputs(scene, camera, 15)
    threads = numba.get_num_threads()
    try:
        results = []
        for count in (1, min(2, numba.config.NUMBA_NUM_THREADS), numba.config.NUMBA_NUM_THREADS, 1):
            numba.set_num_threads(count)
            operator = CPU.make(scene, camera)
            results.append(everything(operator, *arguments))
            results[-1]["lifted"] = operator.lift(arguments[2]).weights
            results[-1]["on a grid"] = operator.blend_grid(arguments[0][operator.ids, :3], PixelGrid(1, 3)).image
    finally:
        numba.set_num_threads(threads)
    for other in results[1:]:
        for name, expected in results[0].items():
            np.testing.assert_array_equal(other[name], expected, err_msg=name)


@few
@given(views)
def test_moving_scene_and_camera_together_changes_nothing(backend, view):
    scene, camera = random_view(**view)
    motion = rigid(np.random.default_rng(view["seed"] + 1))
    there = Camera("there", camera.width, camera.height, camera.K, camera.world_to_camera @ np.linalg.inv(motion))
    # Positions and rotations are rounded to float32 once more, in another place.
    slack = naive_view(scene, camera, rounding=0.01).slack
    here, moved_weights = dense(backend.make(scene, camera)), dense(backend.make(moved(scene, motion), there))
    assert (np.abs(here - moved_weights) <= 2e-4 + 10 * backend.weight + slack[:, None]).all()


@few
@given(views, st.data())
def test_votes_of_a_mask_are_the_sum_of_the_votes_of_its_parts(backend, view, data):
    scene, camera = random_view(**view)
    operator = backend.make(scene, camera)
    mask = random_mask(view["seed"], camera.width, camera.height, ids=(0, 2, 3, 8))
    share = data.draw(st.floats(0, 1))
    in_first = np.random.default_rng(view["seed"]).random(mask.shape) < share
    whole, first, second = (
        spread(operator, seen, seen.votes(), 9)
        for seen in map(operator.observe, (mask, np.where(in_first, mask, -1), np.where(in_first, -1, mask)))
    )
    np.testing.assert_allclose(first + second, whole, rtol=5 * backend.sum, atol=backend.sum)


@few
@given(views)
def test_votes_are_the_adjoint_of_the_one_hot_mask_by_rays_that_end_at_surfaces(backend, view):
    scene, camera = random_view(**view)
    operator, naive = backend.make(scene, camera), naive_view(scene, camera, lifts=True)
    mask = random_mask(view["seed"], camera.width, camera.height, ids=(0, 2, 3, 8))
    mask[naive.slack.reshape(mask.shape) > 0] = -1
    seen = operator.observe(mask)
    one_hot = (mask.reshape(-1, 1) == np.arange(9)).astype(np.float32)
    votes = spread(operator, seen, seen.votes(), 9)
    np.testing.assert_allclose(votes, naive.weights.T @ one_hot, rtol=5 * backend.sum, atol=5 * backend.sum)


@few
@given(views)
def test_a_mask_is_lifted_to_the_votes_of_its_observation_to_the_last_bit_label_by_label(backend, view):
    scene, camera = random_view(**view)
    operator, mask = backend.make(scene, camera), random_mask(view["seed"], camera.width, camera.height)
    seen, lifted = operator.observe(mask), operator.lift(mask)
    np.testing.assert_array_equal(lifted.classes, seen.classes)
    votes = seen.dense(seen.votes())
    for label, (first, last) in enumerate(itertools.pairwise(lifted.start)):
        rows = np.flatnonzero(votes[:, label])
        np.testing.assert_array_equal(lifted.gaussians[first:last], seen.ids[rows])
        np.testing.assert_array_equal(lifted.weights[first:last], votes[rows, label])


def test_a_mask_of_which_nothing_is_known_is_lifted_to_nothing(backend):
    scene, camera = random_view(3)
    lifted = backend.make(scene, camera).lift(np.full((camera.height, camera.width), -1))
    assert lifted.start.tolist() == [0] and not any(len(part) for part in (lifted.classes, lifted.gaussians))


@few
@given(views, st.integers(0, 45), st.integers(1, 20), st.integers(0, 6))
@example({"seed": 0, "n": 3, "width": 1, "height": 1}, 0, 2, 0)
def test_the_pixels_of_a_grid_are_blended_as_in_the_whole_image_to_the_last_bit(backend, view, first, step, channels):
    scene, camera = random_view(**view)
    operator, grid = backend.make(scene, camera), PixelGrid(first, step)
    codes = np.random.default_rng(view["seed"]).random((len(operator.ids), channels)).astype(np.float32)
    for found, image in zip(operator.blend_grid(codes, grid), operator.blend_seen(codes), strict=True):
        np.testing.assert_array_equal(found, grid.of(image))


@few
@given(views, st.booleans())
def test_votes_that_keep_nothing_of_a_view_are_those_of_its_observation_to_the_last_bit(backend, view, soft):
    scene, camera = random_view(**view)
    operator = backend.make(scene, camera)
    mask, evidence = random_mask(view["seed"], camera.width, camera.height, ids=(0, 2, 3, 8)), None
    if soft:  # Prototypes, which speak for several classes and against others.
        present, places = np.unique(mask, return_inverse=True)
        mask = places.reshape(mask.shape).astype(np.int32) - (present[0] < 0)
        mass = np.random.default_rng(view["seed"]).dirichlet(np.ones(3), mask.max() + 1)[:, :2]
        evidence = LabelEvidence(np.array([1, 5], np.int32), mass.astype(np.float32), np.array([1, 4, 5], np.int32))
    observation = operator.observe(mask, evidence)
    expected, found = (VoteTotal(len(scene), 9) for _ in range(2))
    observation.vote(expected)
    assert operator.vote(mask, evidence, found) == (len(observation.ids) > 0)
    np.testing.assert_array_equal(found.dense(), expected.dense())
    operator.vote(mask, evidence, found, sign=-1)
    assert not found.dense().any()


@few
@given(views)
def test_every_labelled_pixel_shares_out_one_vote(backend, view):
    scene, camera = random_view(**view)
    seen = backend.make(scene, camera).observe(random_mask(view["seed"], camera.width, camera.height))
    rng = np.random.default_rng(view["seed"])
    said, rest = rng.uniform(0.01, 1, len(seen.labels)), rng.uniform(0.01, 1, len(seen.classes))
    share = seen.shares(said, rest)
    assert (said * share.pairs).sum() + rest @ share.rest == pytest.approx(seen.num_pixels, rel=5 * backend.sum)


@pytest.mark.parametrize("seed", range(3))
def test_shares_are_the_gradient_of_the_log_likelihood(backend, seed):
    scene, camera = random_view(seed)
    seen = backend.make(scene, camera).observe(random_mask(seed))
    rng = np.random.default_rng(seed)
    said, rest = rng.uniform(0.2, 1, len(seen.labels)), rng.uniform(0.2, 1, len(seen.classes))
    share = seen.shares(said, rest)

    def slope(along_said, along_rest, step=0.01):
        ahead = seen.shares(said + step * along_said, rest + step * along_rest).log_likelihood
        back = seen.shares(said - step * along_said, rest - step * along_rest).log_likelihood
        return (ahead - back) / (2 * step)

    for _ in range(5):
        along_said, along_rest = rng.uniform(0, 1, said.shape), rng.uniform(0, 1, rest.shape)
        expected = (share.pairs * along_said).sum() + share.rest @ along_rest
        assert slope(along_said, along_rest) == pytest.approx(expected, rel=1e-3 + backend.sum)
    for i in [share.pairs.argmax(), len(said) // 2]:
        one = np.zeros_like(said)
        one[i] = 1
        assert slope(one, np.zeros_like(rest)) == pytest.approx(share.pairs[i], rel=5e-3, abs=5e-3)
