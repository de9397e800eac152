"""Where rays end, by tile: nothing beyond has a weight, as a plain look at all weights says."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from small_scenes import look_at

from gsseg_core.raster.backends import make_operator
from gsseg_core.raster.cpu.occlusion import nearest_depths, ray_ends
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene

TILE = 16


def plain_last_depths(scene: GaussianScene, camera: Camera, labels: np.ndarray) -> np.ndarray:
    """Depth of the farthest Gaussian with a weight in a labelled pixel of each tile; -infinite where there is none."""
    pixels, gaussians, _ = make_operator(scene, camera).weights()
    rows, columns = np.divmod(pixels, camera.width)
    labelled = labels[rows, columns] >= 0
    across = -(-camera.width // TILE)
    depths = np.full(across * -(-camera.height // TILE), -np.inf)
    tiles = (rows // TILE * across + columns // TILE)[labelled]
    np.maximum.at(depths, tiles, camera.project(scene.means)[1][gaussians[labelled]])
    return depths


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32), st.integers(1, 400), st.sampled_from([0.1, 0.5, 2.0]))
def test_nothing_beyond_the_end_of_a_tiles_rays_has_a_weight(seed: int, count: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    scene = GaussianScene.from_arrays(
        rng.normal(size=(count, 3)), rng.normal(size=(count, 4)), size * rng.uniform(0.1, 1, (count, 3)),
        rng.uniform(0.3, 1, count), np.zeros((count, 1, 3)),
    )  # fmt: skip
    camera = look_at("view", np.array([0.0, -4.0, 1.0]), 50, 37)
    labels = rng.integers(-1, 3, (37, 50), dtype=np.int32)
    labels[: rng.integers(0, 37)] = -1
    ends, last = ray_ends(scene, camera, labels), plain_last_depths(scene, camera, labels)
    assert ends.shape == last.shape and (last <= ends * (1 + 1e-5)).all()
    across = 4
    for tile in range(len(ends)):
        row, column = tile // across * TILE, tile % across * TILE
        assert (ends[tile] == -np.inf) == (labels[row : row + TILE, column : column + TILE] < 0).all()
    left = make_operator(scene, camera).transmittance()
    closed = np.isfinite(ends)
    for tile in np.flatnonzero(closed):
        row, column = tile // across * TILE, tile % across * TILE
        here = np.s_[row : row + TILE, column : column + TILE]
        assert left[here][labels[here] >= 0].max() < 1e-3, "a ray that goes on has no end"
    nearest = nearest_depths(scene, camera)
    assert (nearest[closed] <= ends[closed] * (1 + 1e-5)).all()
