"""Clicks and corrections without a viewer: the ray hits what is seen, and what was drawn changes that and no more."""

from __future__ import annotations

import numpy as np
import pytest
from labellings import labelled, probabilities_of
from operator_cases import lifting, make_camera, make_scene, moved, rigid
from small_scenes import NAMES, balls_on_a_table, clean_views, ring, true_labels

from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.data.view import View
from gsseg_core.errors import NoUsableViewsError, SettingsError
from gsseg_core.raster.backends import make_operator
from gsseg_core.scene.camera import Camera
from gsseg_core.segmentation import REMOVED, UNOBSERVED
from gsseg_core.viewer.corrections import Corrections, box, disc, drawn_on, looks_alike, region
from gsseg_core.viewer.picking import ViewVotes, pick

SCENE, TRUTH = balls_on_a_table()
CAMERA = ring(5)[0]
LABELS = true_labels(SCENE, TRUTH, CAMERA)
LEARNT = labelled(TRUTH.astype(np.int32), np.eye(4, dtype=np.float32)[TRUTH], dict(NAMES))


def ray(camera: Camera, column: float, row: float) -> np.ndarray:
    """Direction of the ray through a point of the image."""
    return camera.world_to_camera[:3, :3].T @ np.linalg.solve(camera.K, [column, row, 1])


def test_a_ray_hits_the_class_that_its_pixel_shows() -> None:
    hits = 0
    for row in range(2, 46, 3):
        for column in range(2, 62, 3):
            picked = pick(SCENE, CAMERA, CAMERA.center, ray(CAMERA, column + 0.5, row + 0.5))
            if picked is not None and picked.weight > 0.3:
                assert TRUTH[picked.gaussian] == LABELS[row, column]
                hits += 1
    assert hits > 100


def test_a_ray_hits_the_gaussian_of_the_greatest_weight_of_that_pixel() -> None:
    row, column = (int(i) for i in np.argwhere(LABELS == 2)[20])
    weights = make_operator(SCENE, CAMERA).weights(row, column)
    picked = pick(SCENE, CAMERA, CAMERA.center, ray(CAMERA, column + 0.5, row + 0.5))
    assert picked is not None and picked.gaussian == weights.gaussians[weights.weights.argmax()]
    assert picked.weight == pytest.approx(weights.weights.max(), abs=1e-5)


