"""Learning from soft and partial masks: as from plain ones where they say the same, and no more than they say."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from operator_cases import lifting
from small_scenes import (
    NAMES,
    NUM_CLASSES,
    balls_on_a_table,
    clean_views,
    mean_iou,
    taught,
    write_dataset,
    wrong_views,
)

from gsseg_core.cli.main import main
from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.label_evidence import VOTE_UNIT, LabelEvidence
from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.data.soft_masks import SeenLabels
from gsseg_core.data.view import View
from gsseg_core.errors import UnknownLabelError
from gsseg_core.learn.em.em_learner import EMLearner, EMSettings
from gsseg_core.learn.learner import Learner
from gsseg_core.learn.mask_reliability import MaskChecker
from gsseg_core.learn.registry import LEARNERS, make_learner
from gsseg_core.learn.vote_learner import VoteLearner
from gsseg_core.learn.vote_resolution import impute_probabilities, is_resolved, resolved_votes, vote_shares, weigh_votes
from gsseg_core.live.session import LiveSession
from gsseg_core.raster.backends import make_operator

SCENE, TRUTH = balls_on_a_table()


def one_hot(view: View) -> np.ndarray:
    return (np.arange(NUM_CLASSES)[:, None, None] == view.read_labels()).astype(np.float32)


def blurred(view: View, seed: int = 0) -> View:
    """Probabilities that are soft everywhere."""
    noise = np.random.default_rng(seed).dirichlet(np.ones(NUM_CLASSES), size=view.read_labels().shape)
    return View.from_probabilities(view.camera, 0.7 * one_hot(view) + 0.3 * np.moveaxis(noise, -1, 0))


def partial(view: View, *looked_for: int) -> View:
    labels = view.read_labels()
    return View.from_arrays(view.camera, np.where(np.isin(labels, looked_for), labels, 0), supervised=looked_for)


def in_prototypes(view: View) -> View:
    """A plain mask, as prototypes in another order than the classes'; it says the same."""
    labels = view.read_labels()
    classes = np.unique(labels[labels >= 0]).astype(np.int32)
    order = np.arange(len(classes))[::-1]
    place = np.full(NUM_CLASSES + 1, UNKNOWN)
    place[classes[order]] = np.arange(len(classes))
    evidence = LabelEvidence(classes, np.eye(len(classes), dtype=np.float32)[order])
    return View.from_seen(view.camera, SeenLabels(place[labels].astype(np.int32), evidence))


def learnt(name: str, views: list[View], num_classes: int = NUM_CLASSES) -> Learner:
    learner = make_learner(name, SCENE, num_classes, max_steps=4)
    learner.observe_all(views)
    return learner.fit()


@pytest.mark.parametrize("name", LEARNERS)
def test_one_hot_probabilities_teach_exactly_what_the_plain_mask_does(name: str) -> None:
    views = wrong_views(4)
    one, two = learnt(name, views), learnt(name, [View.from_probabilities(v.camera, one_hot(v)) for v in views])
    np.testing.assert_array_equal(one.codes_, two.codes_)
    np.testing.assert_array_equal(one._votes.dense(), two._votes.dense())


@pytest.mark.parametrize("name", LEARNERS)
def test_prototypes_teach_what_their_classes_do(name: str) -> None:
    """The way of soft masks, with a mask that is not soft: equal but for rounding, votes exactly."""
    views = wrong_views(4)
    one, two = learnt(name, views), learnt(name, [in_prototypes(view) for view in views])
    np.testing.assert_allclose(one._votes.dense() * VOTE_UNIT, two._votes.dense() * VOTE_UNIT, atol=1e-3)
    np.testing.assert_allclose(one.codes_, two.codes_, atol=2e-3)
    np.testing.assert_array_equal(one.observed_, two.observed_)


