"""Expectation maximisation (EM) of class probabilities, with a confusion matrix for each view: the default learner.

The model is that of Dawid & Skene (1979): views are annotators, Gaussians are items. The difference is that an
annotation, which is the label of a pixel, depends on all Gaussians along a ray. docs/method.md, "Learners", explains
the model and the objective J. Below, q (N, K) are the class probabilities, and C_v[k, y] is the probability of label y
in view v given class k:

- `_e_step` sums over the views gradient[i, k] = dlogL / dq_i[k] = sum_v sum_y C_v[k, y] B_v[i, y], where B_v[i, y] is
  the sum of w_v[p, i] / p_v(y | p) over the pixels p of label y. q * gradient are the expected counts, in px. The sum
  skips some blocks of pixels and gives others a larger weight instead (`block_weights`).
- `m_step` sets q_i to normalise(q_i gradient_i + prior_i), the exact maximiser of the usual lower bound, so J never
  falls. prior_i is `prior_weight` times the mean vote probabilities of the nearest Gaussians, weighted by how well each
  was seen (`spatial_prior`). If masks vote against classes, it is computed again later, from the probabilities.
- `predicted_gain` is the slope of J along the step. J is concave, so a step gains at most this much. Fitting ends with
  the first step that cannot gain `tolerance`.
- `_refit_error_models` re-estimates each view's confusion matrix from probabilities that leave this view out, since
  probabilities that were fitted to a mask agree with its errors.

Before the first step, the boundaries of each mask are aligned with edges of the scene (`boundary_alignment`), and
labels of regions that the votes of all other views contradict are rejected (`rejected_regions`).
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

REFIT_FACTOR = 4  # error models are re-estimated once a step gains less than this multiple of the tolerance

Tick = Callable[[], None]
"""Called for each view; it may raise an error to stop the work."""

OverViews = tuple[Any, dict[str, Any]]
"""Result over some views: an int64 array summed over them (perhaps sparse) or None; and further results by view."""


@dataclass(frozen=True)
class EMSettings:
    """Settings of `EMLearner`.

    Attributes
    ----------
    max_steps : int
        Maximum number of steps; scikit-learn's `max_iter`.
    tolerance : float
        Stop with a step that gains less than this, in nats per labelled pixel; scikit-learn's `tol`. If only a share s
        of the pixels names a class, as in partial masks, steps gain less and more are needed: the limit is then s^2
        times this.
    errors : bool
        Learn a confusion matrix for each view; if False, every mask is taken to be right.
    refits : int
        How often error models are re-estimated once the probabilities have almost converged.
    edge_px : int
        Move boundaries of a plain mask to edges of the scene, for masks drawn up to this many px too wide or too
        narrow; see `gsseg_core.learn.em.boundary_alignment`. 0 switches this off.
    least_agreement : float
        Reject the label of a mask region if the votes of the other views give it less than this share of the region;
        see `gsseg_core.learn.em.rejected_regions`. 0 switches this off.
    majority : float
        Power to which the vote probabilities are raised to count the first error models; above 1 it favours majorities.
    error_prior : float
        Pseudo-count of correctly labelled pixels of a class, as a share of the pixels that the class fills in the view.
    outliers : float
        Share of pixels that carry any label of the view by chance, in (0, 1).
    prior_weight : float
        Weight of the spatial prior of a Gaussian, in px.
    prior_k : int
        Number of nearest neighbours that the spatial prior averages.
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
        """Whether mask regions are tested and their labels may be rejected."""
        return self.errors and self.least_agreement > 0


