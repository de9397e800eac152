"""The class that a view shows most of in each pixel, by every implementation that is present."""

from __future__ import annotations

import numpy as np
import pytest
from operator_cases import random_view

from gsseg_core.csr_rows import CSRRows
from gsseg_core.raster.view_renderer import PixelGrid


@pytest.mark.parametrize("background", [True, False])
@pytest.mark.parametrize("channels", [1, 3, 40])
@pytest.mark.parametrize("grid", [PixelGrid(2, 5), PixelGrid(9, 4), PixelGrid(20, 1), PixelGrid(40, 3)])
def test_the_strongest_class_is_the_largest_of_all_that_are_rendered(backend, channels, background, grid):
    scene, camera = random_view(channels, 150, 37, 21)
    operator, rng = backend.make(scene, camera), np.random.default_rng(channels)
    codes = rng.choice([0, 0.25, 1], (len(scene), channels)).astype(np.float32)
    image, left_over = operator.blend(codes)
    image[..., 0] += left_over if background else 0
    found = operator.strongest(CSRRows.from_dense(codes), channels, background, grid)
    assert found.classes.dtype == np.int32 and found.known.dtype == bool
    np.testing.assert_array_equal(found.classes, image.argmax(axis=2))
    sure = np.abs(image.sum(axis=2) - 0.5) > 1e-5
    np.testing.assert_array_equal(found.known[sure], image.sum(axis=2)[sure] > 0.5)
    np.testing.assert_allclose(found.on_grid, grid.of(image), atol=1e-6)
    assert operator.strongest(CSRRows.from_dense(codes), channels, background).on_grid.shape == (0, 0, channels)
    np.testing.assert_array_equal(found.labels(), np.where(found.known, found.classes, -1))


@pytest.mark.parametrize("background", [True, False])
@pytest.mark.parametrize("others", [False, True])
@pytest.mark.parametrize("most", [0, 0.1, 1])
def test_the_strongest_class_is_the_same_where_blending_ends_early(backend, others, background, most):
    scene, camera = random_view(3, 4_000, 37, 21)
    operator, rng = backend.make(scene, camera), np.random.default_rng(3)
    # Mostly of one class, of a few, or of none: some pixels are decided by the first Gaussians, others never.
    codes = rng.dirichlet(np.full(9, 0.2), len(scene)) * (rng.random((len(scene), 1)) < 0.9)
    codes = ((1 - most) * codes + most * np.eye(9)[scene.means[:, 0].argsort().argsort() % 2]).astype(np.float32)
    image, left_over = operator.blend(codes)
    image[..., 0] += left_over if background else 0
    beside = np.ones((len(operator.ids), 1), np.float32) if others else None
    found = operator.strongest(CSRRows.from_dense(codes), 9, background, beside=beside)
    ranked, known = np.sort(image, axis=2), image.sum(axis=2)
    sure = ranked[..., -1] - ranked[..., -2] > 1e-5
    assert sure.mean() > 0.9
    np.testing.assert_array_equal(found.classes[sure], image.argmax(axis=2)[sure])
    np.testing.assert_array_equal(found.known[np.abs(known - 0.5) > 1e-5], (known > 0.5)[np.abs(known - 0.5) > 1e-5])
    if others:
        np.testing.assert_allclose(found.beside.transmittance, left_over, atol=1e-7)


@pytest.mark.parametrize("background", [True, False])
@pytest.mark.parametrize("first", [0, 1])
def test_of_hundreds_of_classes_each_place_has_a_few(backend, first, background):
    scene, camera = random_view(7, 400, 57, 41)
    operator, rng = backend.make(scene, camera), np.random.default_rng(7)
    # Those beside each other in the image are of a few classes, which come in any order; the first one may be of none.
    near = first + (scene.means[:, 0].argsort().argsort() * 293) // len(scene)
    codes = np.zeros((len(scene), 300), np.float32)
    for shift in rng.permutation(5):
        codes[np.arange(len(scene)), near + shift] = rng.random(len(scene)) / 5
    image = np.concatenate([operator.blend(codes[:, k : k + 4])[0] for k in range(0, 300, 4)], axis=2)
    rendered, left_over = operator.blend_rows(CSRRows.from_dense(codes), 300)
    np.testing.assert_allclose(rendered, image, atol=1e-6)
    image[..., 0] += left_over if background else 0
    found = operator.strongest(CSRRows.from_dense(codes), 300, background, PixelGrid(1, 3))
    ranked = np.sort(image, axis=2)
    sure = (ranked[..., -1] - ranked[..., -2] > 1e-5) | (ranked[..., -1] == 0)
    assert sure.mean() > 0.9
    np.testing.assert_array_equal(found.classes[sure], image.argmax(axis=2)[sure])
    np.testing.assert_allclose(found.on_grid, image[1::3, 1::3], atol=1e-6)


@pytest.mark.parametrize("others", [1, 4])
def test_what_is_blended_beside_the_strongest_class_is_what_is_blended_alone(backend, others):
    scene, camera = random_view(others, 150, 37, 21)
    operator, rng = backend.make(scene, camera), np.random.default_rng(others)
    codes = CSRRows.from_dense(rng.choice([0, 0.25, 1], (len(scene), 5)).astype(np.float32))
    beside = rng.normal(size=(len(operator.ids), others)).astype(np.float32)
    found, alone = operator.strongest(codes, 5, True, beside=beside), operator.blend_seen(beside)
    np.testing.assert_allclose(found.beside.image, alone.image, atol=1e-5)
    np.testing.assert_allclose(found.beside.transmittance, alone.transmittance, atol=1e-7)
    without = operator.strongest(codes, 5, True)
    assert without.beside is None
    np.testing.assert_array_equal(found.classes, without.classes)


@pytest.mark.parametrize("share", [0.01, 0.5, 0])
def test_pixels_that_are_wanted_are_the_same_as_without_the_others(backend, share):
    scene, camera = random_view(5, 400, 37, 21)
    operator, rng = backend.make(scene, camera), np.random.default_rng(5)
    codes = CSRRows.from_dense(rng.dirichlet(np.full(6, 0.2), len(scene)).astype(np.float32))
    wanted = rng.random((camera.height, camera.width)) < share
    found, full = operator.strongest(codes, 6, True, wanted=wanted), operator.strongest(codes, 6, True)
    np.testing.assert_array_equal(found.labels()[wanted], full.labels()[wanted])
