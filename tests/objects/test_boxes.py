"""Boxes around objects: they lie as the object does, go with the scene, and stray Gaussians do not blow them up."""

from __future__ import annotations

import json
from itertools import permutations

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from small_scenes import NAMES, balls_on_a_table, clean_views

from gsseg_core.errors import SceneValueError
from gsseg_core.export.summary import RunReport
from gsseg_core.live.session import LiveSession
from gsseg_core.objects.oriented_boxes import OrientedBox, class_box, object_boxes, oriented_box
from gsseg_core.refine.settings import RefineSettings
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import Segmentation

SIZE = np.array([0.6, 0.4, 0.15])


def rotation(seed: int) -> np.ndarray:
    matrix, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return matrix * np.linalg.det(matrix)


def cuboid(count: int, size: np.ndarray = SIZE, seed: int = 0) -> np.ndarray:
    """Points on the six sides of a cuboid around the origin, of which the sides get shares by their area."""
    rng = np.random.default_rng(seed)
    areas = np.array([size[1] * size[2], size[0] * size[2], size[0] * size[1]])
    points = rng.uniform(-0.5, 0.5, (count, 3))
    axis = rng.choice(3, count, p=areas / areas.sum())
    points[np.arange(count), axis] = np.where(rng.random(count) < 0.5, -0.5, 0.5)
    return points * size


def small(count: int, sigma: float = 1e-4) -> np.ndarray:
    return np.tile(sigma**2 * np.eye(3), (count, 1, 1))


def box_around(points: np.ndarray, weights: np.ndarray | None = None) -> OrientedBox:
    return oriented_box(points, small(len(points)), np.ones(len(points)) if weights is None else weights)


def farthest_corner(found: np.ndarray, expected: np.ndarray) -> float:
    """Largest distance from a corner to the nearest of the expected ones."""
    return float(np.linalg.norm(found[:, None] - expected, axis=2).min(axis=1).max())


def test_a_box_around_a_cuboid_is_that_cuboid() -> None:
    turn, shift = rotation(3), np.array([1.0, -2.0, 0.5])
    box = box_around(cuboid(2000) @ turn.T + shift)
    np.testing.assert_allclose(box.size, SIZE, rtol=0.01)
    np.testing.assert_allclose(box.center, shift, atol=0.005)
    np.testing.assert_allclose(abs(box.axes.T @ turn), np.eye(3), atol=0.02)
    truth = OrientedBox(shift, turn, SIZE, shift, np.eye(3))
    assert farthest_corner(box.corners, truth.corners) < 0.01


@pytest.mark.parametrize("seed", range(5))
def test_a_cube_whose_principal_axes_say_nothing_still_gets_its_own_sides(seed: int) -> None:
    points = cuboid(1500, np.full(3, 0.3), seed) @ rotation(seed).T
    box = box_around(points)
    np.testing.assert_allclose(box.size, 0.3, rtol=0.02)
    matches = [abs(box.axes.T @ rotation(seed))[list(order)] for order in permutations(range(3))]
    assert min(np.abs(match - np.eye(3)).max() for match in matches) < 0.05


def test_a_round_plate_gets_its_diameter_and_thickness() -> None:
    rng = np.random.default_rng(0)
    radius, angle = np.sqrt(rng.random(2000)), rng.uniform(0, 2 * np.pi, 2000)
    plate = np.stack([radius * np.cos(angle), radius * np.sin(angle), rng.choice([-0.02, 0.02], 2000)], axis=1)
    box = box_around(plate @ rotation(1).T)
    # Half a percent of a disc lies in the outermost 4 % of its radius.
    np.testing.assert_allclose(box.size[:2], 2 * 0.96, rtol=0.02)
    assert box.size[2] == pytest.approx(0.04, rel=0.05)


