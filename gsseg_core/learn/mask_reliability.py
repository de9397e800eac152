"""Mask reliability: the share of each view's labelled pixels whose label the other views predict.

Probabilities that were fitted to a mask agree with its errors. So each mask is compared with a rendering of
probabilities that were learnt without it (`Learner.predict_without`). The share estimates how many of its labels are
right. In a soft mask, the label of a pixel is its likeliest class. In a partial mask, "none of the classes looked for"
is also a label, and it is right if the predicted class was not looked for.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from gsseg_core.csr_rows import CSRRows, starts
from gsseg_core.data.class_names import class_name
from gsseg_core.data.label_evidence import LabelEvidence
from gsseg_core.data.label_images import UNKNOWN, PackedLabels
from gsseg_core.data.soft_masks import SeenLabels
from gsseg_core.data.view import View, spread
from gsseg_core.errors import MaskFormatError
from gsseg_core.kernels.compiler import kernel
from gsseg_core.learn.learner import Learner
from gsseg_core.learn.temperature import VIEWS, Sample, grid_of, sample_grid
from gsseg_core.progress import Progress, silent
from gsseg_core.raster.view_renderer import NO_PIXELS
from gsseg_core.scene.camera import Camera
from gsseg_core.several_at_once import each_with_made, several_at_once

WORST = 4  # number of least reliable views that are shown in pictures
_LARGE = 1 << 17  # px; every third tile of a larger view is compared
_TILE = 16  # px a side

Cells = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Non-zero counts: predicted class, label, and number of pixels, (Z,) int64 each."""


@dataclass(frozen=True, eq=False)
class ViewCheck:
    """Comparison of a view's mask with the prediction of the other views.

    `counts` is a confusion matrix: the labelled pixels with a prediction, by predicted class (row) and label (column).
    It is sparse, because few of thousands of classes are confused.
    """

    name: str
    num_pixels: int  # with a label
    classes: np.ndarray  # (L,) int32: labels in the mask, ascending; a partial mask has "none of these" (-1) last
    counts: CSRRows  # K rows of non-zero int64, L columns
    predicted: PackedLabels | None = None  # (H, W): prediction of the other views, for pictures
    evidence: LabelEvidence | None = None  # of a soft or partial mask; `classes` are its vocabulary
    rejected: float = 0.0  # `Learner.rejected_share`
    # (C,) int32: classes cut off by the image border: those with border pixels where mask and prediction agree.
    cut: np.ndarray = field(default_factory=lambda: np.empty(0, np.int32))

    @property
    def checked(self) -> int:
        """Number of labelled pixels with a prediction."""
        return int(self.counts.data.sum())

    @property
    def reliability(self) -> float:
        """Share of the checked pixels whose label is the predicted one, in [0, 1]; NaN if no pixel was checked."""
        return float(self.counts.data[self._right].sum() / self.checked) if self.checked else math.nan

    def prediction(self) -> np.ndarray:
        """Unpack the prediction of the other views, (H, W) int32."""
        assert self.predicted is not None, f"check of {self.name} came without its prediction"
        return self.predicted.unpack()

    def completed(self, mask: np.ndarray) -> np.ndarray:  # (H, W) int32
        """Return the prediction, with a guess where there is none, as in most tiles of a large view; (H, W) int32.

        The guess is taken from the predictions one tile away: the label of the mask if one of them has it, else any.
        """
        predicted = self.prediction()
        unknown = predicted == UNKNOWN
        if not unknown.any():
            return predicted
        around = np.pad(predicted, _TILE, constant_values=UNKNOWN)
        inside, before, behind = slice(_TILE, -_TILE), slice(None, -2 * _TILE), slice(2 * _TILE, None)
        # Compared tiles lie on diagonals: in these six directions, each other tile has three compared ones next to it.
        straight = (inside, before), (inside, behind), (before, inside), (behind, inside)
        for place in (*straight, (before, behind), (behind, before)):
            beside = around[place]
            predicted = np.where(unknown & ((predicted == UNKNOWN) | (beside == mask)), beside, predicted)
        return predicted

    def cells(self) -> Cells:
        """List the non-zero counts of labels that are classes."""
        labels = self.classes[self.counts.indices].astype(np.int64)
        named = labels >= 0
        return self.counts.rows[named], labels[named], self.counts.data[named]

    def confusions(self, count: int = 3) -> list[tuple[int, int, float]]:
        """List the most frequent confusions: predicted class, label in the mask, share of checked pixels."""
        wrong = np.flatnonzero(~self._right)
        largest = wrong[np.argsort(-self.counts.data[wrong], kind="stable")[:count]]
        predicted, labels = self.counts.rows[largest].tolist(), self.classes[self.counts.indices[largest]].tolist()
        return list(zip(predicted, labels, (self.counts.data[largest] / self.checked).tolist(), strict=True))

    @property
    def _right(self) -> np.ndarray:
        """Mark the counts of pixels whose label is the predicted one, (Z,) bool."""
        own = np.full(self.counts.num_rows, UNKNOWN)
        classes, words = (self.evidence or LabelEvidence(self.classes)).correct_words(len(own))
        own[classes] = words
        return np.asarray(own[self.counts.rows] == self.counts.indices)