class EMLearner(Learner):
    """Learner of maximum a posteriori (MAP) class probabilities by EM, with a confusion matrix for each view.

    Attributes
    ----------
    error_models_ : dict of str to ErrorModel
        After `fit`: confusion matrix of each view; crowd-kit's `DawidSkene` calls them `errors_`.
    history_ : list of float
        After `fit`: J per labelled pixel before each step, in nats; it falls only when error models are re-estimated.
    rounds_ : list of int
        After `fit`: number of steps with each set of error models.
    converged_ : bool
        After `fit`: whether the last step gained less than the tolerance.
    """

    leaves_out = checks_masks = True
    error_models_: Mapping[str, ErrorModel] = {}
    # Input of the last step, on the device: codes, gradient over all views, and whether any code has class 0.
    _last_step_: tuple[Any, Any, bool]

    def __init__(
        self, scene: GaussianScene, num_classes: int, settings: EMSettings | None = None, *,
        device: str = "cpu", memory_budget: int | None = None,
    ) -> None:  # fmt: skip
        super().__init__(scene, num_classes, device=device, memory_budget=memory_budget)
        self.settings = settings or EMSettings()

    @classmethod
    def default_settings(cls, max_steps: int | None, seed: int) -> tuple[EMSettings]:
        """Return the default settings, with `max_steps` if given."""
        return (EMSettings(max_steps=EMSettings.max_steps if max_steps is None else max_steps),)

    @property
    def lower_bound_(self) -> float:
        """Return J per labelled pixel, in nats, before the last step: the last entry of `history_`."""
        return self.history_[-1] if self.history_ else float("nan")

    @property
    def loss(self) -> float:
        """Return -J per labelled pixel, in nats."""
        return -self.lower_bound_

    @fits_whole
    def fit(self, progress: Progress = silent) -> EMLearner:
        """Alternate E and M steps until a step can gain less than the tolerance, or for `max_steps`."""
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
                    # Votes against classes say little about neighbours; by now the probabilities are more reliable.
                    codes, gradient, prior = with_prior(codes, gradient, self._spatial_prior(codes, evidence))
            kernels.m_step(codes, gradient, prior.data)
            if self.converged_:
                break
        progress("em", settings.max_steps, settings.max_steps)
        self.code_rows_, self.error_models_ = codes.nonzero(), models
        self._finish()
        return self

    def _initialize_codes(self, votes: CSRRows) -> tuple[CSRRows, CSRRows, np.ndarray]:
        """Initialise from the votes: class probabilities, their prior, and the evidence per Gaussian, (N,) px."""
        resolved = resolved_votes(votes, self._possible())
        evidence = VOTE_UNIT * resolved.sums()
        resolved, prior = resolved.united(self._spatial_prior(resolved, evidence))
        # With the prior added, J is finite from the start. Entries that are zero now stay zero in every step, so rows
        # keep their classes until the prior is computed again.
        codes = resolved.with_data(resolved.data.astype(np.float32) * np.float32(VOTE_UNIT) + prior.data).normalised()
        return codes, prior, evidence

    def _compute_lower_bound(self, codes: CSRRows, prior: CSRRows, log_likelihoods: Mapping[str, float]) -> float:
        """Return J, in nats: the log-likelihood of all labels plus the log prior, up to a constant."""
        counted = prior.data > 0
        log_prior = (prior.data[counted] * np.log(codes.data[counted])).sum(dtype=np.float64)
        return float(log_prior) + sum(log_likelihoods[name] for name in self.views)

    def predict_without(self, view: View) -> np.ndarray:
        """Render class probabilities from the last step repeated without the view's mask, (H, W, K) float32.

        The step also leaves out the spatial prior, so the K values of a pixel sum to less than 1 where no other view
        saw anything. Gaussians under no labelled pixel of the view keep the probabilities from before the last step.
        """
        codes, _, background, operator = self._without(view, only_labelled=False)
        return operator.blend_probabilities(codes, self.num_classes, background)

    def strongest_without(self, view: View, wanted: np.ndarray | None = None, grid: PixelGrid = NO_PIXELS) -> Strongest:
        """Return the class of each pixel by `predict_without`, without making the image of all K probabilities."""
        codes, of, background, operator = self._without(view, only_labelled=wanted is not None)
        return operator.strongest(codes, self.num_classes, background, grid, of, wanted=wanted)

    def _without(self, view: View, *, only_labelled: bool) -> tuple[CSRRows, np.ndarray | None, bool, ViewRenderer]:
        """Repeat the last step of `fit` without a view's mask; return what is needed to render the result.

        Returns the codes, the ids of their Gaussians, whether any code has a share of the background, and the operator.
        If `only_labelled`, the codes are those of the Gaussians that labelled pixels see, and the operator comes from
        the observation, without projection. Otherwise the codes cover all Gaussians, and the ids are None.
        """
        model, observation, backend = self._model_of(view), self.observation(view.name), kernels_on(self.device)
        codes, gradient, background = self._last_step_
        no_prior, ids = backend.zeros(codes, np.float32), backend.pairs_of(observation).ids
        stepped = codes_without(observation, model, codes, gradient, no_prior, self.device)
        if only_labelled:
            return stepped, ids, background, observation.operator(view.camera, len(self.scene))
        return codes.with_rows(ids, stepped), None, background, self._operator_of(view)

    def rejected_share(self, view: View) -> float:
        """Return the share of a view's labelled pixels that lie in rejected regions."""
        evidence, areas = self._model_of(view).evidence, self.observation(view.name).areas
        return 0.0 if evidence.nameless is None else float(areas[evidence.nameless].sum() / areas.sum())

    def forget(self, name: str) -> None:
        """Drop a view, its mask and its error model, which is wrong for a later view of the same name."""
        super().forget(name)
        self.error_models_ = {known: model for known, model in self.error_models_.items() if known != name}

    def _model_of(self, view: View) -> ErrorModel:
        if view.name not in self.error_models_:
            raise SettingsError(f"view {view.name!r} was not learnt from; expected a view of the last fit()")
        return self.error_models_[view.name]

    def _prepare(self, view: View, seen: SeenLabels, operator: ViewOperator | None = None) -> Observation:
        operator = operator or self._operator_of(view)
        used = self._used_labels(seen, operator)
        # Without error models, errors in the few weighted blocks would count too much: it cost up to a point of mIoU.
        weights = block_weights(used.labels, seen.hardened().labels) if self.settings.errors else None
        return operator.observe(used.labels, used.evidence, weights)

    def _used_labels(self, seen: SeenLabels, operator: ViewOperator) -> SeenLabels:
        """Align boundaries of a plain mask with edges; give each region its own label if regions may be rejected."""
        settings = self.settings
        seen = seen.hardened() if settings.errors else seen  # Error models are per region, not per pixel.
        if settings.errors and settings.edge_px and seen.evidence is None:
            distance = reach(settings.edge_px) + 1  # One px more, since edges are differences.
            edges = kernels_on(self.device).scene_edges(operator, self.scene, seen.labels, distance)
            seen = SeenLabels(align_boundaries(seen.labels, edges, settings.edge_px))
        return split_regions(seen) if settings.rejects_regions else seen

    def _reject_regions(self, votes: CSRRows, tick: Tick) -> tuple[CSRRows, dict[str, np.ndarray | None]]:
        """Reject labels that the other views contradict; return the votes without them, and the labels by view.

        A rejected label may itself have contradicted others, so each one is tested again by the remaining votes. The
        labels of a view are (L,) bool, or None if none is rejected.
        """
        rejected: dict[str, np.ndarray | None] = dict.fromkeys(self.views)
        if not self.settings.rejects_regions:
            return votes, rejected
        # The neighbours of a scene are computed once; the CPU is free for it while a GPU tests regions.
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
        """Call one of the methods below for some views. They change nothing, so workers may run and repeat them."""
        return work(self, *arrays, by_view, tick)

    def _find_rejected(
        self, votes: CSRRows, doubted: Mapping[str, np.ndarray | None], tick: Tick
    ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Find the labels of some views that the votes of all other views contradict; `votes` are those of all, int64.

        `doubted` has the views to test: None to test all labels of a view, else a mask (L,) bool of the labels to test,
        whose votes are not part of `votes`. Returns minus the votes of the rejected labels, (Z,) int64 for each entry
        of `votes`, and the rejected labels by view, (L,) bool, for views that have any.
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
        """Return the device that counts votes; only the CPU code resolves votes against classes."""
        return "cpu" if votes.data.min(initial=0) < 0 else self.device

    def _initial_error_models(
        self, votes: CSRRows, rejected: Mapping[str, np.ndarray | None], tick: Tick
    ) -> tuple[None, dict[str, ErrorModel]]:
        """Estimate the error model of each of some views from the votes of all other views.

        The votes, int64, exclude those of `rejected` labels: (L,) bool by view, None if a view has none.
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

        Returns the gradient with respect to each entry of the codes, (Z,) int64 in units of `GRADIENT_UNIT`, and the
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
        """Re-estimate the error models of some views, each from an M-step without its view; see `codes_without`."""
        codes, backend = rows_on(codes, self.device)
        gradient, prior = (backend.put(array, self.device) for array in (gradient, prior))

        def refit(name: str, observation: Observation) -> ErrorModel:
            model, likelihood, pairs = models[name], models[name].by_label, backend.pairs_of(observation)
            without = codes_without(observation, model, codes, gradient, prior, self.device)
            shares = backend.shares(observation, without, backend.by_row(pairs), likelihood)
            counts = backend.confusion_counts(without, pairs, shares.pairs, self.num_classes, len(likelihood))
            counts[0] += shares.rest
            # The counts cover only some pixels of each label: scale them to all of its pixels.
            counts *= observation.areas / np.maximum(observation.weighted_areas, 1)
            return model.m_step(model.expected_counts(counts))

        return None, dict(self._of_each(refit, models, tick))

    def _spatial_prior(self, of: CSRRows, evidence: np.ndarray) -> CSRRows:
        """Compute the spatial prior of all Gaussians from votes or probabilities, and their evidence in px."""
        settings = self.settings
        return spatial_prior(of, evidence, self.scene, settings.prior_k, settings.prior_weight, self.num_classes)
