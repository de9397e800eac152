"""Spherical harmonics agree with SciPy's Legendre functions, and colours with the definition of 3DGS."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.special import lpmv

from gsseg_core.errors import SceneValueError
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.spherical_harmonics import C0, basis


def random_directions(n: int, seed: int = 0) -> np.ndarray:
    directions = np.random.default_rng(seed).normal(size=(n, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def reference_basis(directions: np.ndarray, degree: int) -> np.ndarray:
    """Real orthonormal harmonics by their definition, Condon-Shortley phase included."""
    x, y, z = directions.T
    azimuth = np.arctan2(y, x)
    columns = []
    for band in range(degree + 1):
        for order in range(-band, band + 1):
            m = abs(order)
            norm = (2 * band + 1) / (4 * math.pi) * math.factorial(band - m) / math.factorial(band + m)
            turn = np.sin(m * azimuth) if order < 0 else np.cos(m * azimuth)
            columns.append(math.sqrt(norm * (2 if m else 1)) * lpmv(m, band, z) * turn)
    return np.stack(columns, axis=1)


@pytest.mark.parametrize("degree", range(4))
def test_basis_is_that_of_legendre_functions(degree: int) -> None:
    directions = random_directions(200)
    result = basis(directions, degree)
    assert result.shape == (200, (degree + 1) ** 2) and result.dtype == np.float32
    np.testing.assert_allclose(result, reference_basis(directions, degree), atol=2e-6)


def test_first_band_has_the_signs_of_3dgs() -> None:
    c1 = 0.4886025119029199
    expected = c1 * np.array([[0, 0, -1], [-1, 0, 0], [0, 1, 0]])
    np.testing.assert_allclose(basis(np.eye(3), 1)[:, 1:], expected, atol=1e-7)
    assert math.isclose(C0, 0.28209479177387814)


def test_degrees_beyond_three_are_refused() -> None:
    with pytest.raises(SceneValueError, match="degree is 4; expected 0 to 3"):
        basis(np.eye(3), 4)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_colours_are_half_plus_the_sum_and_stay_in_range(degree: int) -> None:
    rng = np.random.default_rng(degree)
    sh, means = rng.normal(size=(50, (degree + 1) ** 2, 3)), rng.normal(size=(50, 3))
    scene = GaussianScene.from_arrays(means, np.tile([1.0, 0, 0, 0], (50, 1)), np.ones((50, 3)), np.full(50, 0.5), sh)
    centre, ids = np.array([0.3, -2.0, 1.0]), np.arange(1, 50, 3)
    directions = (means - centre) / np.linalg.norm(means - centre, axis=1, keepdims=True)
    expected = np.clip(0.5 + np.einsum("nb,nbc->nc", reference_basis(directions, degree), sh), 0, 1)
    rgb = scene.colors(centre)
    assert rgb.dtype == np.float32 and rgb.min() == 0 and rgb.max() == 1
    np.testing.assert_allclose(rgb, expected, atol=1e-5)
    np.testing.assert_array_equal(scene.colors(centre, ids), rgb[ids])
    np.testing.assert_allclose(scene.colors(), np.clip(0.5 + C0 * sh[:, 0], 0, 1), atol=1e-6)
    np.testing.assert_array_equal(scene.sh, sh.astype(np.float32))