@given(seed=st.integers(0, 10_000), scale=st.floats(0.01, 100), count=st.integers(1, 120))
@example(seed=101, scale=1.0, count=3)
@example(seed=2, scale=1.0, count=4)
def test_a_box_turns_moves_and_scales_with_the_scene(seed: int, scale: float, count: int) -> None:
    rng = np.random.default_rng(seed)
    points, weights = rng.normal(size=(count, 3)) * [0.7, 0.3, 0.1], rng.uniform(0.1, 1, count)
    shapes = rng.normal(size=(count, 3, 3)) * 0.02
    shapes = shapes @ shapes.transpose(0, 2, 1)
    turn, shift = rotation(seed + 1), rng.normal(size=3)
    expected = oriented_box(points, shapes, weights).moved(turn, shift, scale)
    found = oriented_box(scale * points @ turn.T + shift, scale**2 * turn @ shapes @ turn.T, weights)
    close = 1e-6 * scale
    np.testing.assert_allclose(found.mean, expected.mean, atol=close)
    np.testing.assert_allclose(found.covariance, expected.covariance, atol=close * scale)
    np.testing.assert_allclose(found.center, expected.center, atol=close)
    np.testing.assert_allclose(found.size, expected.size, atol=close)
    assert farthest_corner(found.corners, expected.corners) < 4 * close


@given(seed=st.integers(0, 10_000), share=st.floats(0.0, 0.08), distance=st.floats(2.5, 1000))
def test_floaters_do_not_change_the_box(seed: int, share: float, distance: float) -> None:
    rng = np.random.default_rng(seed)
    points = cuboid(500, seed=seed) @ rotation(seed).T
    away = rng.normal(size=(int(share * 500), 3))
    away *= distance / np.linalg.norm(away, axis=1, keepdims=True)
    box = box_around(np.concatenate([points, away]))
    alone = box_around(points)
    np.testing.assert_allclose(box.size, alone.size, rtol=1e-6)
    np.testing.assert_allclose(box.center, alone.center, atol=1e-6)
    np.testing.assert_allclose(box.covariance, alone.covariance, atol=1e-6)


def test_what_is_hardly_there_counts_hardly() -> None:
    points = np.concatenate([cuboid(1000), cuboid(1000) * 1.5])
    box = box_around(points, np.repeat([1.0, 0.004], 1000))
    np.testing.assert_allclose(box.size, SIZE, rtol=0.02)


def test_a_gaussian_reaches_as_far_as_its_own_standard_deviation() -> None:
    turn = rotation(0)
    box = oriented_box(np.zeros((1, 3)), (turn * [0.09, 0.04, 0.01] @ turn.T)[None], np.ones(1))
    np.testing.assert_allclose(box.size, [0.6, 0.4, 0.2])
    np.testing.assert_allclose(box.covariance, turn * [0.09, 0.04, 0.01] @ turn.T)
    np.testing.assert_allclose(abs(box.axes.T @ turn), np.eye(3), atol=1e-9)


@pytest.mark.parametrize("weight", [0.0, 1.0])
@pytest.mark.parametrize(
    "points",
    [np.zeros((1, 3)), np.zeros((7, 3)), np.full((7, 3), 1e9), np.eye(3), np.linspace(0, 1, 20)[:, None] * [1, 2, 3],
     np.pad(np.random.default_rng(0).random((50, 2)), ((0, 0), (0, 1)))],
    ids=["one", "one place", "one place far off", "three", "line", "plane"],
)  # fmt: skip
def test_points_without_volume_get_a_box_too(points: np.ndarray, weight: float) -> None:
    box = oriented_box(points, np.zeros((len(points), 3, 3)), np.full(len(points), weight))
    assert np.isfinite(box.corners).all() and (box.size >= 0).all()
    np.testing.assert_allclose(box.axes @ box.axes.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(box.axes) == pytest.approx(1)
    assert (abs((points - box.center) @ box.axes) <= box.size / 2 + 1e-9).all()


def test_sides_go_from_the_longest_to_the_shortest() -> None:
    for seed in range(10):
        box = box_around(cuboid(200, seed=seed)[:, [2, 0, 1]] @ rotation(seed).T)
        assert (np.diff(box.size) <= 0).all() and np.linalg.det(box.axes) == pytest.approx(1)


def test_no_gaussian_and_shapes_that_do_not_fit_are_errors() -> None:
    with pytest.raises(SceneValueError, match="M at least 1"):
        oriented_box(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0))
    with pytest.raises(SceneValueError, match=r"expected \(M, 3\), \(M, 3, 3\), \(M,\)"):
        oriented_box(np.zeros((4, 3)), np.zeros((4, 3, 3)), np.zeros(3))


