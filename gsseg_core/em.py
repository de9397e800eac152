"""Expectation maximisation with an error model of every view.

The likelihood of what was seen. A pixel p of view v carries the label y_p. Its ray belongs to class k with the
probability O_v[p, k] = (W_v q)[p, k] + T_end[p] [k = 0], and the segmenter calls class k in this view y with the
probability (Dawid & Skene 1979, who had examiners in place of views)

    C_v[k, y] = (1 - outliers) R_v[k, y] + outliers / L_v,     p_v(y | p) = sum_k O_v[p, k] C_v[k, y].

A view in which a chair was missed or taken for a table has that in R_v, and so its pixels are no evidence against the
chair.

The objective. The log of the posterior, in nats:

    J(q, R) = sum_v sum_p log p_v(y_p | p)
            + prior_weight sum_i sum_k m_i[k] log q_i[k]
            + sum_v sum_k a_v[k] log R_v[k, k].

m_i is the mean of the votes' codes over the nearest Gaussians: objects are continuous in space. a_v[k] counts
pseudo-pixels in which the segmenter was right, a share of those that class k fills in view v by the votes' codes.

The step, with B_v[i, y] = sum over the pixels p seen as y of w_v[p, i] / p_v(y | p). Each factor is the exact maximiser
of the usual lower bound of J at the old values, so J never falls:

    q_i[k]     <- normalise( q_i[k] sum_v sum_y C_v[k, y] B_v[i, y] + prior_weight m_i[k] )
    R_v[k, y]  <- normalise( (1 - outliers) R_v[k, y] sum_i q_i[k] B_v[i, y] + a_v[k] [y = k] )

with the left-over transmittance as one more Gaussian of class 0 in the second. Only B_v needs the rasteriser, and its
cost does not depend on the number of classes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from gsseg_core.errors import SettingsError
from gsseg_core.gaussian_kernels import collect, mix, tally
from gsseg_core.learner import VOTE_UNIT, Learner, Progress, normalise, silent
from gsseg_core.neighbours import neighbours_of
from gsseg_core.operator import Observation
from gsseg_core.scene import GaussianScene


@dataclass(frozen=True)
class EMSettings:
    """Settings of `EMLearner`.

    Attributes
    ----------
    max_steps : int
        Steps at most.
    tolerance : float
        Stop when a step gains less than this, in nats per labelled pixel.
    errors : bool
        Learn what the segmenter got wrong in each view; without, every mask is taken at its word.
    error_prior : float
        Pseudo-pixels in which a class was labelled right, as a share of the pixels that it fills in the view.
    outliers : float
        Share of pixels that carry any label of the view by chance, in (0, 1).
    prior_weight : float
        Weight of the spatial prior of a Gaussian, in px.
    prior_k : int
        Neighbours that it averages.
    """

    max_steps: int = 30
    tolerance: float = 0.005
    errors: bool = True
    error_prior: float = 0.3
    outliers: float = 1e-3
    prior_weight: float = 3.0
    prior_k: int = 50

    def __post_init__(self) -> None:
        """Validate."""
        if self.max_steps < 1 or self.prior_k < 1:
            raise SettingsError(f"em: max_steps is {self.max_steps}, prior_k {self.prior_k}; expected at least 1")
        if not 0 < self.outliers < 1:
            raise SettingsError(f"em: outliers is {self.outliers}; expected a share in (0, 1)")
        if min(self.tolerance, self.error_prior, self.prior_weight) < 0:
            raise SettingsError("em: tolerance, error_prior or prior_weight is negative; expected 0 or more")


@dataclass
class ErrorModel:
    """What one view's segmenter calls each class.

    Attributes
    ----------
    classes : (L,) int32
        Labels that occur in the view's mask.
    confusion : (K, L) float32
        R_v: rows are true classes, columns the labels seen; rows sum to 1.
    right : (L,) float64
        a_v of the classes that occur, in px.
    outliers : float
        Share of pixels labelled by chance.
    """

    classes: np.ndarray
    confusion: np.ndarray
    right: np.ndarray
    outliers: float

    @classmethod
    def trusting(cls, classes: np.ndarray, num_classes: int, outliers: float) -> ErrorModel:
        """Believe that every label is right."""
        confusion = np.zeros((num_classes, len(classes)), np.float32)
        confusion[classes, np.arange(len(classes))] = 1.0
        return cls(classes, confusion, np.zeros(len(classes)), outliers)

    @classmethod
    def from_counts(
        cls,
        classes: np.ndarray,  # (L,)
        counts: np.ndarray,  # (K, L) px of each class under each label
        prior: float,
        outliers: float,
    ) -> ErrorModel:
        """Start from what the codes so far say of the mask."""
        right = prior * counts[classes].sum(axis=1)
        uniform = np.full(counts.shape, 1.0 / len(classes), np.float32)
        model = cls(classes, uniform, right, outliers)
        model.maximise(counts)
        return model

    @property
    def likelihood(self) -> np.ndarray:
        """C_v: probability of each label given the class, (K, L) float32."""
        return (1 - self.outliers) * self.confusion + np.float32(self.outliers / len(self.classes))

    @property
    def log_prior(self) -> float:
        """Log density of the prior of R_v, up to a constant, in nats."""
        diagonal = self.confusion[self.classes, np.arange(len(self.classes))]
        told = self.right > 0
        return float(self.right[told] @ np.log(diagonal[told].astype(np.float64)))

    def maximise(
        self,
        counts: np.ndarray,  # (K, L) expected px
    ) -> None:
        """Set R_v to its best for expected counts; classes that the view does not show keep their row."""
        counts = counts.astype(np.float64)
        counts[self.classes, np.arange(len(self.classes))] += self.right
        total = counts.sum(axis=1, keepdims=True)
        shown = total[:, 0] > 0
        self.confusion[shown] = counts[shown] / total[shown]


class EMLearner(Learner):
    """The default: the paper's loss with an error model, maximised by multiplicative steps that need no rate.

    Attributes
    ----------
    error_models_ : dict of str to ErrorModel
        After `fit`: what each view's segmenter got wrong.
    history_ : list of float
        After `fit`: J per labelled pixel, in nats, of what went into each step; it never falls.
    """

    def __init__(
        self,
        scene: GaussianScene,
        num_classes: int,
        settings: EMSettings | None = None,
        *,
        device: str = "cpu",
        memory_budget: int = 1 << 30,
    ) -> None:
        super().__init__(scene, num_classes, device=device, memory_budget=memory_budget)
        self.settings = settings or EMSettings()
        self.error_models_: dict[str, ErrorModel] = {}

    @property
    def loss(self) -> float:
        """-J per labelled pixel, in nats."""
        return -self.history_[-1] if self.history_ else float("nan")

    def fit(self, progress: Progress = silent) -> EMLearner:
        """Step until a step gains less than the tolerance."""
        settings = self.settings
        self._begin()
        prior = settings.prior_weight * self._smooth(self.vote_codes())
        # Votes are the first step; with the prior counted in, the objective is finite from the start.
        codes = normalise(self._votes.astype(np.float32) * np.float32(VOTE_UNIT) + prior)
        models, pixels = {}, 0
        for name, observation in self._observations():
            progress("em", 0, settings.max_steps)
            models[name] = self._first_model(codes, observation)
            pixels += observation.num_pixels
        self.history_ = history = []
        for done in range(settings.max_steps):
            codes, objective = self._step(codes, prior, models, partial(progress, "em", done, settings.max_steps))
            history.append(objective / pixels)
            self.converged_ = bool(done and history[-1] - history[-2] < settings.tolerance)
            if self.converged_:
                break
        progress("em", settings.max_steps, settings.max_steps)
        codes[~self.observed_] = 0.0
        self.codes_, self.error_models_ = codes, models
        return self

    def _first_model(self, codes: np.ndarray, observation: Observation) -> ErrorModel:
        settings, classes = self.settings, observation.classes
        if not settings.errors:
            return ErrorModel.trusting(classes, self.num_classes, settings.outliers)
        counts = tally(codes, observation.ids, observation.votes())
        return ErrorModel.from_counts(classes, counts, settings.error_prior, settings.outliers)

    def _step(
        self,
        codes: np.ndarray,  # (N, K)
        prior: np.ndarray,  # (N, K) px
        models: dict[str, ErrorModel],
        tell: Callable[[], None],
    ) -> tuple[np.ndarray, float]:
        """One step over all views: better codes, better models in place, and J of what came in."""
        told = prior > 0
        objective = float((prior[told] * np.log(codes[told])).sum(dtype=np.float64))
        gains = np.zeros_like(codes)
        for name, observation in self._observations():
            tell()  # after each view, so that whoever listens can stop the work at once
            model = models[name]
            objective += model.log_prior
            likelihood = np.ascontiguousarray(model.likelihood.T)
            shares = observation.shares(mix(codes, observation.ids, likelihood), likelihood[:, 0])
            objective += shares.log_likelihood
            counts = collect(codes, observation.ids, likelihood, shares.gaussians, gains)
            if self.settings.errors:
                counts[0] += shares.rest
                model.maximise(counts * (1 - model.outliers) * model.confusion)
        gains *= codes
        gains += prior
        return normalise(gains), objective

    def _smooth(
        self,
        votes: np.ndarray,  # (N, K)
    ) -> np.ndarray:
        """Mean code of those of the nearest Gaussians that were observed; rows of zeros where none was."""
        smooth = np.zeros_like(votes)
        neighbours = neighbours_of(self.scene, self.settings.prior_k)
        if neighbours is not None:
            ids, means = neighbours.mean_codes(votes, self.observed_, np.ones(len(votes), bool))
            smooth[ids] = normalise(means)
        return smooth
