"""Confidences: the temperature that mends them, and that files carry them."""

from __future__ import annotations

import json
import tracemalloc
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_scenes import NAMES, NUM_CLASSES, balls_on_a_table, ring, taught, write_dataset, wrong_views

from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.data.view import View
from gsseg_core.export.class_files import export_classes
from gsseg_core.learn import temperature as fitting
from gsseg_core.learn.calibrate import calibrate
from gsseg_core.learn.em.em_learner import EMLearner
from gsseg_core.learn.learner import Learner
from gsseg_core.learn.mask_reliability import MaskChecker
from gsseg_core.learn.temperature import (
    OUTLIERS,
    PIXELS,
    RIGHT,
    STEPS,
    Sample,
    fit_temperature,
    golden_section,
    grid_of,
    sample_grid,
    tempered,
)
from gsseg_core.learn.vote_learner import VoteLearner
from gsseg_core.live.session import LiveSession
from gsseg_core.pipeline import segment
from gsseg_core.raster.backends import make_operator
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import Segmentation

SCENE, _ = balls_on_a_table()
VIEWS = wrong_views(10)


def draw(probabilities: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """One class per row, with these probabilities."""
    below = rng.random((len(probabilities), 1)) > np.cumsum(probabilities, axis=1)
    return np.minimum(below.sum(axis=1), probabilities.shape[1] - 1)


def as_sample(shares: np.ndarray, seen: np.ndarray) -> Sample:
    order = np.argsort(seen, kind="stable")
    return Sample(shares[order].astype(np.float32), seen[order], unknown=0)


# The temperature


@given(st.integers(1, 8), st.integers(1, 5), st.floats(0.2, 5), st.integers(0, 2**32 - 1))
def test_tempering_keeps_order_sums_and_zeros_and_can_be_undone(n: int, k: int, temperature: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    shares = rng.integers(0, 9, (n, k)) / 8
    shares = (shares / np.maximum(shares.sum(axis=1, keepdims=True), 1)).astype(np.float32)
    out = tempered(shares, temperature)
    assert out.dtype == np.float32
    np.testing.assert_allclose(out.sum(axis=1), shares.sum(axis=1), rtol=1e-5)
    np.testing.assert_array_equal(out == 0, shares == 0)
    np.testing.assert_array_equal(out.argmax(axis=1), shares.argmax(axis=1))
    np.testing.assert_allclose(tempered(out, 1 / temperature), shares, rtol=1e-3, atol=1e-6)
    order = rng.permutation(k)
    np.testing.assert_allclose(tempered(shares[:, order], temperature), out[:, order], rtol=1e-5)


def test_the_only_class_of_a_row_that_rounding_brought_above_one_gets_one() -> None:
    above = np.nextafter(np.float32(1), np.float32(2))
    assert tempered(np.array([[above, 0]]), 0.5).tolist() == [[1, 0]]


@pytest.mark.parametrize("true", [0.4, 1.0, 2.5])
def test_temperature_of_known_predictions_is_found_whether_masks_are_right_or_wrong(true: float) -> None:
    rng = np.random.default_rng(0)
    samples, spoilt = [], []
    for _ in range(8):
        right = rng.dirichlet(np.full(4, 0.3), 2_000).astype(np.float32)
        shares, classes = tempered(right, 1 / true), draw(right, rng)
        samples.append(as_sample(shares, classes))
        # Half of the pixels of one class are called by another one's label.
        seen = np.where((classes == 2) & (rng.random(len(classes)) < 0.5), 1, classes)
        spoilt.append(as_sample(shares, seen))
    assert fit_temperature(samples) == pytest.approx(true, rel=0.1)
    assert fit_temperature(spoilt) == pytest.approx(true, rel=0.15)


def test_names_of_the_classes_and_order_of_the_views_do_not_matter_to_the_temperature() -> None:
    rng = np.random.default_rng(1)
    right = rng.dirichlet(np.full(4, 0.3), (3, 500)).astype(np.float32)
    seen = [draw(one, rng) for one in right]
    place = np.array([2, 0, 3, 1])  # class k becomes place[k]
    samples = [as_sample(one, labels) for one, labels in zip(right, seen, strict=True)]
    renamed = [as_sample(one[:, np.argsort(place)], place[labels]) for one, labels in zip(right, seen, strict=True)]
    assert fit_temperature(renamed[::-1]) == pytest.approx(fit_temperature(samples), rel=1e-3)


def slow_log_likelihood(sample: Sample, temperature: float) -> float:
    """The equations of the module, with confusion matrices of all classes and labels."""
    probabilities, present = tempered(sample.shares, temperature).astype(float), np.unique(sample.seen)
    carries = sample.seen[:, None] == present  # (P, L)
    diagonal, confusion = (present, np.arange(len(present))), np.ones((probabilities.shape[1], len(present)))
    confusion *= (1 - RIGHT) / len(present)
    confusion[diagonal] += RIGHT
    confusion /= confusion.sum(axis=1, keepdims=True)
    for step in range(STEPS):
        likelihood = (probabilities @ ((1 - OUTLIERS) * confusion) * carries).sum(axis=1) + OUTLIERS / len(present)
        if step < STEPS - 1:
            counts = (1 - OUTLIERS) * confusion * (probabilities.T @ (carries / likelihood[:, None]))
            counts[diagonal] += RIGHT * probabilities.sum(axis=0)[present]
            total = counts.sum(axis=1, keepdims=True)
            confusion = np.where(total > 0, counts / np.where(total > 0, total, 1), confusion)
    return float(np.log(likelihood).sum())


def pixels_of_a_few_classes_each(num_classes: int) -> Sample:
    rng = np.random.default_rng(0)
    first = rng.integers(0, num_classes, 2_000)
    shares = np.zeros((len(first), num_classes), np.float32)
    shares[np.arange(len(first)), first] = 0.75
    shares[np.arange(len(first)), (first + 1) % num_classes] += 0.25
    return as_sample(shares, np.where(rng.random(len(first)) < 0.2, (first + 2) % num_classes, first))


@pytest.mark.parametrize("num_classes", [1, 3, 40, 1_500])
def test_the_likelihood_of_a_temperature_is_that_of_the_equations_also_where_classes_or_labels_lack(
    num_classes: int,
) -> None:
    sample = pixels_of_a_few_classes_each(num_classes)
    for temperature in (0.2, 1.0, 5.0):
        found = fitting._log_likelihood(fitting._Cells.of(sample), temperature)
        assert found == pytest.approx(slow_log_likelihood(sample, temperature), rel=1e-6)


def test_a_temperature_takes_memory_by_what_pixels_show_however_many_classes_a_view_has() -> None:
    samples = [pixels_of_a_few_classes_each(1_500)]
    fit_temperature(samples)  # Whoever does so first in a process loads what it takes.
    tracemalloc.start()
    fit_temperature(samples)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**22, "a table of all classes by all labels takes 18 MB"


def test_nothing_to_go_by_leaves_probabilities_as_they_are() -> None:
    image, unknown = np.full((8, 8, 2), 0.5, np.float32), np.full((8, 8), UNKNOWN, np.int32)
    assert fit_temperature([]) == 1 and fit_temperature([sample_grid(image, unknown)]) == 1


@pytest.mark.parametrize("shape", [(5, 7), (300, 400), (1, 100_000), (3_000, 10)])
def test_pixels_are_sampled_evenly_and_not_too_many(shape: tuple[int, int]) -> None:
    labels = np.arange(np.prod(shape), dtype=np.int32).reshape(shape) % 3
    labels[0, 0] = UNKNOWN
    image = np.eye(5, dtype=np.float32)[labels]
    image[labels < 0] = 0
    grid = grid_of(*shape)
    sample = sample_grid(grid.of(image), grid.of(labels))
    assert min(np.prod(shape) - 1, PIXELS / 16) <= len(sample.seen) <= PIXELS
    assert sample.shares.shape[1] == 3 and (sample.shares.argmax(axis=1) == sample.seen).all()
    assert (np.diff(sample.seen) >= 0).all()
    assert sample.unknown == 0


def test_a_sample_is_of_the_classes_that_a_view_shows_however_many_there_are() -> None:
    labels = np.arange(32 * 32).reshape(32, 32) % 7 + 3
    image = np.zeros((32, 32, 20_000), np.float32)
    np.put_along_axis(image, labels[..., None], 0.75, axis=2)
    image[0, 0], image[1:, :, 19_999] = 0, 1e-7
    tracemalloc.start()
    sample = sample_grid(image, labels)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**21, "a copy of all takes 82 MB"
    assert sample.unknown == 1 and sample.seen.tolist() == sorted(np.arange(1, 1024) % 7)
    np.testing.assert_allclose(sample.shares, np.eye(7)[sample.seen], atol=1e-6)


def test_labelled_pixels_of_which_little_is_predicted_are_left_out_and_counted() -> None:
    labels = np.array([[0, 1, 2, UNKNOWN, UNKNOWN]])
    image = np.eye(3, dtype=np.float32)[labels] * np.array([1, 0.4, 0.6, 1, 0.1], np.float32)[:, None]
    sample = sample_grid(image, labels)
    assert sample.seen.tolist() == [0, 1] and sample.unknown == 1


# Learners


@cache
def fitted(kind: type[Learner]) -> Learner:
    return taught(kind(SCENE, NUM_CLASSES), VIEWS).fit()


def test_votes_without_a_view_are_those_of_a_learner_that_never_saw_it() -> None:
    learner = fitted(VoteLearner)
    before = learner._votes.dense()
    others = taught(VoteLearner(SCENE, NUM_CLASSES), VIEWS[1:]).fit()
    np.testing.assert_array_equal(learner.vote_rows_without(VIEWS[0].name).dense(NUM_CLASSES), others.codes_)
    np.testing.assert_array_equal(learner._votes.dense(), before)


def test_where_no_labelled_pixel_is_sampled_all_is_unknown_and_probabilities_stay_as_they_are() -> None:
    between = (np.arange(VIEWS[0].camera.height) % 2 == 0)[:, None]  # The grid takes the rows beside these.
    scribbled = [View.from_arrays(view.camera, np.where(between, view.read_labels(), UNKNOWN)) for view in VIEWS]
    for found in (
        calibrate(taught(VoteLearner(SCENE, NUM_CLASSES), scribbled).fit()),
        calibrate(VoteLearner(SCENE, NUM_CLASSES)),
    ):
        assert found.temperature == 1 and found.pixels == 0 and found.unknown == 1


@pytest.mark.parametrize("kind", [EMLearner, VoteLearner])
def test_calibration_changes_nothing_of_the_learner_and_is_the_same_every_time(kind: type[Learner]) -> None:
    learner = fitted(kind)
    codes = learner.codes_.copy()
    found = calibrate(learner)
    assert found == calibrate(learner) and found.held_out
    assert found.views == len(VIEWS) and found.pixels == sum((v.read_labels()[:, ::2] >= 0).sum() for v in VIEWS) // 2
    np.testing.assert_array_equal(learner.codes_, codes)


def test_wrong_masks_make_votes_less_sure_than_they_are_right() -> None:
    assert calibrate(fitted(VoteLearner)).temperature < 0.8


def test_many_shares_are_tempered_like_few() -> None:
    shares = np.random.default_rng(0).dirichlet([0.3, 1, 2], 150_000).astype(np.float32)
    parts = [tempered(shares[first : first + 1000], 0.7) for first in range(0, len(shares), 1000)]
    np.testing.assert_array_equal(tempered(shares, 0.7), np.concatenate(parts))


def test_checked_views_are_not_rendered_again(monkeypatch: pytest.MonkeyPatch) -> None:
    learner = fitted(EMLearner)
    assert isinstance(learner, EMLearner)
    checker = MaskChecker(learner)
    checker.check_all()
    monkeypatch.setattr(EMLearner, "predict_without", None)
    monkeypatch.setattr(EMLearner, "strongest_without", None)
    found = calibrate(learner, checker)
    monkeypatch.undo()
    assert found == calibrate(learner)


# What carries it


def segmentation() -> Segmentation:
    return Segmentation.from_codes(SCENE, fitted(VoteLearner).codes_, NAMES)


def test_calibration_keeps_labels_and_pictures_and_changes_confidences() -> None:
    raw = segmentation()
    result = raw.calibrated(0.5)
    np.testing.assert_array_equal(result.labels, raw.labels)
    np.testing.assert_allclose(result.probabilities, tempered(raw.probabilities, 0.5))
    assert (result.confidence >= raw.confidence - 1e-6).all() and result.confidence.sum() > raw.confidence.sum() + 1
    for camera in ring(2):
        operator = make_operator(SCENE, camera)
        one, two = raw.render(operator), result.render(operator)
        np.testing.assert_array_equal(one.labels, two.labels)
        np.testing.assert_allclose(tempered(raw.blend(operator), 0.5).max(axis=2), two.confidence, atol=1e-5)
    assert raw.calibrated(1.0).shares is raw.shares
    np.testing.assert_allclose(result.calibrated(1.0).probabilities, raw.probabilities, atol=1e-6)


@pytest.mark.parametrize("place", [-9.0, -1.0, 0.2, 0.99, 1.7, 9.0])
@pytest.mark.parametrize("power", [0.5, 1.0, 4.0])
def test_a_golden_section_finds_the_least_value_between_bounds(place: float, power: float) -> None:
    asked: list[float] = []

    def f(x: float) -> float:
        asked.append(x)
        return abs(x - place) ** power

    assert abs(golden_section(f, -1.5, 1.8, 0.01) - np.clip(place, -1.5, 1.8)) <= 0.01
    assert min(asked) >= -1.5 and max(asked) <= 1.8 and len(asked) < 16


def test_a_calibrated_segmentation_comes_back_exactly(tmp_path: Path) -> None:
    result = segmentation().calibrated(0.4)
    result.save(tmp_path / "segmentation.npz")
    again = Segmentation.load(tmp_path / "segmentation.npz", SCENE)
    assert again.temperature == 0.4
    operator = make_operator(SCENE, ring(1)[0])
    np.testing.assert_array_equal(again.probabilities, result.probabilities)
    np.testing.assert_array_equal(again.render(operator).confidence, result.render(operator).confidence)
    np.testing.assert_array_equal(np.load(tmp_path / "segmentation.npz")["confidence"], result.confidence)


def test_plys_carry_label_and_confidence_of_the_segmentation_and_of_it_alone(tmp_path: Path) -> None:
    result = segmentation().calibrated(0.5)
    paths = export_classes(SCENE, result, tmp_path / "classes")
    assert len(paths) == NUM_CLASSES
    for k, path in paths.items():
        scene = GaussianScene.load(path)
        members = result.labels == k
        assert (scene.vertices["label"] == k).all() and scene.vertices["label"].dtype == np.int32
        np.testing.assert_array_equal(scene.vertices["confidence"], result.confidence[members])
        np.testing.assert_array_equal(scene.means, SCENE.means[members])
        # What was exported before, segmented once more, has the new figures and not both.
        codes = np.eye(2, dtype=np.float32)[np.ones(len(scene), int)] * np.float32(0.5) + np.float32(0.25)
        again = Segmentation.from_codes(scene, codes, {})
        (new,) = export_classes(scene, again, tmp_path / f"again{k}").values()
        vertices = GaussianScene.load(new).vertices
        assert set(vertices["label"]) == {1} and set(vertices["confidence"]) == {np.float32(0.75)}
        assert len(vertices.dtype) == len(scene.vertices.dtype)


def test_the_report_says_how_the_files_of_the_command_were_calibrated(tmp_path: Path) -> None:
    data, out = write_dataset(tmp_path / "data"), tmp_path / "out"
    found = segment(data / "scene.ply", data, out, learner="votes")["calibration"]
    assert found == json.loads((out / "report.json").read_text())["calibration"]
    assert found["views"] == 4 and found["pixels"] > 0 and found["held_out"]
    result = Segmentation.load(out / "segmentation.npz", GaussianScene.load(data / "scene.ply"))
    assert result.temperature == pytest.approx(found["temperature"], abs=1e-4) and result.temperature != 1


def test_a_live_session_is_calibrated_by_what_it_learns_and_keeps_that(tmp_path: Path) -> None:
    session = LiveSession(SCENE, NAMES)
    for view in VIEWS:
        assert session.fuse(view) is None
    assert session.segmentation().temperature == 1
    learnt = session.learn("votes").learnt
    result = session.segmentation()
    assert result.temperature == learnt.temperature == calibrate(fitted(VoteLearner)).temperature
    session.save(tmp_path / "state.npz")
    again = LiveSession(SCENE, NAMES)
    again.load(tmp_path / "state.npz")
    np.testing.assert_array_equal(again.segmentation().confidence, result.confidence)