@pytest.mark.parametrize("size", [(64, 48), (320, 200)])
def test_a_click_hits_what_makes_most_of_its_pixel_wherever_that_is_in_the_picture(size: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    count = 400  # of all shapes, and many on each ray
    means, scales = rng.uniform([-3, -2, 2], [3, 2, 6], (count, 3)), np.exp(rng.normal(-1.5, 0.7, (count, 3)))
    scene = make_scene(means, rng.normal(size=(count, 4)), scales, rng.uniform(0.1, 0.9, count))
    camera = make_camera(*size, rigid(rng))
    scene = moved(scene, np.linalg.inv(camera.world_to_camera))
    operator, alike = make_operator(scene, camera), 0
    pixels = [(r, c) for r in range(0, camera.height, 16) for c in range(0, camera.width, 16)]
    for row, column in pixels:
        seen = operator.weights(row, column)
        picked = pick(scene, camera, camera.center, ray(camera, column + 0.5, row + 0.5))
        assert picked is not None
        alike += picked.gaussian == seen.gaussians[seen.weights.argmax()]
        assert picked.weight == pytest.approx(seen.weights.max(), abs=0.1)  # Wide ones are linearised elsewhere.
    assert alike >= 0.95 * len(pixels)


def test_what_is_hidden_is_looked_through_and_a_ray_into_nothing_hits_nothing() -> None:
    row, column = (int(i) for i in np.argwhere(LABELS == 3)[30])
    picked = pick(SCENE, CAMERA, CAMERA.center, ray(CAMERA, column, row), TRUTH != 3)
    assert picked is None or TRUTH[picked.gaussian] != 3
    assert pick(SCENE, CAMERA, CAMERA.center, -ray(CAMERA, column, row)) is None
    assert pick(SCENE, CAMERA, CAMERA.center, ray(CAMERA, column, row), np.zeros(len(SCENE), bool)) is None


def test_a_scene_without_some_gaussians_is_drawn_without_them() -> None:
    image = make_operator(SCENE, CAMERA).without(TRUTH == 1).render(np.eye(4, dtype=np.float32)[TRUTH])
    assert not image[..., 1].any() and image[..., 2].any()


def test_view_votes_are_listed_by_view_the_largest_first() -> None:
    views = clean_views(4)
    view_votes = ViewVotes(SCENE, [*views, View(CAMERA)])  # the last one has no mask, and no vote
    i = int(np.flatnonzero(TRUTH == 2)[5])
    found = view_votes.of(i)
    assert [v.weight for v in found] == sorted((v.weight for v in found), reverse=True)
    for view in views:
        labels = view.read_labels()
        votes = lifting(make_operator(SCENE, view.camera), SCENE)[0][:, i] @ np.eye(4)[labels.ravel()]
        of_view = {v.label: v.weight for v in found if v.view == view.name}
        assert of_view == pytest.approx({k: votes[k] for k in range(4) if votes[k] > 0}, rel=1e-4, abs=1e-6)
    assert view_votes.of(len(SCENE) - 1) == []  # out of sight


def test_mean_reliability_weighs_views_by_how_much_they_saw() -> None:
    views = clean_views(3)
    mean = ViewVotes(SCENE, views).mean_reliability({views[0].name: 1.0, views[2].name: 0.25})
    seen = np.stack([lifting(make_operator(SCENE, views[v].camera), SCENE)[0].sum(axis=0) for v in (0, 2)])
    known = seen.sum(axis=0) > 1e-3
    expected = (seen[0] + 0.25 * seen[1])[known] / seen.sum(axis=0)[known]
    assert np.allclose(mean[known], expected, atol=1e-3) and np.isnan(mean[-1])


def test_what_was_drawn_is_labelled_and_all_else_is_unknown() -> None:
    spot = disc(CAMERA, 20.5, 10.5, 3, 2).read_labels()
    assert set(np.unique(spot)) == {UNKNOWN, 2} and spot[10, 20] == 2 and (spot == 2).sum() == 29
    assert (disc(CAMERA, 20.5, 10.5, 0, 2).read_labels() == 2).sum() == 1
    square = box(CAMERA, (30, 20), (10, 12), 3).read_labels()
    assert (square[12:20, 10:30] == 3).all() and (square == 3).sum() == 20 * 8
    row, column = (int(i) for i in np.argwhere(LABELS == 1)[0])
    assert np.array_equal(region(CAMERA, LABELS, column, row, 2).read_labels() == 2, LABELS == 1)
    alike = looks_alike(SCENE, CAMERA, column, row, 2).read_labels()
    assert set(np.unique(alike)) == {UNKNOWN, 2} and alike[row, column] == 2
    with pytest.raises(SettingsError, match=r"pixel is \(row 3, column 64\); expected a row from 0 to 47"):
        disc(CAMERA, 64, 3, 1, 1)


def test_the_share_seen_is_one_for_what_lies_open_and_nearly_nothing_for_what_lies_behind() -> None:
    """The slow way: alphas of each Gaussian, alone in the scene, summed over the image."""
    drawn = View.from_arrays(CAMERA, np.zeros((CAMERA.height, CAMERA.width), np.int32))
    found, share = drawn_on(SCENE, drawn), np.zeros(len(SCENE), np.float32)
    share[found.ids] = found.seen
    seen = make_operator(SCENE, CAMERA).visibility()
    for i in np.flatnonzero(seen > 0.5)[::25]:
        alone = make_operator(SCENE, CAMERA).without(np.arange(len(SCENE)) != i).visibility()[i]
        assert share[i] == pytest.approx(seen[i] / alone, abs=0.08)  # alphas below 1/255 count as nothing
    assert share.max() <= 1 and not share[-1]


def test_a_correction_relabels_what_was_drawn_on_and_nothing_else() -> None:
    corrections = Corrections(SCENE)
    corrections.add(region(CAMERA, LABELS, *np.argwhere(LABELS == 1)[9][::-1].tolist(), 2))
    now = corrections.apply(LEARNT)
    changed = now.labels != LEARNT.labels
    assert changed[TRUTH == 1].sum() > 15 and not changed[TRUTH != 1].any()
    assert np.allclose(probabilities_of(now).sum(axis=1), 1, atol=1e-5)
    assert (true_labels(SCENE, now.labels, CAMERA)[LABELS == 1] == 2).mean() > 0.75


def test_what_lies_behind_counts_a_correction_no_more_however_often_something_was_drawn_in_front_of_it() -> None:
    """Two sheets, one behind the other: twenty strokes on the front one, and then the rear one is just touched."""
    scene = make_scene([[0, 0, 4], [0, 0, 5]], [[1, 0, 0, 0]] * 2, [[0.3, 0.3, 0.01], [0.3, 0.3, 0.01]], [0.97, 0.97])
    K = np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]])
    front = Camera("front", 64, 48, K, np.eye(4))
    rear = Camera("rear", 64, 48, K, np.array([[-1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 9], [0, 0, 0, 1]]))
    before = labelled(np.ones(2, np.int32), np.eye(4, dtype=np.float32)[[1, 1]], dict(NAMES))
    often, once = Corrections(scene), Corrections(scene)
    for _ in range(20):
        often.add(disc(front, 32, 24, 1, 2))
    assert often.apply(before).labels.tolist() == [2, 1]
    for corrections in (often, once):
        corrections.add(disc(rear, 37, 24, 0, 3))
    assert once.apply(before).labels[1] == 1
    np.testing.assert_array_equal(probabilities_of(often.apply(before))[1], probabilities_of(once.apply(before))[1])


