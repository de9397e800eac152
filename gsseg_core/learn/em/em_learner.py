"""Expectation maximisation with an error model of every view.

The likelihood of what was seen. A pixel p of view v carries the label y_p. Its ray belongs to class k with the
probability O_v[p, k] = (W_v q)[p, k] + T_end[p] [k = 0], and the segmenter calls class k in this view y with the
probability (Dawid & Skene 1979, who had examiners in place of views)

    C_v[k, y] = (1 - outliers) R_v[k, y] + outliers / L_v,     p_v(y | p) = sum_k O_v[p, k] C_v[k, y].

A view in which a chair was missed or taken for a table has that in R_v, and so its pixels are no evidence against the
chair.

Outlines. What a segmenter draws too wide in one view and too narrow in the next is moved to where the scene has edges
before anything is learnt from it; see `gsseg_core.learn.em.boundary_alignment`.

Regions in doubt. An error model says what a view calls each class, wherever in the image. What is wrong in one place,
say a blob of clutter, it does not explain. So regions of a mask that the votes of all other views speak against are
left out of all that follows; see `gsseg_core.learn.em.rejected_regions`.

The objective. With the error models fixed, the log of the posterior of the codes, in nats:

    J(q) = sum_v sum_p log p_v(y_p | p) + prior_weight sum_i sum_k m_i[k] log q_i[k].

m_i is the mean of the votes' codes over the nearest Gaussians: objects are continuous in space. The step, with
B_v[i, y] = sum over the pixels p seen as y of w_v[p, i] / p_v(y | p), is the exact maximiser of the usual lower bound
of J at the old values, so J never falls:

    q_i[k]     <- normalise( q_i[k] sum_v sum_y C_v[k, y] B_v[i, y] + prior_weight m_i[k] )

Only B_v needs the rasteriser, and its cost does not depend on the number of classes. J is concave, so a step gains at
most what its slope along the step promises. That is known before the step is taken, and where it is next to nothing,
the step is the last: no pass over the views is spent on learning how little it brought.

The error models. Codes that have learnt from a mask agree with its errors, the more so the longer they learn, and find
nothing wrong with it. So a view's model is learnt from codes that have not seen this view: q^-v is the step above
without the summand of v, and with B_v taken at q^-v

    R_v[k, y]  <- normalise( (1 - outliers) R_v[k, y] sum_i q^-v_i[k] B_v[i, y] + a_v[k] [y = k] )

with the left-over transmittance as one more Gaussian of class 0. a_v[k] counts pseudo-pixels in which the segmenter was
right, a share of those that class k fills in view v by the votes of the others. At first q^-v are these votes' codes,
raised to a power: where a third of the views is wrong, each in its own way, the majority still is right, and to count
the minorities along with it would smear every large class over the rows of the small ones. Once the codes have all but
converged the models are learnt anew in this way, and then the codes once more.

Soft and partial masks. There the segmenter's words y are classes, and "none of those that I looked for", which is right
for all others. A pixel's label m is a mixture of words with shares s_m[y] (see `gsseg_core.data.label_evidence`):
wherever C_v[k, y] stands for a pixel, it is sum_y s_m[y] C_v[k, y] there, and the expected counts of R_v are split in
proportion to the summands.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from gsseg_core.csr_rows import CSRRows, starts
from gsseg_core.data.label_evidence import resolved_votes
from gsseg_core.data.soft_masks import SeenLabels
from gsseg_core.errors import SettingsError
from gsseg_core.learn.em.boundary_alignment import scene_edges, settle_outlines
from gsseg_core.learn.em.confusion_model import ErrorModel
from gsseg_core.learn.em.em_kernels import collect, improve, improve_without, mix, promised, tally
from gsseg_core.learn.em.leave_one_out import counted_by_others
from gsseg_core.learn.em.rejected_regions import by_region, in_doubt, take_back
from gsseg_core.learn.learner import MEMORY_BUDGET, VOTE_UNIT, Learner, Progress, silent
from gsseg_core.raster.backends import make_operator
from gsseg_core.raster.observation import Observation
from gsseg_core.raster.view_operator import ViewOperator
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.spatial.neighbourhood import neighbours_of

ROUGH = 8
"""Codes that error models are learnt anew from may be so many times less settled than those that are handed out."""


@dataclass(frozen=True)
class EMSettings:
    """Settings of `EMLearner`.

    Attributes
    ----------
    max_steps : int
        Steps at most.
    tolerance : float
        Stop with a step that gains less than this, in nats per labelled pixel; `ROUGH` times this before a refit.
    errors : bool
        Learn what the segmenter got wrong in each view; without, every mask is taken at its word.
    refits : int
        How often error models are learnt anew once the codes have all but converged, and the codes then once more.
    edge_px : int
        Outlines of a mask may lie so many px too far in or out, and are moved to edges of the scene; see
        `gsseg_core.learn.em.boundary_alignment`. 0 leaves them where they are, and so do soft and partial masks.
    least_agreement : float
        A region of a mask is not heard if a smaller share of it is of its label by the votes of the other views; see
        `gsseg_core.learn.em.rejected_regions`. 0 hears all.
    majority : float
        The first error models are counted from the votes' codes to this power: above 1, majorities stand out.
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
        if self.max_steps < 1 or self.prior_k < 1:
            raise SettingsError(f"em: max_steps is {self.max_steps}, prior_k {self.prior_k}; expected at least 1")
        if not 0 < self.outliers < 1:
            raise SettingsError(f"em: outliers is {self.outliers}; expected a share in (0, 1)")
        if not 0 <= self.least_agreement <= 1:
            raise SettingsError(f"em: least_agreement is {self.least_agreement}; expected a share in [0, 1]")
        if self.majority < 1:
            raise SettingsError(f"em: majority is {self.majority}; expected at least 1")
        if min(self.tolerance, self.error_prior, self.prior_weight, self.refits, self.edge_px) < 0:
            raise SettingsError(
                "em: tolerance, error_prior, prior_weight, refits or edge_px is negative; expected 0 or more"
            )

    @property
    def judges(self) -> bool:
        """Whether regions of masks may be in doubt."""
        return self.errors and self.least_agreement > 0


