"""Where rays end, by tile: nothing beyond has a weight, as a plain look at all weights says."""

from __future__ import annotations

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st
from operator_cases import lifting
from small_scenes import look_at

from gsseg_core.raster.backends import make_operator
from gsseg_core.raster.constants import T_LIFTED
from gsseg_core.raster.cpu.occlusion import nearest_depths, ray_ends
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene

TILE = 16


def tile_of_each_pixel(camera: Camera) -> np.ndarray:
    rows, columns = np.indices((camera.height, camera.width)) // TILE
    return rows * -(-camera.width // TILE) + columns


def plain_last_depths(scene: GaussianScene, camera: Camera, labels: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Depth of the farthest Gaussian with a weight in a labelled pixel of each tile; -infinite where there is none."""
    tiles, in_view = tile_of_each_pixel(camera), camera.project(scene.means)[1]
    farthest = np.where(weights > 0, in_view, -np.inf).max(axis=1).reshape(labels.shape)
    depths = np.full(tiles.max() + 1, -np.inf)
    np.maximum.at(depths, tiles[labels >= 0], farthest[labels >= 0])
    return depths


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32), st.integers(1, 400), st.sampled_from([0.1, 0.5, 2.0]))
@example(961, 327, 0.5)  # A ray that meets the limit but for a rounding error.
def test_nothing_beyond_the_end_of_a_tiles_rays_has_a_weight(seed: int, count: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    scene = GaussianScene.from_arrays(
        rng.normal(size=(count, 3)), rng.normal(size=(count, 4)), size * rng.uniform(0.1, 1, (count, 3)),
        rng.uniform(0.3, 1, count), np.zeros((count, 1, 3)),
    )  # fmt: skip
    camera = look_at("view", np.array([0.0, -4.0, 1.0]), 50, 37)
    labels = rng.integers(-1, 3, (37, 50), dtype=np.int32)
    labels[: rng.integers(0, 37)] = -1
    weights, left = lifting(make_operator(scene, camera), scene)
    left = left.reshape(labels.shape)
    ends, last = ray_ends(scene, camera, labels), plain_last_depths(scene, camera, labels, weights)
    assert ends.shape == last.shape and (last <= ends * (1 + 1e-5)).all()
    tiles, closed = tile_of_each_pixel(camera), np.isfinite(ends)
    # A block of 4 x 4 pixels ends as a whole, so those are looked at in which a pixel has a label.
    blocks = np.pad(labels >= 0, ((0, -37 % 4), (0, -50 % 4))).reshape(10, 4, 13, 4).any(axis=(1, 3))
    looked_at = blocks.repeat(4, axis=0).repeat(4, axis=1)[:37, :50]
    for tile in range(len(ends)):
        here = tiles == tile
        assert (ends[tile] == -np.inf) == (labels[here] < 0).all()
        if closed[tile]:
            assert left[here & (labels >= 0)].max() < T_LIFTED, "a ray that goes on has no end"
        elif looked_at[here].any():
            assert left[here & looked_at].max() > 0, "rays that have all ended have an end"
    nearest = nearest_depths(scene, camera)
    assert (nearest[closed] <= ends[closed] * (1 + 1e-5)).all()
