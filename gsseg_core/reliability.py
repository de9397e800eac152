"""How far each view's mask can be trusted: what the other views say of it, pixel by pixel.

The codes that learnt from a mask agree with its errors, so a mask is held against codes that have not seen it: one
more step of EM from the codes that were learnt, without the summand of this view (see `gsseg_core.em`). Rendered from
where the view was taken, they predict its labels. A view's reliability is the share of its pixels whose label is the
one predicted. It is an estimate of the share whose label is right.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gsseg_core.dataset import View
from gsseg_core.em import EMLearner, codes_without
from gsseg_core.export import background_image
from gsseg_core.learner import Progress, silent
from gsseg_core.masks import UNKNOWN
from gsseg_core.operator import make_operator
from gsseg_core.pictures import contact_sheet, overlay, palette
from gsseg_core.rows import Rows

CONFUSIONS = 3
"""Most confusions that the report of a view names."""

_DIFFERENT = np.array([[0, 0, 0], [230, 40, 40]], np.uint8)


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
        Labels that occur in the mask, ascending.
    counts : (K, L) int64
        Of the pixels with a label of which the other views say something: how many by class predicted (row) and by
        label (column).
    """

    name: str
    num_pixels: int
    classes: np.ndarray
    counts: np.ndarray

    @property
    def checked(self) -> int:
        """Pixels with a label of which the other views say something."""
        return int(self.counts.sum())

    @property
    def reliability(self) -> float:
        """Share of the checked pixels whose label is the one predicted, in [0, 1]; NaN where there is none."""
        return float(self._right.sum() / self.checked) if self.checked else math.nan

    @property
    def agreement(self) -> np.ndarray:
        """Share of the pixels predicted as each class that carry its label, (K,); NaN where none is predicted."""
        right = np.zeros(len(self.counts))
        right[self.classes] = self._right
        shown = self.counts.sum(axis=1)
        share: np.ndarray = np.divide(right, shown, out=np.full(len(shown), np.nan), where=shown > 0)
        return share

    def confusions(self, count: int = CONFUSIONS) -> list[tuple[int, int, float]]:
        """Give what was most often taken for something else: class predicted, label seen, share of checked pixels."""
        wrong = self.counts.copy()
        wrong[self.classes, np.arange(len(self.classes))] = 0
        largest = np.argsort(-wrong, axis=None, kind="stable")[:count]
        return [
            (k, int(self.classes[y]), float(wrong[k, y] / self.checked))
            for k, y in zip(*(index.tolist() for index in np.unravel_index(largest, wrong.shape)), strict=True)
            if wrong[k, y]
        ]

    @property
    def _right(self) -> np.ndarray:
        right: np.ndarray = self.counts[self.classes, np.arange(len(self.classes))]
        return right


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
        self._codes = Rows.of(learner.codes_)
        self._shows_background = bool((self._codes.classes == 0).any())
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
        learner = self.learner
        # No prior: where no other view has seen anything, nothing is to be said.
        model = learner.error_models_[view.name]
        without, places = codes_without(learner.observation(view.name), model, self._codes, self._gains)
        codes = self._codes.values.copy()
        codes[places] = without.values
        operator = make_operator(learner.scene, view.camera, learner.device)
        image, left_over = operator.blend_rows(self._codes.with_values(codes), learner.num_classes)
        if self._shows_background:
            image[..., 0] += left_over
        labels: np.ndarray = np.where(image.sum(axis=2) > 0.5, image.argmax(axis=2), UNKNOWN).astype(np.int32)
        return labels

    def check(self, view: View) -> ViewCheck:
        """Hold a view's mask against what the others predict."""
        return _compare(view.name, view.read_labels(), self.predict(view), self.learner.num_classes)

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
        `name`; `reliability` in [0, 1], None where the other views say nothing; `num_pixels` with a label;
        `confusions`, largest first: `true`, the class that the others predict, `seen` as, and the `share` of the
        view's checked pixels.
    """
    return [
        {
            "name": check.name,
            "reliability": round(check.reliability, 4) if check.checked else None,
            "num_pixels": check.num_pixels,
            "confusions": [
                {"true": _name(class_names, k), "seen": _name(class_names, y), "share": round(share, 4)}
                for k, y, share in check.confusions()
            ],
        }
        for check in worst_views(checks)
    ]


def draw_worst_views(others: OtherViews, checks: Sequence[ViewCheck], count: int = 4) -> np.ndarray:
    """Draw the worst views: the mask, what the other views predict, and in red where the two differ.

    Parameters
    ----------
    others : OtherViews
        Of the learner.
    checks : sequence of ViewCheck
        Of all its views, or of some; at least one.
    count : int
        Views at most, one a row.

    Returns
    -------
    (H, W, 3) uint8
    """
    learner, images, captions = others.learner, [], []
    colors = palette(learner.num_classes)
    for check in worst_views(checks, count):
        view = learner.views[check.name]
        image = background_image(learner.scene, make_operator(learner.scene, view.camera, learner.device))
        mask, predicted = view.read_labels(), others.predict(view)
        different = ((mask != predicted) & (mask != UNKNOWN) & (predicted != UNKNOWN)).astype(np.int32)
        images += [overlay(image, mask, colors), overlay(image, predicted, colors)]
        images.append(overlay(image, different, _DIFFERENT))
        trusted = f"{100 * check.reliability:.0f} % reliable" if check.checked else "unchecked"
        captions += [f"{check.name}: {trusted}", "what the other views say", "where they differ"]
    return contact_sheet(images, captions, 3)


def _compare(name: str, labels: np.ndarray, predicted: np.ndarray, num_classes: int) -> ViewCheck:
    known = labels >= 0
    classes = np.unique(labels[known]).astype(np.int32)
    both = known & (predicted >= 0)
    cells = predicted[both] * np.int64(len(classes)) + np.searchsorted(classes, labels[both])
    counts = np.bincount(cells, minlength=num_classes * len(classes)).reshape(num_classes, len(classes))
    return ViewCheck(name, int(known.sum()), classes, counts)


def _name(class_names: Mapping[int, str], label: int) -> str:
    return class_names.get(label, f"class_{label:02d}")