def test_soft_votes_are_weights_times_masses_by_a_slow_twin() -> None:
    """W as a dense matrix: votes are its transpose times m - r [looked for]."""
    probabilities = np.moveaxis(np.random.default_rng(1).dirichlet(np.ones(3), size=(48, 64)), -1, 0)[:2]
    view = View.from_probabilities(clean_views(1)[0].camera, probabilities, [3, 1])
    seen = view.read_seen()
    assert seen.evidence is not None
    W, _ = lifting(make_operator(SCENE, view.camera), SCENE)
    said = seen.evidence.votes.dense(NUM_CLASSES)[seen.labels.ravel()]
    learner = taught(VoteLearner(SCENE, NUM_CLASSES), [view])
    np.testing.assert_allclose(learner._votes.dense() * VOTE_UNIT, W.T @ said, atol=2e-3)


@given(st.lists(st.integers(0, 8), min_size=1, max_size=6, unique=True), st.randoms(use_true_random=False))
@settings(max_examples=10)
def test_votes_are_additive_and_retracted_bit_for_bit(kept: list[int], random: object) -> None:
    views = clean_views(9)
    kinds = [blurred(v, i) if i % 3 == 0 else partial(v, i % 4) if i % 3 == 1 else v for i, v in enumerate(views)]
    one, two = VoteLearner(SCENE, NUM_CLASSES), VoteLearner(SCENE, NUM_CLASSES)
    order = list(range(9))
    random.shuffle(order)  # type: ignore[attr-defined]
    for i in order:
        one.observe(kinds[i])
    for i in sorted(set(order) - set(kept)):
        one.retract(kinds[i].name)
    for i in kept:
        two.observe(kinds[i])
    np.testing.assert_array_equal(one._votes.dense(), two._votes.dense())


@pytest.mark.parametrize("name", LEARNERS)
def test_other_numbers_for_the_objects_change_nothing(name: str) -> None:
    order = np.array([0, 3, 1, 2])
    base = clean_views(5)
    one = [partial(v, 1 + i % 3, 1 + (i + 1) % 3) if i % 2 else blurred(v, i) for i, v in enumerate(base)]
    two = []
    for view in one:
        seen = view.read_seen()
        assert seen.evidence is not None
        ids = order[seen.evidence.classes]
        looked_for = seen.evidence.supervised
        evidence = LabelEvidence(
            np.sort(ids).astype(np.int32),
            seen.evidence.mass[:, np.argsort(ids)],  # type: ignore[index]
            None if looked_for is None else np.sort(order[looked_for]).astype(np.int32),
        )
        two.append(View.from_seen(view.camera, SeenLabels(seen.labels, evidence)))
    a, b = learnt(name, one), learnt(name, two)
    np.testing.assert_allclose(a.codes_, b.codes_[:, order], atol=2e-3)


@pytest.mark.parametrize("name", LEARNERS)
def test_a_class_that_no_mask_looks_for_never_becomes_background(name: str) -> None:
    """Class 3 has no detector. That others found nothing makes nothing background, there or elsewhere."""
    views = [partial(view, 1 + i % 2) for i, view in enumerate(clean_views(6))]
    learner = learnt(name, views)
    labels = np.where(learner.observed_, learner.codes_.argmax(axis=1), UNKNOWN)
    assert not (labels == 0).any()
    assert (labels[TRUTH == 1] == 1).mean() > 0.5 and (labels[TRUTH == 2] == 2).mean() > 0.5
    assert not np.isin(labels[TRUTH == 3], [1, 2]).mean() > 0.25


@pytest.mark.parametrize("name", LEARNERS)
def test_background_is_what_every_detector_denies(name: str) -> None:
    views = [partial(view, 1 + i % 3) for i, view in enumerate(clean_views(12))]
    learner = learnt(name, views)
    labels = np.where(learner.observed_, learner.codes_.argmax(axis=1), UNKNOWN)
    known = labels >= 0
    assert known[TRUTH == 0].mean() > 0.9 and (labels == TRUTH)[known].mean() > 0.93


