from __future__ import annotations

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from naive_rasteriser import naive_view
from scipy.spatial.transform import Rotation

from gsseg_core.cameras import Camera
from gsseg_core.errors import MaskSizeError, SceneValueError, SettingsError
from gsseg_core.operator import make_operator
from gsseg_core.scene import GaussianScene

TIGHT = 3e-6
"""What float32 costs a weight, where no threshold is in doubt."""


def make_scene(means, quats, scales, opacities):
    return GaussianScene.from_arrays(means, quats, scales, opacities, np.zeros((len(means), 1, 3)))


def make_camera(width, height, world_to_camera=None):
    """Principal point off the centre, pixels not square."""
    focal = 0.8 * max(width, height, 8)
    K = [[focal, 0, 0.45 * width], [0, 1.1 * focal, 0.6 * height], [0, 0, 1]]
    return Camera("view", width, height, K, np.eye(4) if world_to_camera is None else world_to_camera)


def one_gaussian(scale=1.0):
    return make_scene([[0, 0, 1.0]], [[1, 0, 0, 0]], [[scale] * 3], [0.5])


def rigid(rng):
    motion = np.eye(4)
    motion[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    motion[:3, 3] = rng.normal(size=3)
    return motion


def moved(scene, motion):
    rotation = Rotation.from_matrix(motion[:3, :3])
    quats = np.roll((rotation * Rotation.from_quat(np.roll(scene.quats, -1, axis=1))).as_quat(), 1, axis=1)
    return make_scene(scene.means @ motion[:3, :3].T + motion[:3, 3], quats, scene.scales, scene.opacities)


def random_view(seed, n=120, width=37, height=21):
    """Scene and camera, with a share of each kind of Gaussian that is easily got wrong."""
    rng = np.random.default_rng(seed)
    camera = make_camera(width, height, rigid(rng))
    kind = rng.choice(["plain", "behind", "near", "outside", "huge", "tiny", "faint", "opaque"], n,
                      p=[0.5, 0.05, 0.05, 0.1, 0.05, 0.1, 0.05, 0.1])  # fmt: skip
    z = rng.uniform(1, 6, n)
    z[kind == "behind"] *= -1
    z[kind == "near"] = rng.uniform(-0.01, 0.05, (kind == "near").sum())
    uv = rng.uniform(-0.2, 1.2, (n, 2)) * [width, height]
    uv[kind == "outside"] = rng.choice([-2, 3], ((kind == "outside").sum(), 2)) * [width, height]
    means = np.c_[(uv - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.ones(n)] * z[:, None]
    scales = np.exp(rng.uniform(np.log(0.01), np.log(0.5), (n, 3)))
    scales[kind == "outside"] *= 5
    scales[kind == "huge"] = rng.uniform(5, 50, ((kind == "huge").sum(), 3))
    scales[kind == "tiny"] = 1e-4
    opacities = rng.uniform(0.02, 0.95, n)
    opacities[kind == "huge"] *= 0.1
    opacities[kind == "faint"] = rng.uniform(0.001, 0.0038, (kind == "faint").sum())
    opacities[kind == "opaque"] = rng.uniform(0.985, 0.99999, (kind == "opaque").sum())
    scene = make_scene(means, rng.normal(size=(n, 4)), scales, opacities)
    return moved(scene, np.linalg.inv(camera.world_to_camera)), camera


def random_mask(seed, width=37, height=21, ids=(0, 1, 2, 7, 60000)):
    """A few labels in blocks, noise in them, and unknown pixels."""
    rng = np.random.default_rng(seed)
    blocks = rng.integers(0, len(ids), (height // 6 + 1, width // 6 + 1)).repeat(6, axis=0).repeat(6, axis=1)
    mask = np.array(ids, np.int32)[blocks[:height, :width]]
    noise = rng.random((height, width))
    mask[noise < 0.1] = rng.choice(ids)
    mask[noise > 0.9] = -1
    return mask


def dense(operator):
    """W as the list of its entries gives it."""
    listed = operator.weights()
    full = np.zeros((operator.camera.height * operator.camera.width, operator.num_gaussians))
    np.add.at(full, (listed.pixels, listed.gaussians), listed.weights)
    return full


def spread(operator, observation, per_visible, num_labels=60001):
    """Rows and columns of an observation as rows of the scene and columns by label, to compare different masks."""
    full = np.zeros((operator.num_gaussians, num_labels), np.float32)
    full[observation.ids[:, None], observation.classes] = per_visible
    return full


SIZES = [(37, 21), (16, 16), (33, 50), (70, 5), (1, 1), (1, 40)]
COUNTS = [40, 150]  # rays that get through, and rays that end
views = st.fixed_dictionaries(
    {
        "seed": st.integers(0, 2**32 - 1),
        "n": st.integers(1, 80),
        "width": st.integers(1, 40),
        "height": st.integers(1, 40),
    }
)
few = settings(deadline=None, max_examples=15)


# Against the naive twin


@pytest.mark.parametrize(("width", "height"), SIZES)
@pytest.mark.parametrize("n", COUNTS)
@pytest.mark.parametrize("seed", range(3))
def test_weights_and_transmittance_agree_with_the_naive_rasteriser(seed, n, width, height):
    scene, camera = random_view(seed, n, width, height)
    operator, naive = make_operator(scene, camera), naive_view(scene, camera)
    assert (np.abs(dense(operator) - naive.weights) <= TIGHT + naive.slack[:, None]).all()
    assert (np.abs(operator.transmittance().ravel() - naive.transmittance) <= TIGHT + naive.slack).all()


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
def test_render_and_adjoint_agree_with_the_naive_rasteriser(width, height, channels):
    scene, camera = random_view(channels, 150, width, height)
    operator, naive = make_operator(scene, camera), naive_view(scene, camera)
    rng = np.random.default_rng(channels)
    codes = rng.uniform(-1, 1, (len(scene), channels))
    rendered = operator.render(codes)
    assert rendered.shape == (height, width, channels)
    assert rendered.dtype == np.float32
    error = np.abs(rendered.reshape(-1, channels) - naive.weights @ codes)
    assert (error <= TIGHT + 2 * naive.slack[:, None]).all()

    residual = rng.uniform(-1, 1, (height * width, channels)) * (naive.slack == 0)[:, None]
    carried = operator.adjoint(residual.reshape(height, width, channels))
    assert carried.shape == (len(scene), channels)
    assert carried.dtype == np.float32
    error = np.abs(carried - naive.weights.T @ residual)
    assert (error <= TIGHT * (1 + naive.weights.T @ np.abs(residual))).all()


@pytest.mark.parametrize("seed", range(4))
def test_visibility_agrees_with_the_naive_rasteriser(seed):
    scene, camera = random_view(seed)
    operator, naive = make_operator(scene, camera), naive_view(scene, camera)
    expected = naive.weights.sum(axis=0)
    doubt = naive.slack.sum()
    assert (np.abs(operator.visibility() - expected) <= TIGHT * (1 + expected) + doubt).all()


@pytest.mark.parametrize(("width", "height"), SIZES)
@pytest.mark.parametrize(("seed", "n"), [*enumerate(COUNTS)])
def test_votes_and_shares_agree_with_the_naive_rasteriser(seed, n, width, height):
    scene, camera = random_view(seed, n, width, height)
    operator, naive = make_operator(scene, camera), naive_view(scene, camera)
    mask = random_mask(seed, width, height)
    mask[naive.slack.reshape(height, width) > 0] = -1
    seen = operator.observe(mask)
    assert seen.classes.tolist() == sorted(set(mask[mask >= 0]))
    assert seen.num_pixels == (mask >= 0).sum()
    assert seen.nbytes > 0
    np.testing.assert_array_equal(seen.ids, operator.ids)

    rng = np.random.default_rng(seed)
    codes = rng.uniform(0.1, 1, (len(seen.ids), len(seen.classes)))
    rest = rng.uniform(0.1, 1, len(seen.classes))
    share = seen.shares(codes, rest)
    likelihood = naive.weights[:, seen.ids] @ codes + np.outer(naive.transmittance, rest)
    log_likelihood = 0.0
    votes = seen.votes()
    assert votes.shape == share.gaussians.shape == (len(seen.ids), len(seen.classes))
    assert votes.dtype == share.gaussians.dtype == np.float32
    for j, label in enumerate(seen.classes):
        pixels = np.flatnonzero(mask == label)
        np.testing.assert_allclose(votes[:, j], naive.weights[pixels][:, seen.ids].sum(axis=0), rtol=TIGHT, atol=1e-5)
        shared = (naive.weights[pixels] / likelihood[pixels, j, None]).sum(axis=0)[seen.ids]
        np.testing.assert_allclose(share.gaussians[:, j], shared, rtol=1e-4, atol=1e-4)
        spare = (naive.transmittance[pixels] / likelihood[pixels, j]).sum()
        np.testing.assert_allclose(share.rest[j], spare, rtol=1e-4, atol=1e-4)
        log_likelihood += np.log(likelihood[pixels, j]).sum()
    np.testing.assert_allclose(share.log_likelihood, log_likelihood, rtol=1e-4, atol=1e-4)


# By hand


def test_one_round_gaussian_has_the_weights_that_the_formula_gives():
    camera = Camera("view", 20, 20, [[100, 0, 10], [0, 100, 10], [0, 0, 1]], np.eye(4))
    scene = make_scene([[0.01, 0.02, 2.0]], [[1, 0, 0, 0]], [[0.04, 0.04, 1e-6]], [0.8])  # at (10.5, 11), sigma 2 px
    weights = dense(make_operator(scene, camera)).reshape(20, 20)
    # The axis along the view is turned a little out of it, by 1/200 and 1/100; with no thickness it adds nothing.
    for row, column in [(10, 10), (11, 10), (11, 13), (7, 8)]:
        squared = ((column + 0.5 - 10.5) ** 2 + (row + 0.5 - 11) ** 2) / (2.0**2 + 0.3)
        assert weights[row, column] == pytest.approx(0.8 * np.exp(-squared / 2), rel=1e-5)


def test_a_ray_ends_with_the_gaussian_that_brings_it_below_the_threshold():
    wide = [[1e3, 1e3, 1e-3]] * 5
    scene = make_scene([[0, 0, z] for z in (1, 2, 3, 4, 5)], [[1, 0, 0, 0]] * 5, wide, [0.98] * 5)
    operator = make_operator(scene, make_camera(3, 3))
    listed = operator.weights(1, 1)
    assert listed.gaussians.tolist() == [0, 1, 2]
    np.testing.assert_allclose(listed.weights, [0.98, 0.98 * 0.02, 0.98 * 0.02**2], rtol=1e-3)
    np.testing.assert_allclose(operator.transmittance(), 0.02**3, rtol=1e-3)


def test_alpha_below_one_in_255_counts_as_zero_and_alpha_is_at_most_099():
    scene = make_scene([[0, 0, 1], [0, 0, 2], [0, 0, 3]], [[1, 0, 0, 0]] * 3, [[1e3] * 3] * 3, [0.0039, 0.004, 0.9999])
    listed = make_operator(scene, make_camera(3, 3)).weights(1, 1)
    assert listed.gaussians.tolist() == [1, 2]
    np.testing.assert_allclose(listed.weights, [0.004, 0.99 * (1 - 0.004)], rtol=1e-4)


# What the interface says


def test_ids_and_listed_weights_are_nearest_first():
    scene, camera = random_view(5)
    operator = make_operator(scene, camera)
    _, depth = camera.project(scene.means)
    assert (np.diff(depth[operator.ids]) > -1e-6).all()
    listed = operator.weights()
    assert (np.diff(listed.pixels) >= 0).all()
    same_pixel = np.diff(listed.pixels) == 0
    assert (np.diff(depth[listed.gaussians])[same_pixel] > -1e-6).all()
    assert ((listed.weights > 0) & (listed.weights <= np.float32(0.99))).all()
    assert not operator.visibility()[np.setdiff1d(np.arange(len(scene)), operator.ids)].any()


def test_the_row_of_one_pixel_is_that_row_of_all_weights():
    scene, camera = random_view(6)
    operator = make_operator(scene, camera)
    listed = operator.weights()
    for row, column in [(0, 0), (0, 36), (20, 0), (20, 36), (15, 15), (16, 16), (9, 31), (9, 32)]:
        one, here = operator.weights(row, column), listed.pixels == row * 37 + column
        assert here.any()
        for got, expected in zip(one, listed, strict=True):
            np.testing.assert_array_equal(got, expected[here])


def test_label_ids_may_be_large_and_every_pixel_may_have_its_own():
    scene, camera = random_view(7)
    operator = make_operator(scene, camera)
    weights = dense(operator)[:, operator.ids]
    mask = 60000 + np.random.default_rng(7).permutation(37 * 21).reshape(21, 37).astype(np.int32)
    seen = operator.observe(mask)
    pixel_of = np.argsort(mask.ravel())
    np.testing.assert_array_equal(seen.classes, mask.ravel()[pixel_of])
    np.testing.assert_allclose(seen.votes(), weights[pixel_of].T, rtol=1e-6)
    share = seen.shares(np.full((len(seen.ids), 37 * 21), 0.25), np.full(37 * 21, 0.25))
    np.testing.assert_allclose(share.gaussians, 4 * weights[pixel_of].T, rtol=1e-5)


def test_a_mask_with_all_pixels_unknown_gives_no_evidence():
    scene, camera = random_view(8)
    seen = make_operator(scene, camera).observe(np.full((21, 37), -1, np.int32))
    assert seen.num_pixels == 0
    assert len(seen.classes) == 0
    assert seen.votes().shape == (len(seen.ids), 0)
    share = seen.shares(np.empty((len(seen.ids), 0)), np.empty(0))
    assert share.gaussians.shape == (len(seen.ids), 0)
    assert share.rest.shape == (0,)
    assert share.log_likelihood == 0


def test_a_pixel_that_nothing_explains_gives_no_share_and_a_finite_likelihood():
    scene, camera = random_view(9)
    seen = make_operator(scene, camera).observe(random_mask(9))
    share = seen.shares(np.zeros((len(seen.ids), len(seen.classes))), np.zeros(len(seen.classes)))
    assert not share.gaussians.any()
    assert not share.rest.any()
    assert np.isfinite(share.log_likelihood)


@pytest.mark.parametrize(("width", "height"), [(37, 21), (1, 1)])
def test_a_view_that_sees_nothing_is_all_transmittance(width, height):
    scene = make_scene([[0, 0, -3], [0.1, 0, -5]], np.eye(4)[:2] + 1, np.full((2, 3), 0.1), [0.5, 0.9])
    operator = make_operator(scene, make_camera(width, height))
    assert len(operator.ids) == 0
    assert (operator.transmittance() == 1).all()
    np.testing.assert_array_equal(operator.render(np.ones((2, 3))), np.zeros((height, width, 3)))
    np.testing.assert_array_equal(operator.adjoint(np.ones((height, width, 3))), np.zeros((2, 3)))
    np.testing.assert_array_equal(operator.visibility(), np.zeros(2))
    assert len(operator.weights().pixels) == len(operator.weights(0, 0).pixels) == 0
    mask = np.full((height, width), 3, np.int32)
    seen = operator.observe(mask)
    assert seen.votes().shape == (0, 1)
    share = seen.shares(np.empty((0, 1)), np.array([0.5]))
    assert share.rest == pytest.approx(2 * mask.size)
    assert share.log_likelihood == pytest.approx(mask.size * np.log(0.5))


def test_codes_of_another_scene_are_refused():
    scene, camera = random_view(0)
    operator = make_operator(scene, camera)
    for shape in [(119, 3), (121, 3), (120,), (120, 3, 1)]:
        with pytest.raises(SceneValueError, match=r"codes have shape .* expected \(120, K\)"):
            operator.render(np.zeros(shape))


def test_images_of_another_size_are_refused():
    scene, camera = random_view(0)
    operator = make_operator(scene, camera)
    for shape in [(37, 21, 2), (21, 37), (21, 36, 2)]:
        with pytest.raises(MaskSizeError, match=r"view 'view': .* expected \(21, 37, K\)"):
            operator.adjoint(np.zeros(shape))
    for shape in [(37, 21), (21, 37, 1), (21, 38)]:
        with pytest.raises(MaskSizeError, match=r"view 'view': .* expected \(21, 37\)"):
            operator.observe(np.zeros(shape, np.int32))


def test_codes_of_another_shape_than_the_observation_are_refused():
    camera, scene = make_camera(20, 20), one_gaussian()
    seen = make_operator(scene, camera).observe(np.zeros((20, 20), np.int32))
    with pytest.raises(SceneValueError, match=r"expected \(1, 1\) and \(1,\)"):
        seen.shares(np.ones((5, 3), np.float32), np.ones(7, np.float32))


@pytest.mark.parametrize("pixel", [(0, 20), (20, 0), (-1, 3), (5, -1), (3, None)])
def test_a_pixel_outside_the_image_is_refused(pixel):
    operator = make_operator(one_gaussian(), make_camera(20, 20))
    with pytest.raises(SettingsError, match="expected a row from 0 to 19 and a column from 0 to 19"):
        operator.weights(*pixel)


@pytest.mark.parametrize("scale", [1e3, 1e10, 1e17])
def test_a_gaussian_may_be_as_large_as_it_likes(scale):
    operator = make_operator(one_gaussian(scale=scale), make_camera(20, 20))
    np.testing.assert_allclose(operator.transmittance(), 0.5, atol=1e-3)


def test_an_unknown_device_is_refused():
    with pytest.raises(SettingsError, match="abacus"):
        make_operator(*random_view(0), device="abacus")


# Laws


@few
@given(views, st.integers(1, 40))
def test_adjoint_is_the_transpose_of_render(view, channels):
    scene, camera = random_view(**view)
    operator = make_operator(scene, camera)
    rng = np.random.default_rng(view["seed"])
    codes = rng.normal(size=(len(scene), channels)).astype(np.float32)
    residual = rng.normal(size=(camera.height, camera.width, channels)).astype(np.float32)
    left = (operator.render(codes).astype(np.float64) * residual).sum()
    right = (codes * operator.adjoint(residual).astype(np.float64)).sum()
    size = (operator.render(np.abs(codes)) * np.abs(residual)).sum()
    assert abs(left - right) <= 2e-6 * size


@few
@given(views)
def test_rows_sum_to_one_minus_the_transmittance_left_over(view):
    scene, camera = random_view(**view)
    operator = make_operator(scene, camera)
    total = operator.render(np.ones((len(scene), 1)))[..., 0]
    np.testing.assert_allclose(total, 1 - operator.transmittance(), atol=2e-6)
    np.testing.assert_allclose(dense(operator).sum(axis=1).reshape(total.shape), total, atol=2e-6)


@few
@given(views, st.floats(-3, 3), st.floats(-3, 3))
def test_render_and_adjoint_are_linear(view, a, b):
    scene, camera = random_view(**view)
    operator = make_operator(scene, camera)
    rng = np.random.default_rng(view["seed"])
    p, q = rng.uniform(-1, 1, (2, len(scene), 3))
    np.testing.assert_allclose(
        operator.render(a * p + b * q), a * operator.render(p) + b * operator.render(q), atol=1e-5
    )
    r, s = rng.uniform(-1, 1, (2, camera.height, camera.width, 3))
    np.testing.assert_allclose(
        operator.adjoint(a * r + b * s),
        a * operator.adjoint(r) + b * operator.adjoint(s),
        atol=1e-5 * (1 + operator.visibility().max()),
    )


def everything(operator, codes, residual, mask):
    """Every result, the rows of Gaussians in the order of the scene."""
    seen = operator.observe(mask)
    # Codes that depend on the Gaussian alone, whatever its place in the order.
    share = seen.shares(codes[seen.ids][:, : len(seen.classes)], np.full(len(seen.classes), 0.3))
    return {
        "ids": operator.ids,
        "render": operator.render(codes),
        "adjoint": operator.adjoint(residual),
        "transmittance": operator.transmittance(),
        "weights": operator.weights().weights,
        "gaussians": operator.weights().gaussians,
        "votes": spread(operator, seen, seen.votes(), 9),
        "shares": spread(operator, seen, share.gaussians, 9),
        "rest": share.rest,
        "log likelihood": share.log_likelihood,
    }


def inputs(scene, camera, seed):
    rng = np.random.default_rng(seed)
    codes = rng.random((len(scene), 9)).astype(np.float32)
    residual = rng.normal(size=(camera.height, camera.width, 3)).astype(np.float32)
    return codes, residual, random_mask(seed, camera.width, camera.height, ids=(0, 2, 3, 8))


def assert_same_in_any_order(scene, camera, seed):
    codes, residual, mask = inputs(scene, camera, seed)
    order = np.random.default_rng(seed + 1).permutation(len(scene))
    first = everything(make_operator(scene, camera), codes, residual, mask)
    second = everything(make_operator(scene.subset(order), camera), codes[order], residual, mask)
    for name in ("ids", "gaussians"):
        second[name] = order[second[name]]
    for name in ("adjoint", "votes", "shares"):
        first[name] = first[name][order]
    for name, expected in first.items():
        np.testing.assert_array_equal(second[name], expected, err_msg=name)


@few
@given(views)
def test_the_order_of_the_gaussians_changes_no_bit(view):
    assert_same_in_any_order(*random_view(**view), view["seed"])


def test_the_order_of_many_gaussians_changes_no_bit():
    assert_same_in_any_order(*random_view(11, 3000, 70, 50), 11)


@pytest.mark.parametrize("seed", range(5))
def test_the_order_of_gaussians_at_the_same_depth_changes_no_bit(seed):
    rng = np.random.default_rng(seed)
    n = 200
    means = np.c_[rng.uniform(-1, 1, (n, 2)), rng.choice([1.5, 2.0, 4.0], n)]
    means[: n // 2] = means[rng.integers(0, 5, n // 2)]  # some in the very same place
    scene = make_scene(means, rng.normal(size=(n, 4)), rng.uniform(0.02, 0.5, (n, 3)), rng.uniform(0.1, 0.9, n))
    assert_same_in_any_order(scene, make_camera(37, 21), seed)


def test_the_order_of_twins_changes_no_pixel_when_their_codes_are_the_same():
    scene, camera = random_view(13, 60)
    twice = scene.subset(np.arange(120) // 2)
    codes = np.random.default_rng(13).random((60, 4))[np.arange(120) // 2]
    order = np.random.default_rng(14).permutation(120)
    first, second = make_operator(twice, camera), make_operator(twice.subset(order), camera)
    np.testing.assert_array_equal(first.render(codes), second.render(codes[order]))
    np.testing.assert_array_equal(first.transmittance(), second.transmittance())


def test_runs_and_numbers_of_threads_change_no_bit():
    scene, camera = random_view(15, 2000, 90, 70)
    arguments = inputs(scene, camera, 15)
    threads = numba.get_num_threads()
    try:
        results = []
        for count in (1, min(2, numba.config.NUMBA_NUM_THREADS), numba.config.NUMBA_NUM_THREADS, 1):
            numba.set_num_threads(count)
            results.append(everything(make_operator(scene, camera), *arguments))
    finally:
        numba.set_num_threads(threads)
    for other in results[1:]:
        for name, expected in results[0].items():
            np.testing.assert_array_equal(other[name], expected, err_msg=name)


@few
@given(views)
def test_moving_scene_and_camera_together_changes_nothing(view):
    scene, camera = random_view(**view)
    motion = rigid(np.random.default_rng(view["seed"] + 1))
    there = Camera("there", camera.width, camera.height, camera.K, camera.world_to_camera @ np.linalg.inv(motion))
    # Positions and rotations are rounded to float32 once more, in another place.
    slack = naive_view(scene, camera, rounding=0.01).slack
    here, moved_weights = dense(make_operator(scene, camera)), dense(make_operator(moved(scene, motion), there))
    assert (np.abs(here - moved_weights) <= 2e-4 + slack[:, None]).all()


@few
@given(views, st.data())
def test_votes_of_a_mask_are_the_sum_of_the_votes_of_its_parts(view, data):
    scene, camera = random_view(**view)
    operator = make_operator(scene, camera)
    mask = random_mask(view["seed"], camera.width, camera.height, ids=(0, 2, 3, 8))
    share = data.draw(st.floats(0, 1))
    in_first = np.random.default_rng(view["seed"]).random(mask.shape) < share
    whole, first, second = (
        spread(operator, seen, seen.votes(), 9)
        for seen in map(operator.observe, (mask, np.where(in_first, mask, -1), np.where(in_first, -1, mask)))
    )
    np.testing.assert_allclose(first + second, whole, rtol=1e-5, atol=1e-6)


@few
@given(views)
def test_votes_are_the_adjoint_of_the_one_hot_mask(view):
    scene, camera = random_view(**view)
    operator = make_operator(scene, camera)
    mask = random_mask(view["seed"], camera.width, camera.height, ids=(0, 2, 3, 8))
    seen = operator.observe(mask)
    one_hot = (mask[..., None] == np.arange(9)).astype(np.float32)
    np.testing.assert_allclose(spread(operator, seen, seen.votes(), 9), operator.adjoint(one_hot), rtol=1e-5, atol=1e-6)


@few
@given(views)
def test_every_labelled_pixel_shares_out_one_vote(view):
    scene, camera = random_view(**view)
    seen = make_operator(scene, camera).observe(random_mask(view["seed"], camera.width, camera.height))
    rng = np.random.default_rng(view["seed"])
    codes, rest = rng.uniform(0.01, 1, (len(seen.ids), len(seen.classes))), rng.uniform(0.01, 1, len(seen.classes))
    share = seen.shares(codes, rest)
    assert (codes * share.gaussians).sum() + rest @ share.rest == pytest.approx(seen.num_pixels, rel=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_shares_are_the_gradient_of_the_log_likelihood(seed):
    scene, camera = random_view(seed)
    seen = make_operator(scene, camera).observe(random_mask(seed))
    rng = np.random.default_rng(seed)
    codes, rest = rng.uniform(0.2, 1, (len(seen.ids), len(seen.classes))), rng.uniform(0.2, 1, len(seen.classes))
    share = seen.shares(codes, rest)

    def slope(along_codes, along_rest, step=0.01):
        ahead = seen.shares(codes + step * along_codes, rest + step * along_rest).log_likelihood
        back = seen.shares(codes - step * along_codes, rest - step * along_rest).log_likelihood
        return (ahead - back) / (2 * step)

    for _ in range(5):
        along_codes, along_rest = rng.uniform(0, 1, codes.shape), rng.uniform(0, 1, rest.shape)
        expected = (share.gaussians * along_codes).sum() + share.rest @ along_rest
        assert slope(along_codes, along_rest) == pytest.approx(expected, rel=1e-3)
    for i, j in [np.unravel_index(share.gaussians.argmax(), codes.shape), (len(codes) // 2, 1)]:
        one = np.zeros_like(codes)
        one[i, j] = 1
        assert slope(one, np.zeros_like(rest)) == pytest.approx(share.gaussians[i, j], rel=5e-3, abs=5e-3)
