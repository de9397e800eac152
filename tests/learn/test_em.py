"""EM: the objective never falls, a readable twin agrees, and wrong masks do less harm than to votes."""

from __future__ import annotations

import pickle
from copy import deepcopy
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from operator_cases import lifting
from scipy import ndimage
from small_scenes import (
    NUM_CLASSES,
    balls_on_a_table,
    clean_views,
    look_at,
    many_classes,
    mean_iou,
    taught,
    true_labels,
    with_clutter,
    wrong_views,
)
from threadpoolctl import threadpool_limits

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.view import View
from gsseg_core.errors import SettingsError
from gsseg_core.learn.em.block_weights import block_weights
from gsseg_core.learn.em.confusion_model import PART_PRIOR, ErrorModel
from gsseg_core.learn.em.em_kernels import GRADIENT_UNIT, ViewPairs, accumulate, m_step, predicted_gain
from gsseg_core.learn.em.em_learner import EMLearner, EMSettings, codes_without
from gsseg_core.learn.em.rejected_regions import RIVALLED, SMALLEST
from gsseg_core.learn.vote_learner import VoteLearner
from gsseg_core.raster.backends import make_operator
from gsseg_core.raster.constants import BLOCK
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.spatial.neighbourhood import neighbour_weights

SCENE, TRUTH = balls_on_a_table()