@pytest.mark.parametrize("value", [np.nan, np.inf, -1e200, -1.0])
@pytest.mark.parametrize("what", ["means", "covariances", "weights"])
def test_what_is_no_number_of_a_scene_is_one_clear_error(what: str, value: float) -> None:
    given = {"means": cuboid(20), "covariances": np.tile(np.eye(3), (20, 1, 1)), "weights": np.ones(20)}
    given[what][3] = value
    if value == -1.0 and what != "weights":
        return
    with pytest.raises(SceneValueError, match="box: means, covariances or weights are NaN, or beyond 1e"):
        oriented_box(**given)


def test_a_large_object_is_judged_by_a_sample() -> None:
    points = cuboid(50_000) @ rotation(2).T
    np.testing.assert_allclose(box_around(points).size, SIZE, rtol=0.01)


def test_the_box_of_an_object_of_thousands_does_not_depend_on_the_order_of_its_gaussians() -> None:
    rng = np.random.default_rng(1)
    points = rng.normal(size=(7_900, 3)) * SIZE @ rotation(2).T
    shuffled = points[rng.permutation(len(points))]
    np.testing.assert_allclose(box_around(shuffled).size, box_around(points).size, rtol=1e-9)


@pytest.fixture(scope="module")
def segmented() -> tuple[GaussianScene, Segmentation]:
    scene, _ = balls_on_a_table()
    session = LiveSession(scene, NAMES)
    for view in clean_views(6):
        assert session.fuse(view) is None
    return scene, session.segmentation(RefineSettings(k=10))


def test_every_object_of_a_segmentation_gets_its_box(segmented: tuple[GaussianScene, Segmentation]) -> None:
    scene, result = segmented
    boxes = object_boxes(scene, result)
    assert list(boxes) == [1, 2, 3]
    for k, box in boxes.items():
        angle = (k - 1) * 2 * np.pi / 3
        np.testing.assert_allclose(box.center, [np.cos(angle), np.sin(angle), 0.45], atol=0.1)
        # Balls of radius 0.4, made of round Gaussians of 0.09; no view sees the lower side.
        assert (abs(box.size - 0.98) < 0.3).all()
        index = np.flatnonzero(result.labels == k)
        again = class_box(scene, index, result.confidence[index])
        np.testing.assert_array_equal(again.corners, box.corners)


def test_a_box_as_a_dictionary_is_plain_json(segmented: tuple[GaussianScene, Segmentation]) -> None:
    box = object_boxes(*segmented)[1]
    written = json.loads(json.dumps(box.as_dict()))
    assert list(written) == ["center", "axes", "size", "mean", "covariance"]
    np.testing.assert_allclose(np.transpose(written["axes"]), box.axes, atol=1e-5)
    for name in ("center", "size", "mean", "covariance"):
        np.testing.assert_allclose(written[name], getattr(box, name), atol=1e-5)


def test_a_box_far_from_the_origin_is_written_as_exactly_as_it_is_large() -> None:
    box = box_around(cuboid(500) + np.array([500_123.4, 4_123_456.7, 80.2]))
    written = box.as_dict()
    for name in ("center", "mean"):
        np.testing.assert_allclose(written[name], getattr(box, name), rtol=0, atol=1e-5)


def test_the_report_of_a_run_has_the_boxes_of_its_objects(segmented: tuple[GaussianScene, Segmentation]) -> None:
    report = RunReport.of(*segmented, views={}, settings={}, seconds={}, files={}).as_dict()
    boxes = {entry["id"]: entry["box"] for entry in report["classes"]}
    assert boxes == {0: None} | {k: box.as_dict() for k, box in object_boxes(*segmented).items()}
