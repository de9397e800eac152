"""Lenses: rays land where COLMAP has them land, come back from there, and lenses that cannot be are refused."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lens_cases import COEFFICIENTS, colmap_camera, lens, rays_within

from gsseg_core.errors import IntrinsicsError
from gsseg_core.scene.lens import LENS_MODELS, MODELS_BY_NAME, Lens, Projection


def of(name: str, *coefficients: float, focal: tuple[float, float] = (150.0, 150.0)) -> Lens:
    return Lens(MODELS_BY_NAME[name], 320, 240, focal, (160.0, 120.0), coefficients)


@pytest.mark.parametrize("name", COEFFICIENTS)
def test_rays_land_where_colmap_has_them_land(name: str) -> None:
    rays = rays_within(math.pi if name == "EQUIRECTANGULAR" else min(lens(name).reach, 1.3))
    expected = np.array([colmap_camera(name).img_from_cam(ray) for ray in rays]).reshape(-1, 2)
    np.testing.assert_allclose(lens(name).project(3 * rays), expected, atol=1e-6)


@pytest.mark.parametrize("name", COEFFICIENTS)
def test_rays_come_back_from_where_they_landed(name: str) -> None:
    rays = rays_within(math.pi if name == "EQUIRECTANGULAR" else min(lens(name).reach - 0.02, 1.4))
    np.testing.assert_allclose(lens(name).rays(lens(name).project(rays)), rays, atol=1e-9)


def small(size: float) -> st.SearchStrategy[float]:
    return st.floats(-size, size)


plausible = st.tuples(small(0.1), small(0.02), small(0.002), small(0.002), small(0.005), small(0.002))


@given(plausible, st.floats(150, 400))
def test_whatever_the_coefficients_what_was_distorted_is_undone(coefficients: tuple[float, ...], focal: float) -> None:
    for name in ("OPENCV", "FULL_OPENCV", "THIN_PRISM_FISHEYE"):
        taken_by = of(name, *coefficients, focal=(focal, focal))
        rays = rays_within(min(taken_by.reach - 0.05, math.atan(200 / focal)), 50)
        np.testing.assert_allclose(taken_by.rays(taken_by.project(rays)), rays, atol=1e-9)


def test_the_fourth_coefficient_is_one_of_a_polynomial_unless_the_model_is_rational() -> None:
    ray = np.array([0.5, 0.0, 1.0])
    assert of("OPENCV", 0, 0, 0, 0, 0, 0.1).project(ray)[0] == pytest.approx(160 + 150 * 0.5 * (1 + 0.1 * 0.5**8))
    assert of("FULL_OPENCV", 0, 0, 0, 0, 0, 0.1).project(ray)[0] == pytest.approx(160 + 150 * 0.5 / (1 + 0.1 * 0.5**2))


def test_without_coefficients_a_perspective_lens_is_a_pinhole_and_a_fisheye_counts_angles() -> None:
    rays = np.array([[0.5, -0.25, 1.0], [0.0, 0.0, 2.0]])
    np.testing.assert_allclose(of("OPENCV").project(rays), [[235, 82.5], [160, 120]])
    np.testing.assert_allclose(of("FISHEYE").project(np.array([1.0, 0.0, 0.0])), [160 + 150 * math.pi / 2, 120])


def test_what_is_beyond_the_reach_of_a_lens_lands_nowhere() -> None:
    turning = of("SIMPLE_RADIAL", -0.15)  # r - 0.15 r^3 turns back at r = 1.49
    assert math.tan(turning.reach) == pytest.approx(1 / math.sqrt(0.45), abs=0.01)
    assert np.isnan(turning.project(np.array([[1.6, 0, 1], [0, 0, -1], [1, 0, 0]]))).all()
    assert np.isnan(turning.rays(np.array([[160 + 150 * 1.1, 120.0]]))).all()
    assert np.isfinite(of("FISHEYE").project(np.array([1.0, 0.0, -1.0]))).all()


def test_every_model_is_named_once_and_ros_knows_three() -> None:
    assert len({model.name for model in LENS_MODELS}) == len(LENS_MODELS)
    assert {model.ros for model in LENS_MODELS} == {"", "plumb_bob", "rational_polynomial", "equidistant"}
    assert {model.projection for model in LENS_MODELS} == set(Projection)


def test_coefficients_are_put_in_order_and_strange_ones_are_refused_by_name() -> None:
    assert MODELS_BY_NAME["OPENCV"].order({"p1": 3.0, "k1": 1.0, "k6": 0.0}) == (1.0, 0.0, 3.0, 0.0, 0.0, 0.0)
    with pytest.raises(IntrinsicsError, match=r"RADIAL: has p1 = 0\.1; expected k1, k2"):
        MODELS_BY_NAME["RADIAL"].order({"p1": 0.1})
    with pytest.raises(IntrinsicsError, match=r"PINHOLE: has k1 = 0\.1; expected no coefficient"):
        MODELS_BY_NAME["PINHOLE"].order({"k1": 0.1})


@pytest.mark.parametrize(
    ("name", "coefficients", "found"),
    [
        ("SIMPLE_RADIAL", (math.nan,), "k1 = nan"),
        ("OPENCV_FISHEYE", (0.0, math.inf), "expected finite numbers"),
        ("SIMPLE_RADIAL", (-5.0,), "cannot be undone 30 pixels from the middle of images of 320 x 240"),
        ("OPENCV", (-1e12,), "cannot be undone"),
        ("OPENCV", (0.0, 0.0, 5.0), "p1 = 5"),
        ("FULL_OPENCV", (0.0,) * 5 + (9.0,), "k4 = 9"),
        ("THIN_PRISM_FISHEYE", (0.0,) * 6 + (7.0,), "expected to within 120 pixels: is it calibrated for this size?"),
    ],
)
def test_a_lens_that_cannot_be_undone_is_refused(name: str, coefficients: tuple[float, ...], found: str) -> None:
    with pytest.raises(IntrinsicsError, match=r"^lens ") as caught:
        of(name, *coefficients)
    assert found in str(caught.value) and name in str(caught.value)


@pytest.mark.parametrize(
    ("size", "focal", "found"),
    [
        ((0, 240), (150.0, 150.0), "0 x 240 pixels; expected at least 1 x 1"),
        ((320, 240), (0.0, 150.0), "focal lengths are 0 and 150"),
        ((320, 240), (math.nan, 150.0), "expected finite numbers"),
        ((2**20, 2**20), (150.0, 150.0), "limit max_pixels"),
        ((320, 240), (50.0, 50.0), "cannot be undone"),
    ],
)
def test_impossible_intrinsics_are_refused(size: tuple[int, int], focal: tuple[float, float], found: str) -> None:
    with pytest.raises(IntrinsicsError, match=found):
        Lens(MODELS_BY_NAME["SIMPLE_RADIAL"], *size, focal, (160.0, 120.0), (-0.15,))