def slow_em(
    scene: GaussianScene, views: list[View], settings: EMSettings, rounds: list[int]
) -> tuple[np.ndarray, list[float], dict[str, np.ndarray]]:
    """Readable twin of `EMLearner.fit`, with W as dense matrices in float64: codes, objectives, confusions R."""
    n, K, o = len(scene), NUM_CLASSES, settings.outliers
    seen, formers, each, whole = [], [], [], []
    words = rejected_regions(scene, views, settings) if settings.errors else [view.read_labels() for view in views]
    for view, word in zip(views, words, strict=True):
        operator, y = make_operator(scene, view.camera), word.ravel()
        W, rest = lifting(operator, scene)
        classes = np.unique(view.read_labels()[view.read_labels() >= 0])
        parts = np.unique(y[y >= K])  # rejected regions, each a word of its own
        onehot = (y[:, None] == np.append(classes, parts)).astype(np.float64)
        known, weights = y >= 0, pixel_weights(view, settings.errors)
        seen.append((W[known], rest[known], onehot[known], classes))
        each.append(weights[known, None])
        # Counts of the error models speak for whole regions, by what was gone through of them.
        regions = slow_regions(view.read_labels())[0] if settings.rejects_regions else view.read_labels()
        area, weighed = (np.bincount(regions.ravel()[known], w) for w in (None, weights[known]))
        whole.append(each[-1] * (area / np.maximum(weighed, 1))[regions.ravel()[known], None])
        formers.append([view.read_labels().ravel()[(y == part).argmax()] for part in parts])

    votes = np.zeros((n, K))
    for W, _, onehot, classes in seen:
        votes[:, classes] += W.T @ onehot[:, : len(classes)]
    distances = np.linalg.norm(scene.means[:, None].astype(np.float64) - scene.means, axis=2)
    np.fill_diagonal(distances, np.inf)
    nearest = np.argsort(distances, axis=1)[:, : settings.prior_k]
    weights = neighbour_weights(votes.any(axis=1), votes.sum(axis=1))[nearest]
    prior = settings.prior_weight * scaled(np.einsum("nj,njk->nk", weights, scaled(votes)[nearest]))
    q = scaled(votes + prior)

    def estimated(v: int, counts: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
        """Confusions of one view from counts of classes and words, with the priors."""
        classes, R = seen[v][3], np.empty_like(counts)
        places = [int(np.flatnonzero(classes == former)[0]) for former in formers[v]]
        named = counts[:, : len(classes)].copy()
        for part, word in enumerate(places, len(classes)):
            named[:, word] += counts[:, part]
        total = named + np.eye(K)[:, classes] * rights[v]
        R[:, : len(classes)] = scaled(total)
        whole = R.copy()
        for part, word in enumerate(places, len(classes)):
            share = counts[:, part].sum() / named[:, word].sum()
            share = (counts[:, part] + PART_PRIOR * share) / (named[:, word] + PART_PRIOR)
            R[:, part] = whole[:, word] * share
            R[:, word] -= R[:, part]
        return np.where(total.any(axis=1, keepdims=True), R, otherwise)

    confusions, rights = [], []
    for v, (W, _, onehot, classes) in enumerate(seen):
        own, others = W.T @ onehot, votes.copy()
        others[:, classes] -= own[:, : len(classes)]
        counts = scaled(scaled(np.maximum(others, 0)) ** settings.majority).T @ own
        rights.append(settings.error_prior * counts[classes].sum(axis=1))
        flat = np.full(counts.shape, 1 / onehot.shape[1])
        confusions.append(estimated(v, counts, flat) if settings.errors else np.eye(K)[:, classes])

    def one_over_p(v: int, codes: np.ndarray) -> np.ndarray:
        W, rest, onehot, _ = seen[v]
        C = (1 - o) * confusions[v] + o / onehot.shape[1]
        p = ((W @ codes + rest[:, None] * np.eye(K)[0]) @ C * onehot).sum(axis=1)
        return onehot / p[:, None]

    objectives, counted = [], prior > 0
    for r, steps in enumerate(rounds):
        for step in range(steps):
            shares = [one_over_p(v, q) for v in range(len(seen))]
            logs = sum((w[:, 0] * np.log(s.max(axis=1))).sum() for w, s in zip(each, shares, strict=True))
            objective = (prior[counted] * np.log(q[counted])).sum() - logs
            objectives.append(objective / sum(len(onehot) for _, _, onehot, _ in seen))
            gradient = [W.T @ (w * s) @ ((1 - o) * R + o / R.shape[1]).T
                     for (W, _, _, _), w, s, R in zip(seen, each, shares, confusions, strict=True)]  # fmt: skip
            if step == steps - 1 and r < len(rounds) - 1:
                for v, (W, rest, _, _) in enumerate(seen):
                    without = scaled(q * (sum(gradient) - gradient[v]) + prior)
                    share = whole[v] * one_over_p(v, without)
                    counts = without.T @ (W.T @ share)
                    counts[0] += rest @ share
                    confusions[v] = estimated(v, (1 - o) * confusions[v] * counts, confusions[v])
            q = scaled(q * sum(gradient) + prior)
    q[~votes.any(axis=1)] = 0
    return q, objectives, {view.name: R for view, R in zip(views, confusions, strict=True)}


def rejected_regions(scene: GaussianScene, views: list[View], settings: EMSettings) -> list[np.ndarray]:
    """Labels of each view with a number of its own, from `NUM_CLASSES` on, for each rejected region."""
    weights, regions, onehots = [], [], []
    for view in views:
        W, labels = lifting(make_operator(scene, view.camera), scene)[0], view.read_labels()
        onehot = (labels.reshape(-1, 1) == np.arange(NUM_CLASSES)).astype(np.float64)
        weights.append(W)
        onehots.append(onehot)
        regions.append(slow_regions(labels))
    insides = [(part.reshape(-1, 1) == np.arange(len(classes))).astype(np.float64) for part, classes in regions]
    doubted = [np.ones(len(classes), bool) for _, classes in regions]
    for without in (False, True):
        said = [onehot * (inside @ ~(without & d))[:, None]
                for onehot, inside, d in zip(onehots, insides, doubted, strict=True)]  # fmt: skip
        votes = [W.T @ one for W, one in zip(weights, said, strict=True)]
        found = []
        for W, own, inside, (_, classes), d in zip(weights, votes, insides, regions, doubted, strict=True):
            counts = scaled(np.maximum(sum(votes) - own, 0)).T @ (W.T @ inside)
            agreed = counts[classes, np.arange(len(classes))]
            asked = np.maximum(counts.sum(axis=0), RIVALLED * counts.max(axis=0))
            found.append(d & (agreed < settings.least_agreement * asked))
        doubted = found
    words = []
    for view, (of_pixel, _), d in zip(views, regions, doubted, strict=True):
        inside = np.isin(of_pixel, np.flatnonzero(d))
        words.append(np.where(inside, NUM_CLASSES + of_pixel, view.read_labels()))
    return words


def pixel_weights(view: View, errors: bool) -> np.ndarray:
    """By how much each pixel of a mask counts in the steps, (H W,)."""
    labels = view.read_labels()
    if not errors:
        return np.ones(labels.size)
    blocks = block_weights(labels, labels).astype(np.float64)
    return np.kron(blocks, np.ones((BLOCK, BLOCK)))[: labels.shape[0], : labels.shape[1]].ravel()


def slow_regions(
    labels: np.ndarray,  # (H, W)
) -> tuple[np.ndarray, list[int]]:
    """Number the regions of a mask, (H, W), and tell the class of each; small ones of a class are one."""
    regions, classes = np.full(labels.shape, -1), []
    for k in np.unique(labels[labels >= 0]).tolist():
        parts, count = ndimage.label(labels == k)
        alone = [part for part in range(1, count + 1) if (parts == part).sum() >= SMALLEST]
        for part in alone:
            regions[parts == part] = len(classes)
            classes.append(k)
        rest = (parts > 0) & ~np.isin(parts, alone)
        if rest.any():
            regions[rest] = len(classes)
            classes.append(k)
    return regions, classes


def scaled(rows: np.ndarray, otherwise: np.ndarray | float = 0.0) -> np.ndarray:
    """Rows that sum to 1, or something else where they are zero."""
    total = rows.sum(axis=1, keepdims=True)
    return np.where(total > 0, rows / np.where(total > 0, total, 1), otherwise)


@pytest.mark.parametrize(
    ("changes", "rounds"),
    [
        ({"max_steps": 1, "tolerance": 0.0}, [1]),
        ({"max_steps": 4, "tolerance": 0.0}, [4]),
        ({"max_steps": 4, "tolerance": 0.0, "errors": False}, [4]),
        ({"max_steps": 9, "tolerance": 0.001, "errors": False}, [3]),
        ({"max_steps": 9, "tolerance": 0.0005}, [3, 2]),
        ({"max_steps": 9, "tolerance": 1e9}, [1, 1]),
        ({"max_steps": 9, "tolerance": 1e9, "refits": 2}, [1, 1, 1]),
        ({"max_steps": 9, "tolerance": 1e9, "least_agreement": 0.0}, [1, 1]),
        ({"max_steps": 9, "tolerance": 1e9, "majority": 1.0}, [1, 1]),
    ],
)
def test_steps_agree_with_a_slow_twin_written_from_the_equations(changes: dict[str, Any], rounds: list[int]) -> None:
    views = wrong_views(4, seed=3)
    labels = views[0].read_labels()
    labels[:10] = -1
    views[0] = View.from_arrays(views[0].camera, labels)
    views[1] = with_clutter(views[1])
    settings = EMSettings(**changes, prior_k=9)
    learner = taught(EMLearner(SCENE, NUM_CLASSES, settings), views).fit()
    assert learner.rounds_ == rounds
    rejects = settings.errors and settings.least_agreement > 0
    assert (learner.rejected_share(views[1]) > 0) == rejects
    codes, objectives, confusions = slow_em(SCENE, views, settings, rounds)
    # Where a Gaussian shows in a trace of a pixel only, its votes are rounded to whole units.
    firm = learner._votes.dense().sum(axis=1) > 2**14
    np.testing.assert_allclose(learner.codes_[firm], codes[firm], atol=2e-3)
    np.testing.assert_allclose(learner.history_, objectives, rtol=1e-4)
    for name, confusion in confusions.items():
        np.testing.assert_allclose(learner.error_models_[name].confusion, confusion, atol=2e-3)


@pytest.mark.parametrize("errors", [True, False])
@pytest.mark.parametrize("seed", range(3))
def test_the_objective_never_falls(seed: int, errors: bool) -> None:
    views = wrong_views(6, seed=seed, missed=0.1 * seed, swapped=0.2)
    settings = EMSettings(max_steps=40, tolerance=0.0, errors=errors)
    history = np.array(taught(EMLearner(SCENE, NUM_CLASSES, settings), views).fit().history_)
    assert len(history) >= 2
    assert (np.diff(history) >= -1e-6 * np.abs(history[1:])).all()


@pytest.mark.parametrize("views", [clean_views(5), wrong_views(5)], ids=["clean", "wrong"])
def test_it_stops_by_itself(views: list[View]) -> None:
    learner = taught(EMLearner(SCENE, NUM_CLASSES, EMSettings(max_steps=500)), views).fit()
    steps = len(learner.history_)
    assert learner.converged_ and 2 <= steps < 100
    assert not taught(EMLearner(SCENE, NUM_CLASSES, EMSettings(max_steps=steps - 1)), views).fit().converged_


def first_models(learner: EMLearner, votes: CSRRows, rejects: bool = True) -> dict[str, ErrorModel]:
    """Error models by the votes of the other views, without those for labels that are rejected."""
    rejected = learner._reject_regions(votes, lambda: None)[1] if rejects else dict.fromkeys(learner.views)
    return learner._initial_error_models(votes, rejected, lambda: None)[1]


def test_no_step_gains_more_than_its_slope_promises() -> None:
    learner = taught(EMLearner(SCENE, NUM_CLASSES), wrong_views(4))
    votes = learner._votes.rows()
    models = first_models(learner, votes, rejects=False)
    codes, prior = votes.with_data(votes.data.astype(np.float32)).normalised(), np.full(len(votes.data), 0.1)

    def look() -> tuple[np.ndarray, float]:
        gradient, counted = learner._e_step(codes, models, lambda: None)
        return gradient, sum(counted.values()) + (prior * np.log(codes.data.astype(np.float64))).sum()

    gradient, objective = look()
    slopes, gained = [], []
    for _ in range(6):
        before = codes.data.astype(np.float64)
        slopes.append(predicted_gain(codes, gradient, prior.astype(np.float32)))
        m_step(codes, gradient, prior.astype(np.float32))
        gradient = gradient * GRADIENT_UNIT + prior / before
        np.testing.assert_allclose(slopes[-1], gradient @ (codes.data - before), rtol=1e-3)
        gradient, after = look()
        gained.append(after - objective)
        objective = after
    assert (np.array(gained) > 0).all() and (np.array(gained) < slopes).all()
    assert slopes[-1] < slopes[0] / 10


def test_with_wrong_masks_em_is_ahead_of_votes() -> None:
    scores = []
    for seed in range(3):
        views = wrong_views(10, seed=seed, missed=0.2, swapped=0.15)
        em = taught(EMLearner(SCENE, NUM_CLASSES), views).fit()
        scores.append([mean_iou(em), mean_iou(taught(VoteLearner(SCENE, NUM_CLASSES), views).fit())])
    em, votes = np.mean(scores, axis=0)
    assert em > votes and em > 0.9


def test_the_error_model_tells_which_object_was_swapped_in_which_view() -> None:
    views = clean_views(6)
    labels = views[2].read_labels()
    views[2] = View.from_arrays(views[2].camera, np.where(labels == 1, 3, labels))
    models = taught(EMLearner(SCENE, NUM_CLASSES, EMSettings(least_agreement=0)), views).fit().error_models_
    assert set(models) == {view.name for view in views}
    for view in views:
        model = models[view.name]
        np.testing.assert_allclose(model.confusion.sum(axis=1), 1, atol=1e-5)
        seen_as = model.evidence.vocabulary[model.confusion[1].argmax()]
        assert seen_as == (3 if view is views[2] else 1)
        assert model.evidence.vocabulary[model.confusion[2].argmax()] == 2


def test_error_models_hold_what_their_views_show_however_many_classes_there_are() -> None:
    few, many = (taught(EMLearner(SCENE, count), clean_views(4)).fit() for count in (NUM_CLASSES, 20_000))
    for name, model in many.error_models_.items():
        assert len(pickle.dumps(model)) < 10_000, "a row of each class would take 400 kB"
        np.testing.assert_array_equal(model.confusion[:NUM_CLASSES], few.error_models_[name].confusion)
        assert model.confusion.shape[0] == 20_000 and np.ptp(model.confusion[NUM_CLASSES:]) == 0
    np.testing.assert_array_equal(many.codes_[:, :NUM_CLASSES], few.codes_)


def test_without_the_error_model_every_mask_is_taken_at_its_word() -> None:
    learner = taught(EMLearner(SCENE, NUM_CLASSES, EMSettings(errors=False)), wrong_views(4)).fit()
    for model in learner.error_models_.values():
        np.testing.assert_array_equal(model.confusion, np.eye(NUM_CLASSES)[:, model.evidence.vocabulary])


def test_the_order_of_the_gaussians_does_not_matter() -> None:
    order = np.random.default_rng(0).permutation(len(SCENE))
    views = wrong_views(4)
    one = taught(EMLearner(SCENE, NUM_CLASSES), views).fit()
    two = taught(EMLearner(SCENE.subset(order), NUM_CLASSES), views).fit()
    np.testing.assert_allclose(two.codes_, one.codes_[order], atol=1e-3)
    np.testing.assert_array_equal(two.observed_, one.observed_[order])


@settings(max_examples=10)
@given(groups=st.lists(st.integers(0, 2), min_size=6, max_size=6), order=st.permutations(range(6)))
def test_sums_over_views_do_not_depend_on_order_or_grouping(groups: list[int], order: list[int]) -> None:
    learner = taught(EMLearner(SCENE, NUM_CLASSES), [with_clutter(view) for view in wrong_views(6)])
    codes, names = CSRRows.from_dense(learner.vote_codes() + np.float32(0.01)), list(learner.views)
    votes = learner._votes.rows()
    models = first_models(learner, votes)
    whole, counted = learner._e_step(codes, deepcopy(models), lambda: None)
    parts = np.zeros_like(whole)
    for group in set(groups):
        chosen = {names[i]: deepcopy(models[names[i]]) for i in order if groups[i] == group}
        gradient, part_counted = learner._e_step(codes, chosen, lambda: None)
        parts += gradient
        assert part_counted == {name: counted[name] for name in chosen}
    np.testing.assert_array_equal(parts, whole)


def test_codes_without_a_view_are_a_step_with_the_gains_of_all_the_others() -> None:
    learner = taught(EMLearner(SCENE, NUM_CLASSES), [with_clutter(view) for view in wrong_views(4)])
    codes = CSRRows.from_dense(learner.vote_codes() + np.float32(0.01))
    prior = np.random.default_rng(0).uniform(0, 3, len(codes.data)).astype(np.float32)
    votes = learner._votes.rows()
    models = first_models(learner, votes)
    gradient, _ = learner._e_step(codes, models, lambda: None)
    for name in learner.views:
        observation = learner.observation(name)
        others, _ = learner._e_step(codes, {other: models[other] for other in models if other != name}, lambda: None)
        expected = codes.with_data(codes.data.copy())
        m_step(expected, others, prior)
        seen = expected.take(observation.ids)
        found = codes_without(observation, models[name], codes, gradient, prior)
        np.testing.assert_array_equal(found.indptr, seen.indptr)
        np.testing.assert_array_equal(found.indices, seen.indices)
        np.testing.assert_array_equal(found.data, seen.data)


def test_what_was_all_but_ruled_out_does_not_overflow_the_sums() -> None:
    codes = CSRRows(np.array([0, 2]), np.array([0, 1], np.uint32), np.full(2, 0.5, np.float32))
    gradient, one = np.zeros(2, np.int64), np.zeros(1, np.int32)
    pairs = ViewPairs(one, start=np.array([0, 1]), labels=one)
    share, likelihood = np.array([1e30], np.float32), np.array([[1.0, 1e-30]], np.float32)
    for _ in range(255):
        accumulate(codes.with_data(gradient), pairs, likelihood, share)
    np.testing.assert_allclose(gradient * GRADIENT_UNIT, [255 * 2.0**27, 255.0], rtol=1e-6)
    m_step(codes, gradient, np.zeros(2, np.float32))
    np.testing.assert_allclose(codes.data, [1.0, 0.0], atol=1e-6)


def test_the_number_of_threads_does_not_matter_not_even_to_the_last_bit() -> None:
    scene, truth = many_classes(300)
    cameras = [look_at(f"v{i}", np.array([0.2 * i, 0.1, 3.5]), 320, 240, 330.0) for i in range(3)]
    views = [View.from_arrays(camera, true_labels(scene, truth, camera)) for camera in cameras]
    fits = []
    for threads in (1, 2):
        with threadpool_limits(threads):
            fits.append(taught(EMLearner(scene, 300), views).fit())
    np.testing.assert_array_equal(fits[0].codes_, fits[1].codes_)
    assert fits[0].history_ == fits[1].history_


def test_fitting_twice_gives_the_same_bits() -> None:
    learner = taught(EMLearner(SCENE, NUM_CLASSES), wrong_views(4))
    first = learner.fit().codes_.copy()
    np.testing.assert_array_equal(learner.fit().codes_, first)


@pytest.mark.parametrize(
    "wrong",
    [{"max_steps": 0}, {"prior_k": 0}, {"outliers": 0.0}, {"outliers": 1.0}, {"tolerance": -1.0},
     {"error_prior": -0.1}, {"prior_weight": -1.0}, {"max_steps": 2.5}, {"edge_px": 1.5}, {"tolerance": np.nan},
     {"majority": np.nan}, {"prior_weight": np.inf}],
)  # fmt: skip
def test_settings_out_of_range_are_refused_by_name(wrong: dict[str, float]) -> None:
    with pytest.raises(SettingsError, match=f"em: .*{next(iter(wrong))}.*expected"):
        EMSettings(**wrong)  # type: ignore[arg-type]
