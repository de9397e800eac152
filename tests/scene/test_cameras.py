"""Cameras: a known point lands on a known pixel, and what is no pinhole camera is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from camera_folders import (
    FX,
    FY,
    HEIGHT,
    WIDTH,
    WORLD_TO_CAMERA,
    K,
    assert_lands,
)
from hypothesis import given
from hypothesis import strategies as st

from gsseg_core.errors import IntrinsicsError, PoseError
from gsseg_core.scene.camera import Camera, smaller_camera


def test_a_known_point_lands_on_a_known_pixel() -> None:
    camera = Camera("0001", WIDTH, HEIGHT, K, WORLD_TO_CAMERA)
    assert_lands(camera, 57, 39)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (FX, FY, 32, 24)


def test_points_that_are_not_in_front_have_no_pixel() -> None:
    camera = Camera("0001", WIDTH, HEIGHT, K, np.eye(4))
    uv, depth = camera.project([[0, 0, -1], [1, 1, 0], [0, 0, 1]])
    np.testing.assert_array_equal(uv, [[np.nan] * 2, [np.nan] * 2, [32, 24]])
    np.testing.assert_array_equal(depth, [-1, 0, 1])


def test_a_camera_keeps_its_own_copy_of_the_matrices() -> None:
    pose = np.eye(4)
    camera = Camera("a", WIDTH, HEIGHT, K, pose)
    pose[0, 0] = 5
    assert camera.world_to_camera[0, 0] == 1


@given(seed=st.integers(0, 2**32 - 1))
def test_the_centre_is_where_the_camera_sits_and_every_rigid_motion_is_accepted(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    rotation *= np.sign(np.linalg.det(rotation))
    position = rng.normal(size=3) * 1000
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.T, -rotation.T @ position
    camera = Camera("a", WIDTH, HEIGHT, K, pose)
    np.testing.assert_allclose(camera.center, position, atol=1e-9)
    uv, depth = camera.project((position + 3 * rotation[:, 2])[None])
    np.testing.assert_allclose(uv, [[32, 24]], atol=1e-6)
    np.testing.assert_allclose(depth, [3], atol=1e-9)


def pose_with(row: int, column: int, value: float) -> np.ndarray:
    pose = np.eye(4)
    pose[row, column] = value
    return pose


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        (pose_with(0, 3, np.nan), "pose holds NaN or infinite numbers"),
        (pose_with(1, 1, np.inf), "pose holds NaN or infinite numbers"),
        (pose_with(2, 2, 0), r"pose is not invertible \(determinant 0\)"),
        (np.zeros((4, 4)), "pose is not invertible"),
        (pose_with(0, 0, -1), r"pose is not a rigid motion \(determinant -1"),
        (np.diag([2.0, 2, 2, 1]), r"pose is not a rigid motion \(determinant 8"),
        (pose_with(0, 1, 0.5), "pose is not a rigid motion"),
        (pose_with(3, 0, 0.5), "pose is not a rigid motion"),
        (np.eye(3), r"pose has shape \(3, 3\); expected \(4, 4\)"),
    ],
)
def test_impossible_poses_are_refused(pose: np.ndarray, message: str) -> None:
    with pytest.raises(PoseError, match=f"camera 'a': {message}"):
        Camera("a", WIDTH, HEIGHT, K, pose)


def K_with(row: int, column: int, value: float) -> np.ndarray:
    matrix = K.copy()
    matrix[row, column] = value
    return matrix


@pytest.mark.parametrize(
    ("width", "height", "matrix", "message"),
    [
        (0, 48, K, "width is 0; expected a whole number of pixels, at least 1"),
        (64, -3, K, "height is -3"),
        (64.5, 48, K, r"width is 64\.5"),
        (64, 48, np.eye(4), "expected 3 x 3 finite numbers"),
        (64, 48, K_with(0, 2, np.nan), "expected 3 x 3 finite numbers"),
        (64, 48, K_with(0, 0, 0), "focal lengths are 0 and 120; expected positive"),
        (64, 48, K_with(1, 1, -5), "focal lengths are 100 and -5; expected positive"),
        (64, 48, K_with(0, 1, 2), r"expected \[\[fx, 0, cx\]"),
        (64, 48, K_with(2, 2, 2), r"expected \[\[fx, 0, cx\]"),
    ],
)
def test_impossible_intrinsics_are_refused(width: Any, height: int, matrix: np.ndarray, message: str) -> None:
    with pytest.raises(IntrinsicsError, match=f"camera 'a': .*{message}"):
        Camera("a", width, height, matrix, np.eye(4))


@pytest.mark.parametrize("number", [np.uint8, np.uint16, np.int64])
def test_sizes_of_numpys_integers_are_taken_as_numbers_that_do_not_overflow(number: type[np.integer[Any]]) -> None:
    camera = Camera("a", number(240), number(250), K, np.eye(4))  # type: ignore[arg-type]
    assert camera.width * camera.height == 60_000
    assert type(camera.width) is type(camera.height) is int
    assert smaller_camera(camera, 3).width == 80