def test_a_correction_is_taken_back_exactly_and_the_ones_before_it_stay() -> None:
    corrections = Corrections(SCENE)
    corrections.add(disc(CAMERA, 32, 24, 4, 1))
    once = corrections.apply(LEARNT)
    corrections.add(disc(CAMERA, 10, 30, 6, 3))
    assert (corrections.apply(LEARNT).labels != once.labels).any() and len(corrections) == 2
    assert corrections.undo()
    assert np.array_equal(probabilities_of(corrections.apply(LEARNT)), probabilities_of(once))
    assert corrections.undo() and not corrections.undo()
    assert corrections.apply(LEARNT) is LEARNT


def test_a_correction_may_bring_a_class_of_its_own_and_wake_what_was_unobserved_or_removed() -> None:
    labels = np.where(TRUTH == 1, REMOVED, UNOBSERVED).astype(np.int32)
    probabilities = np.where((TRUTH == 1)[:, None], probabilities_of(LEARNT), 0).astype(np.float32)
    corrections = Corrections(SCENE)
    corrections.add(region(CAMERA, LABELS, *np.argwhere(LABELS == 3)[9][::-1].tolist(), 5))
    corrections.add(region(CAMERA, LABELS, *np.argwhere(LABELS == 1)[9][::-1].tolist(), 1))
    now = corrections.apply(labelled(labels, probabilities, dict(NAMES)), {5: "vase"})
    assert now.class_names[5] == "vase" and now.class_names[4] == "class_04"
    assert (now.labels[TRUTH == 3] == 5).sum() > 15
    assert (now.labels[TRUTH == 1] == REMOVED).all()  # it said no more than what was known of them


def test_a_correction_that_meets_nothing_is_refused_and_changes_nothing() -> None:
    K = np.array([[8.0, 0, 4], [0, 8, 4], [0, 0, 1]])
    corrections = Corrections(SCENE)
    away = Camera("away", 8, 8, K, np.block([[np.eye(3), np.array([[0], [0], [-500.0]])], [np.zeros(3), 1.0]]))
    with pytest.raises(
        NoUsableViewsError, match=r"correction: .*sees no Gaussian; expected something drawn on the scene"
    ):
        corrections.add(disc(away, 4, 4, 3, 1))
    assert not len(corrections) and corrections.apply(LEARNT) is LEARNT