class EMLearner(Learner):
    """The default: the paper's loss with an error model, maximised by multiplicative steps that need no rate.

    Attributes
    ----------
    error_models_ : dict of str to ErrorModel
        After `fit`: what each view's segmenter got wrong.
    history_ : list of float
        After `fit`: J per labelled pixel, in nats, of what went into each step; within a round it never falls.
    rounds_ : list of int
        After `fit`: steps with each set of error models.
    """

    def __init__(
        self,
        scene: GaussianScene,
        num_classes: int,
        settings: EMSettings | None = None,
        *,
        device: str = "cpu",
        memory_budget: int = MEMORY_BUDGET,
    ) -> None:
        super().__init__(scene, num_classes, device=device, memory_budget=memory_budget)
        self.settings = settings or EMSettings()
        self.error_models_: dict[str, ErrorModel] = {}

    @property
    def loss(self) -> float:
        """-J per labelled pixel, in nats."""
        return -self.history_[-1] if self.history_ else float("nan")

    def fit(self, progress: Progress = silent) -> EMLearner:
        """Step until a step can gain no more than the tolerance."""
        settings = self.settings
        self._begin()
        votes, tell = CSRRows.from_dense(self._votes), partial(progress, "em", 0, settings.max_steps)
        doubts: dict[str, np.ndarray] = {}
        if settings.judges:
            doubted, doubts = self._judge(votes, tell)
            votes = votes.with_data(votes.data - doubted).nonzero()
        stands = resolved_votes(votes, self._possible())
        self.observed_ = np.diff(stands.indptr) > 0
        counted, prior = stands.united(self._smooth(stands))
        # Votes are the first step; with the prior counted in, the objective is finite from the start. What is zero now
        # is zero after every step, so the codes keep these places.
        codes = counted.with_data(counted.data.astype(np.float32) * np.float32(VOTE_UNIT) + prior.data).normalised()
        history: list[float] = []
        self.history_ = history
        models = self._first_models(votes, doubts, tell)
        pixels = sum(model.num_pixels for model in models.values())
        self.rounds_ = rounds = [0]
        while len(history) < settings.max_steps:
            tell = partial(progress, "em", len(history), settings.max_steps)
            gains, told = self._gains(codes, models, tell)
            history.append((_log_prior(codes.data, prior.data) + sum(told[name] for name in self.views)) / pixels)
            rounds[-1] += 1
            last = len(rounds) > settings.refits or not settings.errors
            enough = settings.tolerance * (1 if last else ROUGH) * pixels
            settled = promised(codes.indptr, codes.data, gains, prior.data) < enough
            if settled and not last:
                self._refit(codes, gains, prior.data, models, tell)
                rounds.append(0)
            improve(codes.indptr, codes.data, gains, prior.data)
            self.converged_ = settled and last
            if self.converged_:
                break
        progress("em", settings.max_steps, settings.max_steps)
        self.codes_, self.error_models_ = codes.dense(self.num_classes), models
        self._finish()
        return self

    def _heard(self, seen: SeenLabels, operator: ViewOperator) -> SeenLabels:
        """Move outlines to edges, if the mask has any; tell regions apart, if they may be in doubt."""
        settings = self.settings
        if settings.errors and settings.edge_px and seen.evidence is None:
            # Where outlines go is decided, not computed to a precision: all devices have to see the very same edges.
            drawing = operator if self.device == "cpu" else make_operator(self.scene, operator.camera)
            seen = SeenLabels(settle_outlines(seen.labels, scene_edges(drawing, self.scene), settings.edge_px))
        return by_region(seen) if settings.judges else seen

    def _judge(
        self,
        votes: CSRRows,  # int64
        tell: Callable[[], None],
        names: Iterable[str] | None = None,
    ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Find the labels of each view, or of some, that the other views speak against.

        Returns
        -------
        doubted : (Z,) int64
            Their part of each entry of the votes.
        doubts : dict of str to (L,) bool
            Which they are; views without any are left out.
        """
        left, doubts = np.zeros_like(votes.data), {}
        for name, observation in self._observations(names):
            tell()
            doubtful = in_doubt(votes, observation, self._possible(), self.settings.least_agreement)
            if doubtful.any():
                doubts[name] = doubtful
                take_back(doubtful, votes, observation, left)
        return -left, doubts

    def _first_models(
        self,
        votes: CSRRows,  # int64
        doubts: Mapping[str, np.ndarray],  # (L,) bool
        tell: Callable[[], None],
        names: Iterable[str] | None = None,
    ) -> dict[str, ErrorModel]:
        """Start an error model for each view, or for some, from what the votes of the others make of its mask."""
        models = {}
        for name, observation in self._observations(names):
            tell()
            models[name] = self._first_model(votes, observation, doubts.get(name))
        return models

    def _first_model(self, votes: CSRRows, observation: Observation, doubtful: np.ndarray | None) -> ErrorModel:
        settings, evidence = self.settings, observation.evidence
        if not settings.errors:
            return ErrorModel.trusting(evidence, self.num_classes, settings.outliers, observation.num_pixels)
        if doubtful is not None:
            evidence = evidence.without(doubtful)
        pixels = int(observation.areas[evidence.informative].sum())
        counts = counted_by_others(votes, observation, self._possible(), evidence, settings.majority)
        return ErrorModel.from_counts(evidence, counts, settings.error_prior, settings.outliers, pixels)

    def _gains(
        self,
        codes: CSRRows,
        models: dict[str, ErrorModel],
        tell: Callable[[], None],
    ) -> tuple[np.ndarray, dict[str, float]]:
        """Sum over the views of these models what they say of the codes.

        Returns
        -------
        gains : (Z,) int64
            sum_v sum_y C_v[k, y] B_v[i, y], in units of `GAIN_UNIT`, for each entry of the codes.
        told : dict of str to float
            The part of J that is each view's own, at the codes and models that came in.
        """
        gains, told = np.zeros(len(codes.data), np.int64), {}
        for name, observation in self._observations(models):
            tell()  # after each view, so that whoever listens can stop the work at once
            likelihood, taught = models[name].told
            seen = observation.order, observation.ids, observation.start, observation.labels
            shares = observation.shares(mix(*codes, *seen, likelihood), likelihood[:, 0])
            told[name] = shares.log_likelihood
            collect(codes.indptr, codes.indices, gains, *seen, taught, shares.sightings)
        return gains, told

    def _refit(
        self,
        codes: CSRRows,
        gains: np.ndarray,  # (Z,) int64, of a step at these codes and models
        prior: np.ndarray,  # (Z,) px
        models: dict[str, ErrorModel],
        tell: Callable[[], None],
    ) -> dict[str, ErrorModel]:
        """Learn each view's error model anew, from the codes that the step would give without this view."""
        for name, observation in self._observations(models):
            tell()
            model, order = models[name], observation.order
            without = codes_without(observation, model, codes, gains, prior)
            likelihood, _ = model.told
            said = mix(*without, order, _inverse(order), observation.start, observation.labels, likelihood)
            shares = observation.shares(said, likelihood[:, 0])
            seen = order, observation.start, observation.labels
            counts = tally(*without, *seen, shares.sightings, self.num_classes, len(observation.classes))
            counts[0] += shares.rest
            model.maximise(model.expected(counts))
        return models

    def _smooth(self, votes: CSRRows) -> CSRRows:
        """Weigh the mean code of those of the nearest Gaussians that were observed; rows without where none was."""
        neighbours = neighbours_of(self.scene, self.settings.prior_k)
        if neighbours is None or self.settings.prior_weight == 0:
            return CSRRows(np.zeros_like(votes.indptr), np.empty(0, np.uint32), np.empty(0, np.float32))
        codes = votes.with_data(votes.data.astype(np.float32) * np.float32(VOTE_UNIT)).normalised()
        smooth = neighbours.mean_codes(codes, self.observed_, self.num_classes).normalised()
        return smooth.with_data(np.float32(self.settings.prior_weight) * smooth.data)


def codes_without(
    observation: Observation,
    model: ErrorModel,
    codes: CSRRows,
    gains: np.ndarray,  # (Z,) int64, of a step at these codes and models
    prior: np.ndarray,  # (Z,) float32, px
) -> CSRRows:
    """Take a step of EM that leaves a view's own summand out: codes of the M Gaussians that it sees, by `order`."""
    likelihood, taught = model.told
    seen = observation.order, observation.ids, observation.start, observation.labels
    shares = observation.shares(mix(*codes, *seen, likelihood), likelihood[:, 0])
    start = starts(np.diff(codes.indptr)[observation.ids[observation.order]])
    without = CSRRows(start, np.empty(start[-1], np.uint32), np.empty(start[-1], np.float32))
    improve_without(*codes, gains, prior, *seen, taught, shares.sightings, *without)
    return without


def _inverse(
    order: np.ndarray,  # (M,) a permutation
) -> np.ndarray:
    """Tell where in the order each one comes, (M,) int32."""
    place = np.empty(len(order), np.int32)
    place[order] = np.arange(len(order), dtype=np.int32)
    return place


def _log_prior(
    codes: np.ndarray,  # (Z,)
    prior: np.ndarray,  # (Z,) px
) -> float:
    told = prior > 0
    return float((prior[told] * np.log(codes[told])).sum(dtype=np.float64))
