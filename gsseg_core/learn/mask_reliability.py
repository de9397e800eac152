"""How far each view's mask can be trusted: what the other views say of it, pixel by pixel.

The codes that learnt from a mask agree with its errors, so a mask is held against codes that have not seen it: one
more step of EM from the codes that were learnt, without the summand of this view (see
`gsseg_core.learn.em.em_learner`). Rendered from where the view was taken, they predict its labels. A view's reliability
is the share of its pixels whose label is the one predicted. It is an estimate of the share whose label is right. Of a
soft mask, a pixel's label is its largest share; in a partial one "none of those looked for" is a label too, and right
where a class is predicted that was not looked for.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.class_names import class_name
from gsseg_core.data.label_evidence import LabelEvidence
from gsseg_core.data.label_images import UNKNOWN, PackedLabels
from gsseg_core.data.view import View, spread
from gsseg_core.learn.em.em_learner import EMLearner, codes_without
from gsseg_core.learn.learner import Progress, silent
from gsseg_core.learn.temperature import VIEWS, Sample, sample_pixels
from gsseg_core.raster.backends import make_operator

CONFUSIONS = 3
"""Most confusions that the report of a view names."""


@dataclass(frozen=True, eq=False)
class ViewCheck:
    """A view's mask beside what the other views predict.

    Attributes
    ----------
    name : str
        Of the view.
    num_pixels : int
        Pixels with a label.
    classes : (L,) int32
        Labels that occur in the mask, ascending; of a partial one, `UNKNOWN` (-1) at last for "none of these".
    counts : (K, L) int64
        Of the pixels with a label of which the other views say something: how many by class predicted (row) and by
        label (column).
    predicted : PackedLabels, optional
        What the other views predict, (H, W), for pictures.
    evidence : LabelEvidence, optional
        Of a soft or partial mask; `classes` are its vocabulary.
    unheard : float
        Share of the pixels with a label from which nothing was learnt, since they lie in regions in doubt; see
        `gsseg_core.learn.em.rejected_regions`.
    """

    name: str
    num_pixels: int
    classes: np.ndarray
    counts: np.ndarray
    predicted: PackedLabels | None = None
    evidence: LabelEvidence | None = None
    unheard: float = 0.0

    @property
    def checked(self) -> int:
        """Pixels with a label of which the other views say something."""
        return int(self.counts.sum())

    @property
    def reliability(self) -> float:
        """Share of the checked pixels whose label is the one predicted, in [0, 1]; NaN where there is none."""
        return float(self.counts[self._right].sum() / self.checked) if self.checked else math.nan

    @property
    def agreement(self) -> np.ndarray:
        """Share of the pixels predicted as each class that carry its label, (K,); NaN where none is predicted."""
        right = np.zeros(len(self.counts))
        right[self._right[0]] = self.counts[self._right]
        shown = self.counts.sum(axis=1)
        share: np.ndarray = np.divide(right, shown, out=np.full(len(shown), np.nan), where=shown > 0)
        return share

    def prediction(self) -> np.ndarray:
        """Unpack what the other views predict, (H, W) int32."""
        assert self.predicted is not None, f"check of {self.name} came without its prediction"
        return self.predicted.unpack()

    def confusions(self, count: int = CONFUSIONS) -> list[tuple[int, int, float]]:
        """Give what was most often taken for something else: class predicted, label seen, share of checked pixels."""
        wrong = self.counts.copy()
        wrong[self._right] = 0
        largest = np.argsort(-wrong, axis=None, kind="stable")[:count]
        return [
            (k, int(self.classes[y]), float(wrong[k, y] / self.checked))
            for k, y in zip(*(index.tolist() for index in np.unravel_index(largest, wrong.shape)), strict=True)
            if wrong[k, y]
        ]

    @property
    def _right(self) -> tuple[np.ndarray, np.ndarray]:
        """Where in the counts class and label agree."""
        return (self.evidence or LabelEvidence(self.classes)).correct_words(len(self.counts))


class OtherViews:
    """What all views but one say, for each view of a fitted learner.

    Parameters
    ----------
    learner : EMLearner
        After `fit`. It must not learn on while this is in use.
    progress : callable, optional
        Told of every view.
    """

    def __init__(self, learner: EMLearner, progress: Progress = silent) -> None:
        self.learner = learner
        self._sampled = {view.name for view in spread(list(learner.views.values()), VIEWS)}
        self._samples: dict[str, Sample] = {}
        self._codes = CSRRows.from_dense(learner.codes_)
        # Where no other view has seen anything, nothing is to be said.
        self._prior = np.zeros_like(self._codes.data)
        self._shows_background = bool((self._codes.indices == 0).any())
        total = len(learner.views)
        done = itertools.count()
        self._gains, _ = learner._gains(
            self._codes, learner.error_models_, lambda: progress("sum up views", min(next(done), total - 1), total)
        )
        progress("sum up views", total, total)

    def predict(self, view: View) -> np.ndarray:
        """Predict a view's labels from all the others.

        Returns
        -------
        (H, W) int32
            `UNKNOWN` (-1) where they say nothing: most of the ray ends on Gaussians that only this view has seen.
        """
        return _strongest(self.blend(view))

    def blend(self, view: View) -> np.ndarray:
        """Blend what all the others say into a view, (H, W, K) float32; rows sum to less where they are silent."""
        learner = self.learner
        model = learner.error_models_[view.name]
        observation, codes = learner.observation(view.name), self._codes.data.copy()
        places = self._codes.positions(observation.ids[observation.order]).data
        codes[places] = codes_without(observation, model, self._codes, self._gains, self._prior).data
        operator = make_operator(learner.scene, view.camera, learner.device)
        image, left_over = operator.blend_rows(self._codes.with_data(codes), learner.num_classes)
        if self._shows_background:
            image[..., 0] += left_over
        return image

    def check(self, view: View) -> ViewCheck:
        """Hold a view's mask against what the others predict."""
        image = self.blend(view)
        if view.name in self._sampled:
            self._samples[view.name] = sample_pixels(image, view.read_labels())
        check = hold_against(view, _strongest(image), self.learner.num_classes)
        evidence, areas = self.learner.error_models_[view.name].evidence, self.learner.observation(view.name).areas
        return replace(check, unheard=float(areas[~evidence.informative].sum() / areas.sum()))

    def sample(self, view: View) -> Sample:
        """Take pixels of a view's mask with what the others predict of them, to fit the temperature to."""
        if view.name not in self._samples:
            self._samples[view.name] = sample_pixels(self.blend(view), view.read_labels())
        return self._samples[view.name]

    def check_all(self, progress: Progress = silent) -> list[ViewCheck]:
        """Do that for all views, in their order."""
        checks, views = [], self.learner.views
        for done, view in enumerate(views.values()):
            progress("check views", done, len(views))
            checks.append(self.check(view))
        progress("check views", len(views), len(views))
        return checks