def sum_cells(cells: Sequence[Cells]) -> Cells:
    """Add up the cells of some views; the result is sorted by predicted class, then by label."""
    predicted, labels, pixels = map(np.concatenate, zip(*cells, strict=True))
    pairs, place = np.unique(predicted << 32 | labels, return_inverse=True)
    return pairs >> 32, pairs & 0xFFFFFFFF, np.bincount(place, pixels).astype(np.int64)


class MaskChecker:
    """Compares masks of a learner, after `fit`, with its prediction without them; the learner must not change after."""

    def __init__(self, learner: Learner) -> None:
        self.learner = learner
        self._sampled = {view.name for view in spread(list(learner.views.values()), VIEWS)}
        self._samples: dict[str, Sample] = {}
        self.sampled_checks: dict[str, ViewCheck] = {}  # by name, for views that were passed to `sample`

    def sample(self, view: View) -> Sample:
        """Return pixels of a view's mask with their predicted probabilities, for the fit of the temperature."""
        if view.name not in self._samples:
            self._sampled.add(view.name)
            self.sampled_checks[view.name] = self._check(view)
        return self._samples[view.name]

    def check_all(self, progress: Progress = silent) -> list[ViewCheck]:
        """Compare all masks with their predictions, in the order of the views.

        A prediction is unknown where most of a ray ends on Gaussians that only this view has seen. To save time, it is
        also unknown where the mask has no label, and in two of three tiles of 16 x 16 pixels of a large view; views in
        `shown_views` are predicted completely.
        """
        views, device = self.learner.views, self.learner.device
        checked = each_with_made(self._check, views.values(), device, progress, "check views")
        checks = {view.name: check for view, check in checked}
        shown = shown_views(list(checks.values()))
        again = [views[check.name] for check in shown if not _is_of_all(check, views[check.name].camera)]
        with closing(several_at_once(self._everywhere, again, device)) as predicted:
            for view, everywhere in zip(again, predicted, strict=True):
                checks[view.name] = replace(checks[view.name], predicted=everywhere)
        return list(checks.values())

    def _check(self, view: View) -> ViewCheck:
        """Compare a view's mask with its prediction at labelled pixels."""
        learner, seen, is_sampled = self.learner, view.read_seen(), view.name in self._sampled
        wanted = _compared(seen.labels)
        grid = grid_of(view.camera.height, view.camera.width) if is_sampled else NO_PIXELS
        found = learner.strongest_without(view, wanted, grid)
        if is_sampled:
            self._samples[view.name] = sample_grid(found.on_grid, grid.of(np.where(wanted, seen.named(), UNKNOWN)))
        predicted = found.labels()
        predicted[~wanted] = UNKNOWN
        check = compare_mask(view, predicted, learner.num_classes, seen)
        return replace(check, rejected=learner.rejected_share(view))

    def _everywhere(self, view: View) -> PackedLabels:
        """Predict the class of every pixel of a view that is shown, also of pixels that are not compared."""
        labelled = view.read_seen().labels >= 0
        return PackedLabels(self.learner.strongest_without(view, labelled if labelled.all() else None).labels())


def _is_of_all(check: ViewCheck, camera: Camera) -> bool:
    """Return whether all pixels of a view were compared."""
    return check.num_pixels == camera.width * camera.height <= _LARGE


