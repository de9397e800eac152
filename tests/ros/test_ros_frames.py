"""Frames: poses survive the way from the scene to the map and back, whatever the similarity."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsseg_core.errors import SettingsError
from gsseg_core.scene.camera import Camera, rigid_motion
from gsseg_ros.frames import (
    Similarity,
    interpolate,
    inverse,
    pose_from_parameters,
    quaternion_from_rotation,
    rotation_from_quaternion,
)

NO_TURN = [0.0, 0.0, 0.0, 1.0]
HALF = math.sqrt(0.5)

components = st.floats(-1, 1)
quaternions = (
    st.tuples(components, components, components, components)
    .map(np.array)
    .filter(lambda q: np.linalg.norm(q) > 1e-3)
    .map(lambda q: q / np.linalg.norm(q))
)
places = st.tuples(*[st.floats(-100, 100)] * 3).map(np.array)
poses = st.builds(lambda q, place: rigid_motion(rotation_from_quaternion(*q), place), quaternions, places)
similarities = st.builds(Similarity.from_parameters, st.floats(1e-3, 1e3), places.map(list), quaternions.map(list))


@given(quaternions)
def test_a_quaternion_survives_its_rotation_matrix(q: np.ndarray) -> None:
    rotation = rotation_from_quaternion(*q)
    assert abs(rotation @ rotation.T - np.eye(3)).max() < 1e-12
    assert np.linalg.det(rotation) > 0
    back = np.array(quaternion_from_rotation(rotation))
    assert back[3] >= 0
    assert min(abs(back - q).max(), abs(back + q).max()) < 1e-12


@pytest.mark.parametrize("axis", range(3))
def test_half_a_turn_about_each_axis_keeps_its_axis(axis: int) -> None:
    q = np.eye(4)[axis]
    assert np.allclose(rotation_from_quaternion(*q), np.diag(2 * np.eye(3)[axis] - 1), atol=1e-15)
    assert np.allclose(np.abs(quaternion_from_rotation(rotation_from_quaternion(*q))), q, atol=1e-15)


def test_a_quarter_turn_about_z_takes_x_to_y() -> None:
    assert np.allclose(rotation_from_quaternion(0, 0, HALF, HALF) @ [1, 0, 0], [0, 1, 0], atol=1e-15)


@pytest.mark.parametrize("length", [1e-320, 1e-200, 1e200])
def test_the_length_of_a_quaternion_does_not_matter(length: float) -> None:
    assert np.allclose(rotation_from_quaternion(0, 0, length, length), rotation_from_quaternion(0, 0, 1, 1))


@given(poses)
def test_a_pose_times_its_inverse_is_no_motion(pose: np.ndarray) -> None:
    assert abs(pose @ inverse(pose) - np.eye(4)).max() < 1e-9


@given(similarities, poses)
def test_a_camera_survives_the_way_to_the_map_and_back(similarity: Similarity, pose: np.ndarray) -> None:
    world_to_camera = similarity.world_to_camera(pose)
    Camera("rigid", 4, 3, np.diag([1.0, 1.0, 1.0]), world_to_camera)
    assert np.allclose(similarity.camera_in_map(world_to_camera), pose, rtol=0, atol=1e-9)


@given(similarities, poses, places)
def test_a_point_is_seen_in_the_same_direction_in_scene_and_map(
    similarity: Similarity, pose: np.ndarray, point: np.ndarray
) -> None:
    in_scene = similarity.world_to_camera(pose) @ [*point, 1]
    in_map = similarity.scale * similarity.rotation @ point + similarity.translation
    seen = inverse(pose) @ [*in_map, 1]
    assert np.allclose(similarity.scale * in_scene[:3], seen[:3], rtol=0, atol=1e-7)


def test_points_are_turned_then_scaled_then_moved() -> None:
    similarity = Similarity.from_parameters(2.0, [10.0, 20.0, 30.0], [0.0, 0.0, HALF, HALF])
    moved = similarity.points_to_map(np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32))
    assert moved.dtype == np.float32
    assert np.allclose(moved, [[10, 22, 30], [8, 20, 30], [10, 20, 32]], atol=1e-5)
    assert similarity.points_to_map(np.empty((0, 3))).shape == (0, 3)


@given(st.lists(st.tuples(*[st.floats(-1e6, 1e6, width=32)] * 3), max_size=5))
def test_without_a_similarity_points_keep_every_bit(points: list[tuple[float, float, float]]) -> None:
    array = np.array(points, np.float32).reshape(-1, 3)
    assert np.array_equal(Similarity.from_parameters(1.0, [0.0] * 3, NO_TURN).points_to_map(array), array)


@pytest.mark.parametrize(
    ("scale", "translation", "rotation", "named", "found"),
    [
        (0.0, [0.0] * 3, NO_TURN, "scene_to_map.scale", "0"),
        (-1.0, [0.0] * 3, NO_TURN, "scene_to_map.scale", "-1"),
        (math.nan, [0.0] * 3, NO_TURN, "scene_to_map.scale", "nan"),
        (math.inf, [0.0] * 3, NO_TURN, "scene_to_map.scale", "inf"),
        (1.0, [0.0, math.nan, 0.0], NO_TURN, "scene_to_map.translation", "nan"),
        (1.0, [0.0] * 2, NO_TURN, "scene_to_map.translation", "[0.0, 0.0]"),
        (1.0, [0.0] * 3, [0.0, 0.0, math.inf, 1.0], "scene_to_map.rotation", "inf"),
        (1.0, [0.0] * 3, [0.0] * 3, "scene_to_map.rotation", "[0.0, 0.0, 0.0]"),
        (1.0, [0.0] * 3, [0.0] * 4, "scene_to_map.rotation", "all zeros"),
    ],
)
def test_an_impossible_similarity_is_refused(
    scale: float, translation: list[float], rotation: list[float], named: str, found: str
) -> None:
    with pytest.raises(SettingsError) as caught:
        Similarity.from_parameters(scale, translation, rotation)
    message = str(caught.value)
    assert message.startswith(named + " is ")
    assert found in message
    assert "expected" in message


def test_an_impossible_parameter_of_another_pose_is_named_as_such() -> None:
    with pytest.raises(SettingsError, match=r"^camera_in_base\.rotation is all zeros; expected"):
        pose_from_parameters("camera_in_base", [0.0] * 3, [0.0] * 4)


@given(poses, poses)
def test_interpolation_starts_at_the_first_pose_and_ends_at_the_second(a: np.ndarray, b: np.ndarray) -> None:
    assert np.allclose(interpolate(a, b, 0.0), a, rtol=0, atol=1e-9)
    assert np.allclose(interpolate(a, b, 1.0), b, rtol=0, atol=1e-9)


@given(poses, quaternions, st.floats(0, 1))
def test_interpolation_turns_at_constant_speed(a: np.ndarray, turn: np.ndarray, share: float) -> None:
    b = a @ rigid_motion(rotation_from_quaternion(*turn), np.zeros(3))
    between = interpolate(a, b, share)
    assert np.allclose(between[:3, :3] @ between[:3, :3].T, np.eye(3), rtol=0, atol=1e-12)
    part, whole = (angle(a[:3, :3].T @ pose[:3, :3]) for pose in (between, b))
    assert math.isclose(part, share * whole, abs_tol=1e-9)


@given(poses, poses, st.floats(0, 1))
def test_interpolation_moves_along_a_line(a: np.ndarray, b: np.ndarray, share: float) -> None:
    expected = a[:3, 3] + share * (b[:3, 3] - a[:3, 3])
    assert np.allclose(interpolate(a, b, share)[:3, 3], expected, rtol=0, atol=1e-9)


def angle(rotation: np.ndarray) -> float:
    q = np.array(quaternion_from_rotation(rotation))
    return 2 * math.atan2(float(np.linalg.norm(q[:3])), q[3])
