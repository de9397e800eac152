"""Expectation maximisation (EM) of class probabilities, with a confusion matrix for each view: the default learner.

This is the model of Dawid & Skene (1979) with views as annotators and Gaussians as items, except that an annotation, a
pixel's label, depends on all Gaussians along a ray. docs/method.md, "Learners", has the model, the objective J and its
reasons; here is what the names below stand for, with q (N, K) the class probabilities and C_v[k, y] the probability of
label y in view v given class k:

- `_e_step` sums over the views gradient[i, k] = dlogL / dq_i[k] = sum_v sum_y C_v[k, y] B_v[i, y], with B_v[i, y] the
  sum of w_v[p, i] / p_v(y | p) over the pixels p of label y. q * gradient are the expected counts, in px. Not all
  pixels are gone through, and some count for others (`block_weights`).
- `m_step` sets q_i to normalise(q_i gradient_i + prior_i), the exact maximiser of the usual lower bound, so J never
  falls. prior_i is `prior_weight` times the mean of the votes' probabilities over the nearest Gaussians, the better
  seen the more (`spatial_prior`); where masks vote against classes it is taken once more, from the probabilities.
- `predicted_gain` is the slope of J along the step. J is concave, so no step gains more; fitting ends with the first
  step that cannot gain `tolerance`.
- `_refit_error_models` re-estimates each view's confusion matrix from probabilities that leave this view out, since
  probabilities that were fitted to a mask agree with its errors.

Before the first step, the boundaries of each mask are aligned with edges of the scene (`boundary_alignment`), and
regions whose label the votes of all other views contradict lose it (`rejected_regions`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.label_evidence import VOTE_UNIT
from gsseg_core.data.soft_masks import SeenLabels
from gsseg_core.data.view import View
from gsseg_core.errors import SettingsError
from gsseg_core.learn.all_or_nothing import fits_whole
from gsseg_core.learn.em import em_kernels as kernels
from gsseg_core.learn.em.block_weights import block_weights
from gsseg_core.learn.em.boundary_alignment import align_boundaries, reach
from gsseg_core.learn.em.confusion_model import ErrorModel
from gsseg_core.learn.em.pair_kernels import codes_without, kernels_on, rows_on
from gsseg_core.learn.em.rejected_regions import find_rejected, split_regions
from gsseg_core.learn.em.spatial_prior import spatial_prior, with_prior
from gsseg_core.learn.learner import Learner, Progress, silent
from gsseg_core.learn.vote_resolution import resolved_votes
from gsseg_core.raster.observation import Observation, ViewPairs, VoteShares
from gsseg_core.raster.view_operator import ViewOperator
from gsseg_core.raster.view_renderer import NO_PIXELS, PixelGrid, Strongest, ViewRenderer
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.several_at_once import meanwhile
from gsseg_core.spatial.neighbourhood import find_neighbours

REFIT_FACTOR = 4  # error models are re-estimated once a step gains less than this many times the tolerance

Tick = Callable[[], None]
"""Called for each view, so that whoever listens can stop the work at once."""

OverViews = tuple[Any, dict[str, Any]]
"""What comes of some views: a sum over them, of int64, perhaps sparse, or None; and by view what else came out."""


@dataclass(frozen=True)
class EMSettings:
    """Settings of `EMLearner`.

    Attributes
    ----------
    max_steps : int
        Steps at most; scikit-learn's `max_iter`.
    tolerance : float
        Stop with a step that gains less than this, in nats per labelled pixel; scikit-learn's `tol`. Where only a share
        s of the pixels names a class, as in partial masks, each step gains less of more: with less than s^2 of this.
    errors : bool
        Learn a confusion matrix for each view; without, every mask is taken to be right.
    refits : int
        How often error models are re-estimated once the probabilities have all but converged.
    edge_px : int
        Boundaries of a plain mask may be this many px too far in or out, and are moved to edges of the scene; see
        `gsseg_core.learn.em.boundary_alignment`. 0 switches this off.
    least_agreement : float
        The label of a region of a mask is rejected if less than this share of the region has it by the votes of the
        other views; see `gsseg_core.learn.em.rejected_regions`. 0 switches this off.
    majority : float
        The first error models are counted from the votes' probabilities to this power: above 1, majorities stand out.
    error_prior : float
        Pseudo-count of correctly labelled pixels of a class, as a share of the pixels that it fills in the view.
    outliers : float
        Share of pixels that carry any label of the view by chance, in (0, 1).
    prior_weight : float
        Weight of the spatial prior of a Gaussian, in px.
    prior_k : int
        Neighbours that it averages.
    """

    max_steps: int = 30
    tolerance: float = 0.0025
    errors: bool = True
    refits: int = 1
    edge_px: int = 3
    least_agreement: float = 0.05
    majority: float = 4.0
    error_prior: float = 0.3
    outliers: float = 1e-3
    prior_weight: float = 3.0
    prior_k: int = 50

    def __post_init__(self) -> None:
        """Validate."""
        for name, least in (("max_steps", 1), ("prior_k", 1), ("refits", 0), ("edge_px", 0)):
            value = getattr(self, name)
            if not isinstance(value, int | np.integer) or value < least:
                raise SettingsError(f"em: {name} is {value}; expected a whole number, {least} or more")
        if not 0 < self.outliers < 1:
            raise SettingsError(f"em: outliers is {self.outliers}; expected a share in (0, 1)")
        if not 0 <= self.least_agreement <= 1:
            raise SettingsError(f"em: least_agreement is {self.least_agreement}; expected a share in [0, 1]")
        for name, least in (("majority", 1), ("tolerance", 0), ("error_prior", 0), ("prior_weight", 0)):
            if not least <= getattr(self, name) < np.inf:
                raise SettingsError(f"em: {name} is {getattr(self, name)}; expected {least} or more, finite")

    @property
    def rejects_regions(self) -> bool:
        """Whether regions of masks are tested, and may be rejected."""
        return self.errors and self.least_agreement > 0


class EMLearner(Learner):
    """Class probabilities of most posterior density, by EM with a confusion matrix for each view.

    Attributes
    ----------
    error_models_ : dict of str to ErrorModel
        After `fit`: confusion matrix of each view, what crowd-kit's `DawidSkene` calls `errors_`.
    history_ : list of float
        After `fit`: J per labelled pixel before each step, in nats; it never falls until error models are re-estimated.
    rounds_ : list of int
        After `fit`: steps with each set of error models.
    converged_ : bool
        After `fit`: whether the last step gained less than the tolerance.
    """

    leaves_out = checks_masks = True
    error_models_: Mapping[str, ErrorModel] = {}
    # What the last step began with, on the device: codes, and the gradient of all views; whether any code has class 0.
    _last_step_: tuple[Any, Any, bool]

    def __init__(
        self, scene: GaussianScene, num_classes: int, settings: EMSettings | None = None, *,
        device: str = "cpu", memory_budget: int | None = None,
    ) -> None:  # fmt: skip
        super().__init__(scene, num_classes, device=device, memory_budget=memory_budget)
        self.settings = settings or EMSettings()

    @classmethod
    def default_settings(cls, max_steps: int | None, seed: int) -> tuple[EMSettings]:
        """Return settings for the registry."""
        return (EMSettings(max_steps=EMSettings.max_steps if max_steps is None else max_steps),)

    @property
    def lower_bound_(self) -> float:
        """J per labelled pixel, in nats, before the last step: the last entry of `history_`."""
        return self.history_[-1] if self.history_ else float("nan")

    @property
    def loss(self) -> float:
        """-J per labelled pixel, in nats."""
        return -self.lower_bound_

    @fits_whole
    def fit(self, progress: Progress = silent) -> EMLearner:
        """Alternate E and M steps until a step can gain no more than the tolerance."""
        settings = self.settings
        self._require_views()
        tick = partial(progress, "em", 0, settings.max_steps)
        votes, rejected = self._reject_regions(self._votes.rows(), tick)
        codes, prior, evidence = self._initialize_codes(votes)
        _, estimated = self._over_views(EMLearner._initial_error_models, rejected, tick, votes)
        models: dict[str, ErrorModel] = {name: estimated[name] for name in self.views}
        pixels = sum(model.num_pixels for model in models.values())
        named = sum(model.named_pixels for model in models.values())
        self.observed_, self.history_, self.rounds_ = evidence > 0, [], [0]
        for step in range(settings.max_steps):
            tick = partial(progress, "em", step, settings.max_steps)
            gradient, log_likelihoods = self._over_views(EMLearner._e_step, models, tick, codes)
            self.history_.append(self._compute_lower_bound(codes, prior, log_likelihoods) / pixels)
            self.rounds_[-1] += 1
            last_round = len(self.rounds_) > settings.refits or not settings.errors
            tolerance = settings.tolerance * (1 if last_round else REFIT_FACTOR) * named**2 / pixels
            gains_little = kernels.predicted_gain(codes, gradient, prior.data) < tolerance
            self.converged_ = gains_little and last_round
            if self.converged_ or step + 1 == settings.max_steps:
                before, backend = rows_on(codes.with_data(codes.data.copy()), self.device)
                self._last_step_ = before, backend.put(gradient, self.device), codes.has_column(0)
            elif gains_little:
                models |= self._over_views(EMLearner._refit_error_models, models, tick, codes, gradient, prior.data)[1]
                self.rounds_.append(0)
                if votes.data.min(initial=0) < 0:
                    # Such votes say little of what the neighbours are; the probabilities know by now.
                    codes, gradient, prior = with_prior(codes, gradient, self._spatial_prior(codes, evidence))
            kernels.m_step(codes, gradient, prior.data)
            if self.converged_:
                break
        progress("em", settings.max_steps, settings.max_steps)
        self.code_rows_, self.error_models_ = codes.nonzero(), models
        self._finish()
        return self

    def _initialize_codes(self, votes: CSRRows) -> tuple[CSRRows, CSRRows, np.ndarray]:
        """Take a first step by the votes: class probabilities, their prior, and of how many px they are, (N,)."""
        resolved = resolved_votes(votes, self._possible())
        evidence = VOTE_UNIT * resolved.sums()
        resolved, prior = resolved.united(self._spatial_prior(resolved, evidence))
        # With the prior added, J is finite from the start. What is zero now stays zero in every step, so that rows keep
        # their classes, unless the prior is taken anew.
        codes = resolved.with_data(resolved.data.astype(np.float32) * np.float32(VOTE_UNIT) + prior.data).normalised()
        return codes, prior, evidence

    def _compute_lower_bound(self, codes: CSRRows, prior: CSRRows, log_likelihoods: Mapping[str, float]) -> float:
        """J, in nats: the log-likelihood of all labels, and the log of the prior but for a constant."""
        counted = prior.data > 0
        log_prior = (prior.data[counted] * np.log(codes.data[counted])).sum(dtype=np.float64)
        return float(log_prior) + sum(log_likelihoods[name] for name in self.views)

    def predict_without(self, view: View) -> np.ndarray:
        """Blend into a view the probabilities of a last step without its mask, (H, W, K) float32.

        The spatial prior is left out, too, so rows sum to less where no other view has seen anything. Of Gaussians that
        no pixel of the mask lies on, which it says nothing of, the last step is not taken, and what they had stays.
        """
        codes, _, background, operator = self._without(view, only_labelled=False)
        return operator.blend_probabilities(codes, self.num_classes, background)

    def strongest_without(self, view: View, wanted: np.ndarray | None = None, grid: PixelGrid = NO_PIXELS) -> Strongest:
        """Tell the class of each pixel by `predict_without`, without an image of all classes."""
        codes, of, background, operator = self._without(view, only_labelled=wanted is not None)
        return operator.strongest(codes, self.num_classes, background, grid, of, wanted=wanted)

    def _without(self, view: View, *, only_labelled: bool) -> tuple[CSRRows, np.ndarray | None, bool, ViewRenderer]:
        """Take the last step of `fit` again, without a view's mask; return what blends the outcome into the view.

        These are the codes, the ids of their Gaussians, whether any code has a share of the background, and the
        operator. If only labelled pixels count, the codes are of the Gaussians that these see, and the operator is at
        hand; else they are of all Gaussians, and the ids None.
        """
        model, observation, backend = self._model_of(view), self.observation(view.name), kernels_on(self.device)
        codes, gradient, background = self._last_step_
        no_prior, ids = backend.zeros(codes, np.float32), backend.pairs_of(observation).ids
        stepped = codes_without(observation, model, codes, gradient, no_prior, self.device)
        if only_labelled:
            return stepped, ids, background, observation.operator(view.camera, len(self.scene))
        return codes.with_rows(ids, stepped), None, background, self._operator_of(view)

    def rejected_share(self, view: View) -> float:
        """Share of a view's labelled pixels that lie in rejected regions."""
        evidence, areas = self._model_of(view).evidence, self.observation(view.name).areas
        return 0.0 if evidence.nameless is None else float(areas[evidence.nameless].sum() / areas.sum())

    def forget(self, name: str) -> None:
        """Drop a view, its mask and its error model: what comes under its name has another."""
        super().forget(name)
        self.error_models_ = {known: model for known, model in self.error_models_.items() if known != name}

    def _model_of(self, view: View) -> ErrorModel:
        if view.name not in self.error_models_:
            raise SettingsError(f"view {view.name!r} was not learnt from; expected a view of the last fit()")
        return self.error_models_[view.name]

    def _prepare(self, view: View, seen: SeenLabels, operator: ViewOperator | None = None) -> Observation:
        operator = operator or self._operator_of(view)
        used = self._used_labels(seen, operator)
        # Without error models, what is wrong in few pixels would weigh too much: up to a point of mIoU was lost by it.
        weights = block_weights(used.labels, seen.hardened().labels) if self.settings.errors else None
        return operator.observe(used.labels, used.evidence, weights)

    def _used_labels(self, seen: SeenLabels, operator: ViewOperator) -> SeenLabels:
        """Align boundaries of a plain mask with edges, and give each region a label if regions may be rejected."""
        settings = self.settings
        seen = seen.hardened() if settings.errors else seen  # Errors are of whole regions, probabilities of pixels.
        if settings.errors and settings.edge_px and seen.evidence is None:
            distance = reach(settings.edge_px) + 1  # One px more, since edges are differences.
            edges = kernels_on(self.device).scene_edges(operator, self.scene, seen.labels, distance)
            seen = SeenLabels(align_boundaries(seen.labels, edges, settings.edge_px))
        return split_regions(seen) if settings.rejects_regions else seen

    def _reject_regions(self, votes: CSRRows, tick: Tick) -> tuple[CSRRows, dict[str, np.ndarray | None]]:
        """Reject labels that the other views contradict: the votes without them; by view which they are, (L,) bool.

        What is rejected must not speak against others: so each is tested once more, by the votes that are left.
        """
        rejected: dict[str, np.ndarray | None] = dict.fromkeys(self.views)  # None where none is
        if not self.settings.rejects_regions:
            return votes, rejected
        # All neighbours of a scene are found once; while a GPU tests regions, the CPU is free for that.
        search, find = partial(find_neighbours, self.scene, self.settings.prior_k), EMLearner._find_rejected
        with meanwhile(search, self.device) if self.settings.prior_weight else nullcontext():
            change, doubted = self._over_views(find, rejected, tick, votes)
            if doubted:
                left = votes.with_data(votes.data + change)
                change, doubted = self._over_views(find, doubted, tick, left)
        return votes.with_data(votes.data + change).nonzero(), rejected | doubted

    def _over_views(
        self, work: Callable[..., OverViews], by_view: Mapping[str, Any], tick: Tick, *arrays: CSRRows | np.ndarray
    ) -> OverViews:
        """Have a method below go over some views; these change nothing, so it may be done elsewhere, and again."""
        return work(self, *arrays, by_view, tick)

    def _find_rejected(
        self, votes: CSRRows, doubted: Mapping[str, np.ndarray | None], tick: Tick
    ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Find the labels of some views that the other views contradict, by the votes of all, int64.

        Of a view that is None among the `doubted`, all labels are tested; else those marked, (L,) bool, whose votes are
        not among the votes. Returns what is left of zero votes, (Z,) int64 for each entry of the votes, when those that
        are found are taken from it, and which they are, (L,) bool by view; views without any are left out.
        """
        possible, device = self._possible(), self._device_of(votes)
        votes, backend = rows_on(votes, device)
        change, rejected, least = backend.zeros(votes, np.int64), {}, self.settings.least_agreement

        def find(name: str, observation: Observation) -> tuple[np.ndarray, Observation]:
            return find_rejected(votes, observation, possible, least, device, doubted[name]), observation

        for name, (labels, observation) in self._of_each(find, doubted, tick):
            if labels.any():
                rejected[name] = labels
                rejected_votes = observation.evidence.without_names(~labels).votes
                backend.subtract_votes(votes.with_data(change), observation, rejected_votes)
        return backend.returned(change), rejected

    def _device_of(self, votes: CSRRows) -> str:
        """Device that counts votes: those against a class are resolved on the CPU alone."""
        return "cpu" if votes.data.min(initial=0) < 0 else self.device

    def _initial_error_models(
        self, votes: CSRRows, rejected: Mapping[str, np.ndarray | None], tick: Tick
    ) -> tuple[None, dict[str, ErrorModel]]:
        """Estimate an error model for each of some views from the votes of all other views.

        The votes, int64, are without those of labels that are `rejected`: (L,) bool, None of views without any.
        """
        settings, possible = self.settings, self._possible()
        votes, backend = rows_on(votes, self._device_of(votes))

        def estimate(name: str, observation: Observation) -> ErrorModel:
            evidence, outliers = observation.evidence, settings.outliers
            if not settings.errors:
                return ErrorModel.without_errors(evidence, self.num_classes, outliers, observation.areas)
            if (labels := rejected[name]) is not None:
                evidence = evidence.without_names(labels)
            counts = backend.leave_one_out_counts(votes, observation, possible, evidence, settings.majority)
            return ErrorModel.from_counts(evidence, counts, settings.error_prior, outliers, observation.areas)

        return None, dict(self._of_each(estimate, rejected, tick))

    def _e_step(self, codes: CSRRows, models: dict[str, ErrorModel], tick: Tick) -> tuple[np.ndarray, dict[str, float]]:
        """Sum the gradient of the log-likelihood over the views of these models.

        Returns it with respect to each entry of the codes, (Z,) int64 in units of `GRADIENT_UNIT`, and the
        log-likelihood of each view's labels, in nats.
        """
        codes, backend = rows_on(codes, self.device)

        def share(name: str, observation: Observation) -> tuple[ViewPairs, np.ndarray, VoteShares]:
            likelihood, pairs = models[name].by_label, backend.pairs_of(observation)
            return pairs, models[name].used(likelihood), backend.shares(observation, codes, pairs, likelihood)

        gradient, log_likelihoods = backend.zeros(codes, np.int64), {}
        for name, (pairs, used, shares) in self._of_each(share, models, tick):
            log_likelihoods[name] = shares.log_likelihood
            backend.accumulate(codes.with_data(gradient), pairs, used, shares.pairs)
        return backend.returned(gradient), log_likelihoods

    def _refit_error_models(
        self, codes: CSRRows, gradient: np.ndarray, prior: np.ndarray, models: Mapping[str, ErrorModel], tick: Tick
    ) -> tuple[None, dict[str, ErrorModel]]:
        """Re-estimate the error models of some views, each from the step without its view; see `codes_without`."""
        codes, backend = rows_on(codes, self.device)
        gradient, prior = (backend.put(array, self.device) for array in (gradient, prior))

        def refit(name: str, observation: Observation) -> ErrorModel:
            model, likelihood, pairs = models[name], models[name].by_label, backend.pairs_of(observation)
            without = codes_without(observation, model, codes, gradient, prior, self.device)
            shares = backend.shares(observation, without, backend.by_row(pairs), likelihood)
            counts = backend.confusion_counts(without, pairs, shares.pairs, self.num_classes, len(likelihood))
            counts[0] += shares.rest
            # Only some pixels of each label were gone through: they count for all of them.
            counts *= observation.areas / np.maximum(observation.weighted_areas, 1)
            return model.m_step(model.expected_counts(counts))

        return None, dict(self._of_each(refit, models, tick))

    def _spatial_prior(self, of: CSRRows, evidence: np.ndarray) -> CSRRows:
        """Prior of all Gaussians, by the votes or the probabilities of their neighbours, and their evidence in px."""
        settings = self.settings
        return spatial_prior(of, evidence, self.scene, settings.prior_k, settings.prior_weight, self.num_classes)