def check_views(learner: EMLearner, progress: Progress = silent) -> list[ViewCheck]:
    """Hold each view's mask against what the others predict; see `worst_views` and `reliability_report`.

    Parameters
    ----------
    learner : EMLearner
        After `fit`.
    progress : callable, optional
        Told of every view.

    Returns
    -------
    list of ViewCheck
        In the order of the views.
    """
    return OtherViews(learner, progress).check_all(progress)


def worst_views(checks: Iterable[ViewCheck], count: int | None = None) -> list[ViewCheck]:
    """Sort views by reliability, the worst first; those that nothing is known of come last.

    Parameters
    ----------
    checks : iterable of ViewCheck
        Of `check_views`.
    count : int, optional
        So many at most; all by default.
    """
    return sorted(checks, key=lambda check: (not check.checked, check.reliability))[:count]


def reliability_report(checks: Iterable[ViewCheck], class_names: Mapping[int, str]) -> list[dict[str, Any]]:
    """Say for `report.json` how far each view can be trusted, the worst first.

    Returns
    -------
    list of dict
        `name`; `reliability` in [0, 1], None where the other views say nothing; `num_pixels` with a label; `unheard`,
        the share of them from which nothing was learnt;
        `confusions`, largest first: `true`, the class that the others predict, `seen` as, and the `share` of the
        view's checked pixels.
    """
    return [
        {
            "name": check.name,
            "reliability": round(check.reliability, 4) if check.checked else None,
            "num_pixels": check.num_pixels,
            "unheard": round(check.unheard, 4),
            "confusions": [
                {"true": _name(class_names, k), "seen": _name(class_names, y), "share": round(share, 4)}
                for k, y, share in check.confusions()
            ],
        }
        for check in worst_views(checks)
    ]


def _strongest(
    image: np.ndarray,  # (H, W, K)
) -> np.ndarray:
    labels: np.ndarray = np.where(image.sum(axis=2) > 0.5, image.argmax(axis=2), UNKNOWN).astype(np.int32)
    return labels


def hold_against(
    view: View,
    predicted: np.ndarray,  # (H, W) int32
    num_classes: int,
) -> ViewCheck:
    """Hold a view's mask against any prediction of its labels, `UNKNOWN` (-1) where that says nothing."""
    seen = view.read_seen()
    labels, evidence = seen.named(), seen.evidence
    # Where a partial mask names no class, it says "none of these", its last word.
    unnamed = (seen.labels >= 0) & (labels < 0) if evidence is not None and evidence.has_none_of_these else np.False_
    known = (labels >= 0) | unnamed
    classes = np.unique(labels[labels >= 0]).astype(np.int32) if evidence is None else evidence.vocabulary
    both = known & (predicted >= 0)
    words = np.where(labels >= 0, np.searchsorted(classes[classes >= 0], labels), len(classes) - 1)
    cells = predicted[both] * np.int64(len(classes)) + words[both]
    counts = np.bincount(cells, minlength=num_classes * len(classes)).reshape(num_classes, len(classes))
    return ViewCheck(view.name, int(known.sum()), classes, counts, PackedLabels(predicted), evidence)


def _name(class_names: Mapping[int, str], label: int) -> str:
    return class_name(class_names, label) if label >= 0 else "none of these"