@pytest.mark.parametrize("name", ["em", "votes"])
def test_partial_masks_learn_far_better_than_absence_taken_for_background(name: str) -> None:
    views = clean_views(12)
    told = learnt(name, [partial(view, 1 + i % 3) for i, view in enumerate(views)])
    untold = learnt(
        name,
        [View.from_arrays(v.camera, np.where(v.read_labels() == 1 + i % 3, 1 + i % 3, 0)) for i, v in enumerate(views)],
    )
    assert mean_iou(told) > mean_iou(untold) + 0.02
    assert mean_iou(told) > mean_iou(learnt(name, views)) - 0.08


def test_em_goes_on_with_partial_masks_until_no_step_changes_labels() -> None:
    """Few of their pixels name a class, so that each step gains little of a lot."""
    views = [partial(view, 1 + i % 3) for i, view in enumerate(wrong_views(12))]
    stopped, settled = (
        taught(EMLearner(SCENE, NUM_CLASSES, settings), views).fit().codes_.argmax(axis=1)
        for settings in (EMSettings(), EMSettings(tolerance=1e-3, max_steps=60))
    )
    assert (stopped != settled).mean() < 0.01


def test_honest_doubt_teaches_more_than_its_argmax() -> None:
    """A quarter of the objects get a wrong first choice; the segmenter says how sure it is of it."""
    rng, soft, hard = np.random.default_rng(0), [], []
    for view in clean_views(4):
        truth, chances = one_hot(view), np.zeros((NUM_CLASSES, 48, 64))
        chances[0] = truth[0]
        for k in range(1, NUM_CLASSES):
            other, sure = rng.choice([j for j in range(NUM_CLASSES) if j != k]), rng.uniform(0.5, 1)
            right = rng.random() < sure
            chances[k] += truth[k] * (sure if right else 1 - sure)
            chances[other] += truth[k] * (1 - sure if right else sure)
        soft.append(View.from_probabilities(view.camera, chances))
        hard.append(View.from_arrays(view.camera, chances.argmax(axis=0)))
    assert mean_iou(learnt("votes", soft)) > mean_iou(learnt("votes", hard)) + 0.05
    trusting = EMSettings(errors=False)
    told, untold = (taught(EMLearner(SCENE, NUM_CLASSES, trusting), views).fit() for views in (soft, hard))
    assert mean_iou(told) > mean_iou(untold) + 0.1


def test_em_steps_never_make_the_objective_smaller() -> None:
    views = [partial(v, 1, 2) if i % 2 else blurred(v, i) for i, v in enumerate(wrong_views(6))]
    learner = taught(EMLearner(SCENE, NUM_CLASSES, EMSettings(max_steps=12, tolerance=0.0, refits=0)), views).fit()
    assert (np.diff(learner.history_) > -1e-6).all()


def test_error_models_of_partial_masks_take_none_of_these_for_the_right_word() -> None:
    views = [partial(v, 1, 2) for v in clean_views(4)] + clean_views(4, "full", 0.5)
    learner = taught(EMLearner(SCENE, NUM_CLASSES), views).fit()
    model = learner.error_models_["view0"]
    assert model.evidence.vocabulary.tolist() == [1, 2, UNKNOWN]
    np.testing.assert_allclose(model.confusion.sum(axis=1), 1, atol=1e-5)
    assert model.confusion[[0, 1, 2, 3], [2, 0, 1, 2]].min() > 0.8
    np.testing.assert_allclose(model.likelihood.sum(axis=1), 1, atol=1e-5)


@given(st.lists(st.lists(st.integers(-3, 3), min_size=5, max_size=5), min_size=1, max_size=8), st.integers(0, 31))
def test_what_stands_of_votes_is_what_a_slow_twin_keeps(rows: list[list[int]], ids: int) -> None:
    possible = np.array([ids >> k & 1 for k in range(5)], bool)
    votes = np.array(rows, np.int64) * possible
    expected = np.maximum(votes, 0)
    if (votes < 0).any():
        for i, row in enumerate(votes):
            free = [k for k in np.flatnonzero(possible) if row[k] == 0]
            if len(free) == 1 and (row < 0).any():
                expected[i, free[0]] = np.abs(row[row != 0]).min()
    np.testing.assert_array_equal(resolved_votes(CSRRows.from_dense(votes), possible).dense(5), expected)


