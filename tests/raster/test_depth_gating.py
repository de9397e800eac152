"""Depth gating: pixels count where a measured depth is that of the scene, and say nothing where something hides it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_scenes import balls_on_a_table, clean_views

from gsseg_core.data.view import View
from gsseg_core.errors import MaskSizeError, SettingsError
from gsseg_core.raster.backends import make_operator
from gsseg_core.raster.depth import surface
from gsseg_core.raster.depth_gating import DepthTolerance, gate_view

SCENE, _ = balls_on_a_table()
VIEW = clean_views(1)[0]
SURFACE = surface(SCENE, make_operator(SCENE, VIEW.camera))
DEPTH = np.where(np.isfinite(SURFACE.depth), SURFACE.depth, 0)
HIDDEN = np.zeros(DEPTH.shape, bool)
HIDDEN[10:30, 20:40] = True
MEETS = np.isfinite(SURFACE.depth)


def gated_labels(depth: np.ndarray, **settings: float) -> np.ndarray:
    return gate_view(SCENE, VIEW, depth, **settings).view.read_labels()  # type: ignore[arg-type]


def test_what_stands_before_the_scene_is_unknown_and_all_else_stays() -> None:
    gated = gate_view(SCENE, VIEW, np.where(HIDDEN, DEPTH * 0.7, DEPTH))
    expected = np.where(HIDDEN & MEETS, -1, VIEW.read_labels())
    np.testing.assert_array_equal(gated.view.read_labels(), expected)
    np.testing.assert_array_equal(gated.contradicted, HIDDEN & MEETS)
    assert gated.view.camera is VIEW.camera
    assert gated.measured.sum() == MEETS.sum()


def test_what_is_measured_behind_the_scene_counts_only_where_the_scene_covers_most_of_the_ray() -> None:
    gated = gate_view(SCENE, VIEW, DEPTH * 1.5)
    np.testing.assert_array_equal(gated.contradicted, MEETS & (SURFACE.coverage > 0.5))
    assert 0 < gated.contradicted.sum() < MEETS.sum()


@pytest.mark.parametrize("nothing", [0.0, -1.0, np.nan, np.inf, -np.inf])
def test_pixels_without_a_measured_depth_say_nothing(nothing: float) -> None:
    gated = gate_view(SCENE, VIEW, np.full(DEPTH.shape, nothing, np.float32))
    np.testing.assert_array_equal(gated.view.read_labels(), VIEW.read_labels())
    assert not gated.measured.any()


@given(
    st.floats(0, 0.3), st.floats(0, 0.3), st.floats(-0.6, 0.6), st.floats(1e-3, 1e3),
)  # fmt: skip
def test_the_tolerance_is_in_measured_units_whatever_the_scale_of_the_scene(
    absolute: float, relative: float, off: float, scale: float
) -> None:
    margin = absolute + relative * DEPTH
    if (abs(margin - abs(off)) < 1e-3).any():
        return  # Rounding may decide.
    measured = np.where(DEPTH > 0, (DEPTH + off) * scale, 0)
    tolerance = DepthTolerance(absolute * scale, relative)
    beyond = MEETS & (measured > 0) & (abs(off) > margin) & ((off < 0) | (SURFACE.coverage > 0.5))
    np.testing.assert_array_equal(gate_view(SCENE, VIEW, measured, tolerance, scale=scale).contradicted, beyond)


def test_a_mask_of_probabilities_is_gated_as_one_of_labels() -> None:
    labels = np.maximum(VIEW.read_labels(), 0)
    probabilities = 0.8 * (labels == np.arange(4)[:, None, None])
    view = View.from_probabilities(VIEW.camera, probabilities.astype(np.float32))
    depth = np.where(HIDDEN, 0.5 * DEPTH, DEPTH)
    gated = gate_view(SCENE, view, depth).view
    np.testing.assert_array_equal(gated.read_labels(), np.where(HIDDEN & MEETS, -1, labels))
    assert gated.read_seen().evidence is not None


def test_depth_of_another_size_and_an_impossible_tolerance_are_refused() -> None:
    with pytest.raises(MaskSizeError, match=r"depth has shape \(24, 32\); expected \(48, 64\)"):
        gate_view(SCENE, VIEW, DEPTH[::2, ::2])
    for scale in (0, -1, np.nan, np.inf):
        with pytest.raises(SettingsError, match=r"scale of the depth is .*; expected a number above 0"):
            gate_view(SCENE, VIEW, DEPTH, scale=scale)
    for bad in (-0.1, np.nan, np.inf):
        with pytest.raises(SettingsError, match=r"depth_tolerance\.relative is .*; expected 0 or more"):
            DepthTolerance(0.1, bad)
