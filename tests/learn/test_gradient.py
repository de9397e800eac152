"""The paper's learner: its loss is the formula, and its gradient is the loss's."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import torch
from operator_cases import lifting
from small_scenes import NUM_CLASSES, balls_on_a_table, clean_views, taught

from gsseg_core.data.view import View
from gsseg_core.errors import SettingsError
from gsseg_core.learn.gradient_learner import GradientLearner, GradientSettings, _Adam, cross_entropy
from gsseg_core.raster.backends import make_operator

SCENE, TRUTH = balls_on_a_table()
VIEWS = clean_views(3)


def partly_known() -> View:
    labels = VIEWS[0].read_labels()
    labels[:9, :30] = -1
    return View.from_arrays(VIEWS[0].camera, labels)


def random_codes(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.dirichlet(np.ones(NUM_CLASSES), len(SCENE)).astype(np.float32)


def test_the_loss_is_the_formula_of_the_paper_over_the_labelled_pixels() -> None:
    view, codes = partly_known(), random_codes()
    operator, labels = make_operator(SCENE, view.camera), view.read_labels()
    weights, left_over = lifting(operator, SCENE)
    image = (weights @ codes).reshape(*labels.shape, NUM_CLASSES)
    image[..., 0] += left_over.reshape(labels.shape)
    known = labels >= 0
    losses = [-np.log(image[..., k][labels == k]).sum() / known.sum() for k in range(NUM_CLASSES)]
    loss, _ = cross_entropy(codes, operator.observe(labels))
    assert float(loss) == pytest.approx(np.mean(losses), rel=1e-5)


def test_the_gradient_is_that_of_finite_differences() -> None:
    view, codes = partly_known(), random_codes()
    observation = make_operator(SCENE, view.camera).observe(view.read_labels())
    _, gradient = cross_entropy(codes, observation)
    for seed in range(5):
        direction = np.random.default_rng(seed).normal(size=codes.shape).astype(np.float32)
        step = np.float32(2e-3) * direction * codes
        rise = cross_entropy(codes + step, observation)[0] - cross_entropy(codes - step, observation)[0]
        expected = float((gradient.astype(np.float64) * step).sum()) * 2
        assert float(rise) == pytest.approx(expected, rel=0.02, abs=2e-6)
    unseen = np.setdiff1d(np.arange(len(SCENE)), observation.ids)
    assert not gradient[unseen].any()


def test_steps_are_those_of_adam() -> None:
    rng = np.random.default_rng(0)
    codes = torch.from_numpy(rng.normal(size=(7, 3)).astype(np.float32))
    adam, expected, mean, square = _Adam(codes), codes.numpy().astype(np.float64), 0.0, 0.0
    for step in range(1, 50):
        gradient, rate = rng.normal(size=(7, 3)), 0.05 * 0.9**step
        adam.step(torch.from_numpy(gradient.astype(np.float32)), rate)
        mean, square = 0.9 * mean + 0.1 * gradient, 0.999 * square + 0.001 * gradient**2
        expected -= rate * (mean / (1 - 0.9**step)) / (np.sqrt(square / (1 - 0.999**step)) + 1e-8)
    np.testing.assert_allclose(codes.numpy(), expected, atol=1e-6)


def test_it_does_without_the_compiler_of_pytorch_which_takes_seconds_to_load(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch._dynamo", None)
    taught(GradientLearner(balls_on_a_table()[0], NUM_CLASSES, GradientSettings(epochs=1)), clean_views(1)).fit()


def test_the_loss_falls_from_epoch_to_epoch() -> None:
    history = taught(GradientLearner(SCENE, NUM_CLASSES), VIEWS).fit().history_
    assert len(history) == GradientSettings().epochs
    assert (np.diff(history) < 0).all()
    assert history[-1] < 0.7 * history[0]


def test_the_same_seed_gives_the_same_codes_and_another_one_others() -> None:
    first, again, other = (
        taught(GradientLearner(SCENE, NUM_CLASSES, GradientSettings(seed=seed)), VIEWS).fit().codes_
        for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


def test_the_documentation_names_the_equations_and_where_the_paper_is_silent() -> None:
    text = GradientLearner.__doc__ or ""
    for words in ("eq. 2", "eq. 3", "eq. 4", "Where the paper is silent"):
        assert words in text


@pytest.mark.parametrize(
    "wrong",
    [{"epochs": 0}, {"epochs": 1.5}, {"epochs": np.nan}, {"seed": -1}, {"seed": 0.5}, {"rate": 0.0},
     {"final_rate": 0.0}, {"final_rate": 1.0}, {"rate": np.inf}],
)  # fmt: skip
def test_settings_out_of_range_are_refused_by_name(wrong: dict[str, float]) -> None:
    with pytest.raises(SettingsError, match=f"gradient: .*{next(iter(wrong))}.*expected"):
        GradientSettings(**wrong)  # type: ignore[arg-type]
