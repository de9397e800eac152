"""What all learners promise: the same face, exact votes, views that come, go and are refused."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from operator_cases import lifting
from small_scenes import NAMES, NUM_CLASSES, OUT_OF_SIGHT, balls_on_a_table, clean_views, look_at, mean_iou, taught

from gsseg_core.data.label_evidence import VOTE_UNIT
from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.data.soft_masks import SeenLabels
from gsseg_core.data.view import View
from gsseg_core.errors import MaskSizeError, NoUsableViewsError, SettingsError, StateMismatchError, UnknownLabelError
from gsseg_core.learn.em import em_learner, spatial_prior
from gsseg_core.learn.em.em_learner import EMLearner, EMSettings
from gsseg_core.learn.gradient_learner import GradientLearner
from gsseg_core.learn.learner import Learner
from gsseg_core.learn.mask_reliability import MaskChecker
from gsseg_core.learn.vote_learner import VoteLearner
from gsseg_core.raster.backends import make_operator
from gsseg_core.refine.settings import UNREFINED, RefineSettings
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import UNOBSERVED, Segmentation

LEARNERS = [VoteLearner, EMLearner, GradientLearner]
SCENE, TRUTH = balls_on_a_table()
VIEWS = clean_views(5)

every_learner = pytest.mark.parametrize("kind", LEARNERS)


@every_learner
def test_every_learner_recovers_the_objects_from_clean_masks(kind: type[Learner]) -> None:
    learner = taught(kind(SCENE, NUM_CLASSES), VIEWS)
    assert learner.fit() is learner
    codes, observed = learner.codes_, learner.observed_
    assert codes.shape == (len(SCENE), NUM_CLASSES) and codes.dtype == np.float32
    assert observed.shape == (len(SCENE),) and observed.dtype == bool
    assert (codes >= 0).all()
    np.testing.assert_allclose(codes.sum(axis=1), observed, atol=1e-5)
    assert list(learner.views) == [view.name for view in VIEWS] and learner.rejected == {}
    assert isinstance(learner.history_, list) and np.isfinite(learner.history_).all()
    assert mean_iou(learner) > (0.93 if kind is VoteLearner else 0.95)


@every_learner
def test_what_no_view_sees_is_unobserved_until_its_neighbours_fill_it_in(kind: type[Learner]) -> None:
    learner = taught(kind(SCENE, NUM_CLASSES), VIEWS).fit()
    assert not learner.observed_[-OUT_OF_SIGHT:].any() and not learner.codes_[-OUT_OF_SIGHT:].any()
    raw = Segmentation.from_codes(SCENE, learner.codes_, NAMES, UNREFINED)
    np.testing.assert_array_equal(raw.labels == UNOBSERVED, ~learner.observed_)
    filled = Segmentation.from_codes(SCENE, learner.codes_, NAMES, RefineSettings())
    assert (filled.labels >= 0).all() and filled.clustered[-OUT_OF_SIGHT:].all()


def test_votes_of_classes_that_are_no_more_are_gone_and_the_others_stay() -> None:
    learner = taught(VoteLearner(SCENE, NUM_CLASSES), VIEWS)
    before = learner._votes.dense()
    learner.resize(NUM_CLASSES + 2)
    assert learner._votes.shape == (len(SCENE), NUM_CLASSES + 2) and not learner._votes.dense()[:, NUM_CLASSES:].any()
    learner.resize(NUM_CLASSES)
    np.testing.assert_array_equal(learner._votes.dense(), before)
    assert learner.num_classes == NUM_CLASSES


@pytest.mark.parametrize("memory_budget", [None, 0])
def test_no_class_goes_that_a_view_shows_and_its_votes_can_be_taken_back(memory_budget: int | None) -> None:
    learner = taught(VoteLearner(SCENE, NUM_CLASSES, memory_budget=memory_budget), VIEWS)
    before = learner._votes.dense()
    message = f"num_classes is {NUM_CLASSES - 1}; expected more than {NUM_CLASSES - 1}, which a view shows"
    with pytest.raises(SettingsError, match=message):
        learner.resize(NUM_CLASSES - 1)
    assert learner.num_classes == NUM_CLASSES
    np.testing.assert_array_equal(learner._votes.dense(), before)
    for view in VIEWS:
        learner.retract(view.name)
    assert not learner._votes.dense().any()
    learner.resize(1)


def test_a_view_that_cannot_be_moved_keeps_its_votes_and_its_camera() -> None:
    learner = taught(VoteLearner(SCENE, NUM_CLASSES), VIEWS)
    before, view = learner._votes.dense(), VIEWS[0]
    with pytest.raises(MaskSizeError):
        learner.move(view.name, replace(view.camera, width=view.camera.width - 1))
    np.testing.assert_array_equal(learner._votes.dense(), before)
    assert learner.views[view.name] is view


@pytest.mark.parametrize("memory_budget", [None, 0])
def test_a_view_with_other_labels_has_their_votes_and_no_others(memory_budget: int | None) -> None:
    others = [View.from_arrays(view.camera, np.roll(view.read_labels(), 9, axis=1)) for view in VIEWS[:2]]
    learner, expected = (
        taught(VoteLearner(SCENE, NUM_CLASSES, memory_budget=memory_budget), views)
        for views in (VIEWS, [*others, *VIEWS[2:]])
    )
    for view in others:
        learner.relabel(view)
    np.testing.assert_array_equal(learner._votes.dense(), expected._votes.dense())
    np.testing.assert_array_equal(learner.fit().codes_, expected.fit().codes_)
    assert list(learner.views) == [view.name for view in VIEWS]
    before = learner._votes.dense()
    for mask in (np.full((48, 64), NUM_CLASSES, np.int32), np.zeros((48, 63), np.int32)):
        with pytest.raises((UnknownLabelError, MaskSizeError)):
            learner.relabel(View.from_arrays(VIEWS[0].camera, mask))
    np.testing.assert_array_equal(learner._votes.dense(), before)
    assert learner.views[VIEWS[0].name] is others[0]


def test_a_view_keeps_its_votes_where_there_is_no_memory_to_take_them_back(monkeypatch: pytest.MonkeyPatch) -> None:
    learner, lift = taught(VoteLearner(SCENE, NUM_CLASSES), VIEWS), VoteLearner._lift
    before, view = learner._votes.dense(), VIEWS[0]

    def starved(self: VoteLearner, given: View, *rest: Any) -> bool:
        if given is view:
            raise MemoryError
        return lift(self, given, *rest)

    monkeypatch.setattr(VoteLearner, "_lift", starved)
    other = View.from_arrays(view.camera, np.roll(view.read_labels(), 9, axis=1))
    nearer = replace(view.camera, K=view.camera.K * [[1.1], [1.1], [1]])
    for change in (lambda: learner.relabel(other), lambda: learner.move(view.name, nearer)):
        with pytest.raises(MemoryError):
            change()
        np.testing.assert_array_equal(learner._votes.dense(), before)
        assert learner.views[view.name] is view


@pytest.mark.parametrize("weight", [0.0, 3.0])
def test_neighbours_are_looked_for_beside_a_gpu_if_the_prior_asks_for_them(
    weight: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    @contextmanager
    def at_once(work: Callable[[], object], device: str) -> Iterator[None]:
        work()
        yield

    found: list[object] = []
    monkeypatch.setattr(em_learner, "meanwhile", at_once)
    monkeypatch.setattr(em_learner, "find_neighbours", lambda scene, k: found.append(scene))
    if not weight:
        monkeypatch.setattr(spatial_prior, "neighbours_of", lambda *_: pytest.fail("a tree was built"))
    taught(EMLearner(SCENE, NUM_CLASSES, EMSettings(max_steps=1, prior_weight=weight)), VIEWS[:2]).fit()
    assert len(found) == (weight > 0)


@pytest.mark.parametrize("budget", [0, 1, 1 << 30])
def test_views_that_are_worked_on_several_at_once_give_the_same_results(
    budget: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera = replace(VIEWS[0].camera, name="blank")
    blank = View.from_seen(camera, SeenLabels(np.full((camera.height, camera.width), UNKNOWN, np.int32)))
    views = [*VIEWS[:2], blank, *VIEWS[2:]]
    alone = EMLearner(SCENE, NUM_CLASSES)
    for view in views:
        alone.observe(view)
    monkeypatch.setattr("gsseg_core.several_at_once.numba.get_num_threads", lambda: 2)
    together = EMLearner(SCENE, NUM_CLASSES, memory_budget=budget)
    together.observe_all(views)
    assert list(together.views) == list(alone.views) and together.rejected == alone.rejected != {}
    np.testing.assert_array_equal(together.fit().codes_, alone.fit().codes_)
    assert list(together.error_models_) == list(alone.error_models_) and together.history_ == alone.history_
    for one, other in zip(MaskChecker(together).check_all(), MaskChecker(alone).check_all(), strict=True):
        assert one.name == other.name
        for counts in zip(one.counts, other.counts, strict=True):
            np.testing.assert_array_equal(*counts)


@every_learner
def test_the_order_of_the_views_and_the_memory_budget_do_not_matter(kind: type[Learner]) -> None:
    if kind is GradientLearner:
        one, two = (taught(kind(SCENE, NUM_CLASSES, memory_budget=b), VIEWS).fit() for b in (0, 1 << 30))
        np.testing.assert_array_equal(one.codes_, two.codes_)
        return
    one = taught(kind(SCENE, NUM_CLASSES), VIEWS).fit()
    two = taught(kind(SCENE, NUM_CLASSES, memory_budget=0), VIEWS[::-1]).fit()
    np.testing.assert_allclose(one.codes_, two.codes_, atol=1e-4)


def test_votes_are_the_sum_over_views_of_what_the_masks_lift() -> None:
    learner = taught(VoteLearner(SCENE, NUM_CLASSES), VIEWS).fit()
    onehot = np.eye(NUM_CLASSES, dtype=np.float32)
    expected = sum(
        lifting(make_operator(SCENE, view.camera), SCENE)[0].T @ onehot[view.read_labels().ravel()] for view in VIEWS
    )
    np.testing.assert_allclose(learner._votes.dense() * VOTE_UNIT, expected, rtol=1e-4, atol=1e-5)
    seen = expected.sum(axis=1) > 1e-4
    share = expected[seen] / expected[seen].sum(axis=1, keepdims=True)
    np.testing.assert_allclose(learner.codes_[seen], share, atol=1e-3)


@settings(max_examples=15)
@given(order=st.permutations(range(5)), taken=st.sets(st.integers(0, 4)))
def test_views_taken_back_leave_no_trace_whatever_the_order(order: list[int], taken: set[int]) -> None:
    learner = VoteLearner(SCENE, NUM_CLASSES)
    for i in order:
        learner.observe(VIEWS[i])
    for i in sorted(taken):
        learner.retract(VIEWS[i].name)
    fresh = taught(VoteLearner(SCENE, NUM_CLASSES), [view for i, view in enumerate(VIEWS) if i not in taken])
    np.testing.assert_array_equal(learner._votes.dense(), fresh._votes.dense())
    assert set(learner.views) == set(fresh.views)
    if fresh.views:
        np.testing.assert_array_equal(learner.fit().codes_, fresh.fit().codes_)


@pytest.mark.parametrize("budget", [0, 1 << 30])
def test_a_view_of_the_same_name_replaces_the_earlier_one(budget: int) -> None:
    learner = taught(VoteLearner(SCENE, NUM_CLASSES, memory_budget=budget), VIEWS)
    other = View.from_arrays(VIEWS[1].camera, np.full_like(VIEWS[1].read_labels(), 3))
    taught(learner, [other])
    fresh = taught(VoteLearner(SCENE, NUM_CLASSES), [VIEWS[0], other, *VIEWS[2:]])
    np.testing.assert_array_equal(learner._votes.dense(), fresh._votes.dense())
    assert len(learner.views) == 5


@pytest.mark.parametrize("kind", [EMLearner, GradientLearner])
def test_a_fit_that_is_stopped_leaves_what_was_fitted_before_it(kind: type[Learner]) -> None:
    learner = taught(kind(SCENE, NUM_CLASSES), VIEWS[:3])

    def stop(stage: str, done: int, total: int) -> None:
        if done == 1:
            raise InterruptedError(stage)

    with pytest.raises(InterruptedError):
        learner.fit(stop)
    assert not learner.history_ and not learner.converged_ and not hasattr(learner, "observed_")
    learner.fit()
    before, told = vars(learner).copy(), learner.predict_without(VIEWS[0])
    learner.observe(VIEWS[3])
    with pytest.raises(InterruptedError):
        learner.fit(stop)
    assert all(vars(learner)[name] is value for name, value in before.items() if name.endswith("_"))
    np.testing.assert_array_equal(learner.predict_without(VIEWS[0]), told)
    again = taught(kind(SCENE, NUM_CLASSES), VIEWS[:4]).fit()
    np.testing.assert_array_equal(learner.fit().codes_, again.codes_)


@pytest.mark.parametrize("kind", [EMLearner, VoteLearner])
def test_what_was_not_learnt_from_is_one_clear_error_to_predict_without(kind: type[Learner]) -> None:
    learner = taught(kind(SCENE, NUM_CLASSES), VIEWS[:3])
    if kind is EMLearner:
        with pytest.raises(SettingsError, match="view 'view0' was not learnt from"):
            learner.predict_without(VIEWS[0])
    learner.fit()
    with pytest.raises(SettingsError, match="view 'view4' was not"):
        learner.predict_without(VIEWS[4])
    learner.retract(VIEWS[0].name)
    with pytest.raises(SettingsError, match="view 'view0' was not"):
        learner.predict_without(VIEWS[0])


def test_a_mask_that_came_after_the_fit_has_no_part_in_what_was_fitted_under_its_name() -> None:
    plain = View.from_arrays(VIEWS[0].camera, np.zeros_like(VIEWS[0].read_labels()))
    learner = taught(EMLearner(SCENE, NUM_CLASSES), [plain, *VIEWS[1:3]]).fit()
    learner.observe(VIEWS[0])
    for ask in (learner.predict_without, learner.strongest_without, learner.rejected_share):
        with pytest.raises(SettingsError, match="view 'view0' was not learnt from"):
            ask(VIEWS[0])
    learner.predict_without(VIEWS[1])


@pytest.mark.parametrize("kind", [EMLearner, GradientLearner])
def test_what_was_fitted_to_views_or_classes_that_are_gone_predicts_nothing(kind: type[Learner]) -> None:
    """Two classes, where four were fitted: what is predicted of masks was counted beyond the table of the two."""
    two = [View.from_arrays(view.camera, view.read_labels().clip(max=1)) for view in VIEWS]
    another = taught(kind(SCENE, NUM_CLASSES), VIEWS).fit()
    another.adopt(taught(kind(SCENE, 2), two).state())
    fewer = taught(kind(SCENE, NUM_CLASSES), [*two[:4], VIEWS[4]]).fit()
    fewer.retract(VIEWS[4].name)
    fewer.resize(2)
    for learner in (another, fewer):
        assert not hasattr(learner, "codes_") and learner.history_ == []
        with pytest.raises(SettingsError, match=r"view 'view0' was not learnt from; expected .* fit\(\)"):
            MaskChecker(learner).check_all()
        assert min(check.reliability for check in MaskChecker(learner.fit()).check_all()) > 0.9


@pytest.mark.parametrize("budget", [0, 1 << 30])
@every_learner
def test_views_that_cannot_be_used_are_counted_by_reason_and_change_nothing(kind: type[Learner], budget: int) -> None:
    learner = taught(kind(SCENE, NUM_CLASSES, memory_budget=budget), VIEWS[:2])
    before = learner._votes.dense()
    unknown = np.full((48, 64), -1, np.int32)
    away = look_at("away", np.array([0.0, 500.0, 300.0]))
    turned = np.diag([-1.0, 1, -1, 1]) @ away.world_to_camera
    blind = View.from_arrays(type(away)("blind", 64, 48, away.K, turned), np.ones((48, 64), np.int32))
    useless = [
        View(VIEWS[2].camera),
        View(VIEWS[3].camera),
        View.from_arrays(VIEWS[4].camera, unknown),
        View.from_arrays(VIEWS[0].camera, unknown),
        blind,
    ]
    assert not any(learner.observe(view) for view in useless)
    assert learner.reject_summary() == {"no mask": 2, "all pixels unknown": 2, "sees no Gaussian": 1}
    assert set(learner.rejected) == {view.name for view in useless}
    np.testing.assert_array_equal(learner._votes.dense(), before)
    assert list(learner.views) == [VIEWS[0].name, VIEWS[1].name]
    assert learner.observe(VIEWS[2]) and VIEWS[2].name not in learner.rejected


@every_learner
def test_no_view_left_is_one_clear_error_that_names_the_reasons(kind: type[Learner]) -> None:
    learner = kind(SCENE, NUM_CLASSES)
    with pytest.raises(NoUsableViewsError, match="none was given"):
        learner.fit()
    learner.observe(View(VIEWS[0].camera))
    learner.observe(View(VIEWS[1].camera))
    with pytest.raises(NoUsableViewsError, match=r"no view to learn from \(no mask: 2 views\); expected"):
        learner.fit()
    learner.observe(VIEWS[2])
    learner.retract(VIEWS[2].name)
    with pytest.raises(NoUsableViewsError):
        learner.fit()


def test_a_label_beyond_the_classes_is_refused_and_changes_nothing() -> None:
    learner = taught(VoteLearner(SCENE, 3), [View.from_arrays(VIEWS[0].camera, np.zeros((48, 64), np.int32))])
    before = learner._votes.dense()
    with pytest.raises(UnknownLabelError, match="label 3; expected at most 2"):
        learner.observe(VIEWS[1])
    np.testing.assert_array_equal(learner._votes.dense(), before)
    with pytest.raises(MaskSizeError):
        View.from_arrays(VIEWS[1].camera, np.zeros((4, 4), np.int32))


def test_impossible_requests_are_refused() -> None:
    for count in (0, 4.0, 65536, 10**12):  # Memory for so many votes there is nowhere.
        with pytest.raises(SettingsError, match=rf"num_classes is {count}; expected a whole number from 1 to 65535"):
            VoteLearner(SCENE, count)  # type: ignore[arg-type]
        with pytest.raises(SettingsError, match=rf"num_classes is {count}; expected a whole number from 1 to 65535"):
            VoteLearner(SCENE, 2).resize(count)  # type: ignore[arg-type]
    learner, state = VoteLearner(SCENE, 2), taught(VoteLearner(SCENE, NUM_CLASSES), VIEWS).state()
    with pytest.raises(StateMismatchError, match="state is of 626 Gaussians; expected 600, as the scene has"):
        EMLearner(SCENE.subset(np.arange(600)), NUM_CLASSES).adopt(state)
    ghost = replace(VIEWS[0], camera=replace(VIEWS[0].camera, name="ghost"))
    with pytest.raises(SettingsError, match="'ghost' was not observed"):
        learner.relabel(ghost)
    for ask in (learner.retract, learner.forget, lambda name: learner.move(name, VIEWS[0].camera)):
        with pytest.raises(SettingsError, match="'ghost' was not observed"):
            ask("ghost")


@every_learner
def test_one_class_only_works(kind: type[Learner]) -> None:
    views = [View.from_arrays(view.camera, np.zeros((48, 64), np.int32)) for view in VIEWS[:2]]
    learner = taught(kind(SCENE, 1), views).fit()
    np.testing.assert_array_equal(learner.codes_[:, 0], learner.observed_)


@every_learner
def test_a_number_of_classes_that_is_one_of_numpys_short_ones_gives_the_same(kind: type[Learner]) -> None:
    views = [View.from_arrays(view.camera, (60 * view.read_labels()).astype(np.uint8)) for view in VIEWS]
    count = max(view.read_labels().astype(np.uint8).max() for view in views) + np.uint8(1)
    expected, learner = (taught(kind(SCENE, num_classes), views).fit() for num_classes in (181, count))
    np.testing.assert_array_equal(learner.codes_, expected.codes_)


@every_learner
def test_progress_is_told_from_start_to_end(kind: type[Learner]) -> None:
    calls: list[tuple[str, int, int]] = []
    taught(kind(SCENE, NUM_CLASSES), VIEWS[:2]).fit(lambda *call: calls.append(call))
    assert all(0 <= done <= total for _, done, total in calls)
    assert not calls or calls[-1][1] == calls[-1][2]


def test_what_stands_behind_glass_has_evidence_if_a_tenth_of_the_light_comes_through() -> None:
    """The mask names the thing behind, as a person would."""
    camera = look_at("front", np.array([0.0, 0.0, 4.0]))
    view = View.from_arrays(camera, np.ones((camera.height, camera.width), np.int32))
    for opacity, is_known in ((0.85, True), (0.95, False)):
        scene = GaussianScene.from_arrays(
            np.array([[0.0, 0, 1], [0, 0, 0]]), np.tile([1.0, 0, 0, 0], (2, 1)), np.array([[50, 50, 0.01], [0.1] * 3]),
            np.array([opacity, 0.95]), np.zeros((2, 1, 3)),
        )  # fmt: skip
        learner = taught(VoteLearner(scene, 2), [view])
        assert (learner.evidence()[1] > 0) == is_known and learner.evidence()[0] > 0
        assert learner.fit().codes_[0, 1] == 1 and learner.observed_[1] == is_known
