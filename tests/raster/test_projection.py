from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from operator_cases import make_camera, rigid

from gsseg_core.raster.cpu import projection
from gsseg_core.raster.cpu.projection import BATCH, Projected, project
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene


def looked_at_one_by_one(scene: GaussianScene, camera: Camera) -> Projected:
    """Project a scene of which every batch could be anywhere, so that none is left out as a whole."""
    batches = -(-len(scene) // BATCH)
    anywhere = np.tile(np.float32([-1e9, -1e9, -1e9, 1e9, 1e9, 1e9, 1e9]), (batches, 1))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(projection, "_bounds_of_batches", lambda means, scales: anywhere)
        return project(scene.subset(np.arange(len(scene))), camera)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 12_000), st.sampled_from([0.0003, 0.003, 0.03, 0.3]))
def test_a_batch_is_left_out_only_if_none_of_its_gaussians_is_shown(seed: int, count: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    balls = rng.normal(scale=2.0, size=(-(-count // BATCH), 3)).repeat(BATCH, axis=0)[:count]
    scene = GaussianScene.from_arrays(
        balls + rng.normal(scale=size, size=(count, 3)), rng.normal(size=(count, 4)),
        size * rng.lognormal(0, 1, (count, 3)), rng.uniform(0, 1, count), np.zeros((count, 1, 3)),
    )  # fmt: skip
    camera = make_camera(60, 40, rigid(rng))
    for found, expected in zip(project(scene, camera), looked_at_one_by_one(scene, camera), strict=True):
        np.testing.assert_array_equal(found, expected)