def _compared(labels: np.ndarray) -> np.ndarray:  # (H, W)
    """Choose the pixels of a mask to compare, (H, W) bool: for large masks a third of them is enough."""
    wanted: np.ndarray = labels >= 0
    if wanted.size > _LARGE:
        # The tiles on the main diagonal are included, and so every grid of `grid_of` has compared pixels.
        rows, columns = (np.arange(size) // _TILE % 3 for size in wanted.shape)
        wanted &= np.equal.outer(rows, columns)
    return wanted


def worst_views(checks: Iterable[ViewCheck], count: int | None = None) -> list[ViewCheck]:
    """Sort views by reliability, worst first and unchecked ones last; return all, or the first `count`."""
    return sorted(checks, key=lambda check: (not check.checked, check.reliability))[:count]


def ranked_examples(checks: Iterable[ViewCheck]) -> list[tuple[str, ViewCheck]]:
    """Choose the worst, the median and the best view by reliability; fewer if there are fewer."""
    ranked = [check for check in worst_views(checks) if check.checked]
    places = {0: "worst", len(ranked) // 2: "median", len(ranked) - 1: "best"}
    return [(what, ranked[place]) for place, what in sorted(places.items()) if ranked]


def shown_views(checks: Iterable[ViewCheck]) -> list[ViewCheck]:
    """Choose the views whose masks and predictions are shown in pictures: the worst and the ranked examples."""
    shown = {check.name: check for check in worst_views(checks, WORST)}
    shown |= {check.name: check for _, check in ranked_examples(checks)}
    return list(shown.values())


def reliability_report(checks: Iterable[ViewCheck], class_names: Mapping[int, str]) -> list[dict[str, Any]]:
    """Return the reliability of each view for `report.json`, worst first.

    Each entry has the view's `name`; `reliability` in [0, 1], None if there is no prediction; `num_pixels`, the number
    of labelled pixels; `rejected_share`, the share of these whose label was rejected; and `confusions`, largest first:
    `true`, the class that the other views predict; `seen`, the label in the mask; and `share` of the checked pixels.
    """

    def name(label: int) -> str:
        return class_name(class_names, label) if label >= 0 else "none of these"

    return [
        {
            "name": check.name,
            "reliability": round(check.reliability, 4) if check.checked else None,
            "num_pixels": check.num_pixels,
            "rejected_share": round(check.rejected, 4),
            "confusions": [
                {"true": name(k), "seen": name(y), "share": round(share, 6)} for k, y, share in check.confusions()
            ],
        }
        for check in worst_views(checks)
    ]


def compare_mask(
    view: View, predicted: np.ndarray, num_classes: int, seen: SeenLabels | None = None  # (H, W) int32
) -> ViewCheck:  # fmt: skip
    """Compare a view's mask with any prediction of its labels, `UNKNOWN` (-1) where there is none.

    The mask is read if `seen` is None. Raises `MaskFormatError` for a prediction of another size or other classes.
    """
    seen = seen or view.read_seen()
    labels, evidence = seen.named(), seen.evidence
    fits = predicted.shape == labels.shape and predicted.dtype.kind in "iu"
    if not (fits and predicted.min() >= UNKNOWN and predicted.max() < num_classes):
        found = f"{predicted.dtype} {predicted.min(initial=0)} to {predicted.max(initial=0)} of shape {predicted.shape}"
        expected = f"integers {UNKNOWN} to {num_classes - 1} of shape {labels.shape}"
        raise MaskFormatError(f"view '{view.name}': prediction is {found}; expected {expected}")
    width = int(max(labels.max(initial=-1), -1 if evidence is None else evidence.classes.max(initial=-1))) + 1
    (rows, row), (columns, column) = _occurring(predicted, num_classes), _occurring(labels, width)
    table = np.zeros((len(rows) + 1, len(columns) + 2), np.int64)
    _count_pixels(predicted, labels, seen.labels, row, column, table)
    classes = columns.astype(np.int32) if evidence is None else evidence.vocabulary
    known = table[:, : len(columns) + 1 if evidence is not None and evidence.has_none_of_these else len(columns)]
    places = np.where(classes >= 0, column[classes], len(columns))
    occurs = np.flatnonzero(places >= 0)
    few, lengths = CSRRows.from_dense(table[1:, places[occurs]]), np.zeros(num_classes, np.int64)
    lengths[rows] = np.diff(few.indptr)
    counts = CSRRows(starts(lengths), occurs[few.indices].astype(np.uint32), few.data)
    at_border = [np.concatenate([one[0], one[-1], one[:, 0], one[:, -1]]) for one in (labels, predicted)]
    cut = np.unique(at_border[0][(at_border[0] == at_border[1]) & (at_border[0] >= 0)])
    return ViewCheck(view.name, int(known.sum()), classes, counts, PackedLabels(predicted), evidence, cut=cut)


def _occurring(labels: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:  # (H, W)
    """Find which of `count` classes occur, (C,) ascending, and the position of each class among these, (count + 1,).

    The position is -1 for classes that do not occur, and for `UNKNOWN`, the last entry. Only classes that occur get a
    row in the confusion matrix: with tens of thousands of classes, a matrix of all would take gigabytes.
    """
    occurs = np.zeros(count + 1, np.bool_)
    _mark(labels, occurs)
    present = np.flatnonzero(occurs[:-1])
    place = np.full(count + 1, UNKNOWN)
    place[present] = np.arange(len(present))
    return present, place


@kernel
def _mark(labels: np.ndarray, occurs: np.ndarray) -> None:  # (H, W), -1 indexes the last entry; out
    for y in range(labels.shape[0]):
        for x in range(labels.shape[1]):
            occurs[labels[y, x]] = True


@kernel
def _count_pixels(
    predicted: np.ndarray, labels: np.ndarray, seen: np.ndarray,  # (H, W) each
    row: np.ndarray, column: np.ndarray,  # (K + 1,), (W + 1,): positions from `_occurring`
    table: np.ndarray,  # (R + 1, C + 2) out
) -> None:  # fmt: skip
    """Count pixels by predicted class (first row: none) and by label.

    Pixels of a partial mask that name no class count in the last column but one if they have the label "none of these",
    and in the last column if they have no label.
    """
    width = table.shape[1] - 2
    for y in range(labels.shape[0]):
        for x in range(labels.shape[1]):
            unnamed = width if seen[y, x] >= 0 else width + 1
            table[row[predicted[y, x]] + 1, column[labels[y, x]] if labels[y, x] >= 0 else unnamed] += 1
