"""Similarities: cameras and points that move together see each other as before."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gsseg_core.scene.camera import Camera
from gsseg_core.scene.similarity import Similarity

K = np.array([[100.0, 0, 32], [0, 120, 24], [0, 0, 1]])


def similarity(seed: int) -> Similarity:
    rng = np.random.default_rng(seed)
    turn = Rotation.from_quat(rng.normal(size=4)).as_matrix()
    return Similarity(float(np.exp(rng.normal())), turn, rng.normal(size=3))


@given(st.integers(0, 2**31))
def test_a_moved_camera_sees_moved_points_where_it_saw_the_points_and_farther_by_the_scale(seed: int) -> None:
    rng, moved = np.random.default_rng(seed), similarity(seed)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_quat(rng.normal(size=4)).as_matrix(), rng.normal(size=3)
    camera = Camera("a", 64, 48, K, pose)
    points = camera.center + rng.uniform((-1, -1, 2), (1, 1, 4), (9, 3)) @ pose[:3, :3]
    pixels, depths = camera.project(points)
    seen, farther = moved.camera(camera).project(moved.points(points))
    np.testing.assert_allclose(seen, pixels, atol=1e-6)
    np.testing.assert_allclose(farther, moved.scale * depths)


@given(st.integers(0, 2**31))
def test_composing_is_mapping_by_one_after_the_other_and_the_inverse_leads_back(seed: int) -> None:
    points, first, second = np.random.default_rng(seed).normal(size=(5, 3)), similarity(seed), similarity(seed + 1)
    np.testing.assert_allclose(second.after(first).points(points), second.points(first.points(points)), atol=1e-9)
    np.testing.assert_allclose(first.inverse().points(first.points(points)), points, atol=1e-9)