def test_votes_against_what_is_no_class_do_not_make_the_first_of_several_classes_the_only_one_left() -> None:
    against = CSRRows.from_dense(np.array([[0, -2, 0, -3], [0, -2, -4, -3]]))
    found = resolved_votes(against, np.array([True, True, True, False])).dense(4)
    np.testing.assert_array_equal(found, [[0, 0, 0, 0], [2, 0, 0, 0]])


def normalised_votes(votes: np.ndarray, possible: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The slow twin of `vote_shares`, before anything is imputed: shares (N, K), and which rows are left unsure."""
    codes, unsure = np.zeros(votes.shape, np.float32), np.zeros(len(votes), bool)
    for i, row in enumerate(votes):
        positive, free = np.maximum(row, 0), np.flatnonzero((row == 0) & possible)
        if positive.any():
            codes[i] = positive / positive.sum()
        elif row.any():
            unsure[i] = len(free) != 1
            codes[i, free] = len(free) == 1
    return codes, unsure


few_votes = st.lists(st.lists(st.integers(-2, 3), min_size=5, max_size=5), min_size=1, max_size=30)


@given(few_votes, st.integers(0, 31), st.booleans())
def test_shares_of_votes_are_those_of_a_slow_twin_to_the_last_bit(
    drawn: list[list[int]], ids: int, mostly_against: bool
) -> None:
    possible = np.array([ids >> k & 1 for k in range(5)], bool)
    votes = np.array(drawn, np.int64) * possible * 7
    votes = np.minimum(votes, 0) if mostly_against else votes
    rows = CSRRows.from_dense(votes)
    expected, unsure = normalised_votes(votes, possible)
    np.testing.assert_array_equal(is_resolved(rows, possible), expected.any(axis=1))
    if unsure.any():
        codes, where = CSRRows.from_dense(expected), np.flatnonzero(unsure)
        with np.errstate(invalid="ignore"):  # Where nothing at all is possible.
            expected = impute_probabilities(codes, rows, possible, where).dense(5)
    with np.errstate(invalid="ignore"):
        found = vote_shares(rows, possible).dense(5)
    np.testing.assert_array_equal(found, expected)
    total, least = weigh_votes(rows)
    np.testing.assert_array_equal(total, np.abs(votes).sum(axis=1))
    np.testing.assert_array_equal(least, votes.min(axis=1, initial=0))


def test_where_several_classes_are_left_they_share_by_how_frequent_they_are() -> None:
    """Three quarters background: of those that only class 1 was denied, as many are likely to be so."""
    possible = np.ones(3, bool)
    votes = np.array([[0, -2, -2]] * 60 + [[0, 3, -1]] * 10 + [[0, -1, 3]] * 10 + [[0, -1, 0]] * 4 + [[0, 0, 0]])
    codes = np.eye(3, dtype=np.float32)[[0] * 60 + [1] * 10 + [2] * 10 + [0] * 5]
    codes[80:] = 0
    codes = impute_probabilities(
        CSRRows.from_dense(codes), CSRRows.from_dense(votes), possible, np.arange(80, 84)
    ).dense(3)
    np.testing.assert_allclose(codes[80:84, 0] / codes[80:84, 2], 6, rtol=1e-3)
    np.testing.assert_array_equal(codes[80:84, 1], 0)
    np.testing.assert_array_equal(codes[84], 0)


def test_reliability_of_a_partial_mask_counts_only_what_it_says() -> None:
    views = [partial(v, 1, 2) if i % 2 else v for i, v in enumerate(clean_views(6))]
    labels = views[1].read_labels()
    wrong = np.where(labels == 1, 2, np.where(labels == 2, 1, 0))
    views[1] = View.from_arrays(views[1].camera, wrong, supervised=[1, 2])
    learner = taught(EMLearner(SCENE, NUM_CLASSES), views).fit()
    checks = {check.name: check for check in MaskChecker(learner).check_all()}
    assert all(check.reliability > 0.95 for name, check in checks.items() if name != "view1")
    assert checks["view1"].reliability < min(c.reliability for n, c in checks.items() if n != "view1") - 0.02
    called = checks["view3"].counts.dense(len(checks["view3"].classes))[3]
    assert called[-1] > 0.9 * called.sum(), "class 3 is rightly called none of those looked for"
    assert {(k, y) for k, y, _ in checks["view1"].confusions(2)} == {(1, 2), (2, 1)}


def test_live_session_takes_soft_views_back_bit_for_bit_and_saves_them(tmp_path: Path) -> None:
    views = [blurred(v, i) if i % 2 else partial(v, 1, 3) for i, v in enumerate(clean_views(5))]
    session, other = LiveSession(SCENE), LiveSession(SCENE)
    for view in views:
        assert session.fuse(view) is None
    before = session.codes()
    session.save(tmp_path / "state.npz")
    other.load(tmp_path / "state.npz")
    np.testing.assert_array_equal(other.codes(), before)
    assert session.fuse(views[0]) is None, "the same view again replaces itself"
    np.testing.assert_array_equal(session.codes(), before)
    np.testing.assert_array_equal(session.learn("em").learnt.codes.data, other.learn("em").learnt.codes.data)


def test_live_session_refuses_a_class_it_does_not_know_and_stays_as_it_was() -> None:
    session = LiveSession(SCENE, NAMES)
    view = clean_views(1)[0]
    rejection = session.fuse(View.from_detections(view.camera, {9: np.zeros((48, 64), bool)}))
    assert rejection is not None and rejection.reason == "unknown_label" and not session.has_codes
    with pytest.raises(UnknownLabelError, match="label 9"):
        VoteLearner(SCENE, NUM_CLASSES).observe(View.from_detections(view.camera, {9: np.zeros((48, 64), bool)}))


def test_command_line_learns_from_all_kinds_of_masks(tmp_path: Path) -> None:
    data = write_dataset(tmp_path / "data")
    folder = data / "labels"
    views = {view.name: view for view in clean_views(6)}
    np.savez_compressed(folder / "view0.npz", probabilities=one_hot(views["view0"]).astype(np.float16))
    np.savez_compressed(folder / "view1.npz", probabilities=one_hot(views["view1"])[[2, 3]], classes=[2, 3])
    (folder / "view0.png").unlink()
    (folder / "view1.png").unlink()
    (folder / "supervises.json").write_text(json.dumps({"view3": [1, 2, 3]}))
    out = tmp_path / "out"
    command = ["segment", f"{data}/scene.ply", "--data", str(data), "--out", str(out), "--quiet"]
    assert main(command) == 0
    labels = np.load(out / "segmentation.npz")["labels"]
    known = labels >= 0
    assert known.mean() > 0.8 and (labels == TRUTH)[known].mean() > 0.9
    report = json.loads((out / "report.json").read_text())
    assert report["views"]["used"] == 4


def test_command_line_says_in_one_line_what_is_wrong_with_a_soft_mask(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = write_dataset(tmp_path / "data")
    (data / "labels/view0.png").unlink()
    np.savez(data / "labels/view0.npz", probabilities=np.full((NUM_CLASSES, 48, 64), np.nan, np.float32))
    assert main(["segment", f"{data}/scene.ply", "--data", str(data), "--out", f"{tmp_path}/out", "--quiet"]) == 2
    message = capsys.readouterr().err
    assert "view0.npz: probabilities: values are NaN" in message and len(message.strip().splitlines()) == 1
