"""What a run tells about its classes and its views: the figures of the report page, apart from how they are shown."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from gsseg_core.align.agreement import Agreement, far_off
from gsseg_core.align.mask_fit import PIXELS
from gsseg_core.data.class_names import NOTED, class_name, listed
from gsseg_core.data.label_images import EXPECTED_IDS
from gsseg_core.data.view import View
from gsseg_core.learn.mask_reliability import ViewCheck, sum_cells
from gsseg_core.learn.renamed_ids import renamed_note
from gsseg_core.metrics import iou
from gsseg_core.text import clipped, counted

SHOWN = 1 / 2000  # of its checked pixels a class has at least in a view that shows it; less is an edge's blur
TRUSTED = 0.7  # the page warns of masks with which the other views agree in a smaller share of their pixels, ...
KNOWN_CLASS = 0.5  # ... and of classes whose IoU with the masks is smaller than this
FEW_VIEWS = 3
_SHADES, _HARDLY_ANY = 32, 10  # so many ids of fewer Gaussians than that are shades of grey
NO_OBJECTS = f"the masks name none, or contradict each other; {EXPECTED_IDS}"


class Confusion(NamedTuple):
    """Pixels of all views by class predicted and label of the mask, where there are any: (Z,) int64 each.

    They are in the order of the classes predicted, and of the labels for each. Of thousands of classes, few are taken
    for each other.
    """

    predicted: np.ndarray
    labels: np.ndarray
    pixels: np.ndarray

    def ious(self, num_classes: int) -> np.ndarray:
        """IoU of each class between prediction and masks, (K,); NaN for a class that is in neither."""
        right = self.predicted == self.labels
        both = np.bincount(self.labels[right], self.pixels[right], num_classes)
        return iou(both, *(np.bincount(side, self.pixels, num_classes) for side in (self.labels, self.predicted)))

    def largest(self, count: int) -> list[tuple[int, int, int]]:
        """List what was most often taken for something else: class predicted, label of the mask, pixels."""
        wrong = np.flatnonzero(self.predicted != self.labels)
        chosen = wrong[np.argsort(-self.pixels[wrong], kind="stable")[:count]]
        return list(zip(*(column[chosen].tolist() for column in self), strict=True))

    def most_confused(self, count: int) -> np.ndarray:
        """Choose the classes in most of which prediction and mask differ, `count` at most: ascending."""
        classes, place = np.unique(np.concatenate([self.predicted, self.labels]), return_inverse=True)
        wrong = np.bincount(place, np.tile(np.where(self.predicted != self.labels, self.pixels, 0), 2))
        return np.sort(classes[np.argsort(-wrong, kind="stable")[:count]])

    def shares(self, classes: np.ndarray) -> np.ndarray:
        """Share of the pixels of each class predicted (row) that are of each label, (C, C) for some of the classes."""
        of_class, shares = np.bincount(self.predicted, self.pixels), np.zeros((len(classes), len(classes)))
        there = np.isin(self.predicted, classes) & np.isin(self.labels, classes)
        row, column = (np.searchsorted(classes, side[there]) for side in (self.predicted, self.labels))
        shares[row, column] = self.pixels[there] / of_class[self.predicted[there]]
        return shares


@dataclass(frozen=True, eq=False)
class MaskChecks:
    """Masks beside predictions of them."""

    checks: Sequence[ViewCheck]  # with what was predicted; of all views that were learnt from, or of some
    views: Mapping[str, View]  # at least those
    held_out: bool  # whether a prediction comes from the other views alone; else also from the view itself

    def confusion(self) -> Confusion:
        """Count pixels over all views. "None of these" of a partial mask is no class, and is not counted."""
        return Confusion(*sum_cells([check.cells() for check in self.checks]))

    def views_showing(self, num_classes: int) -> np.ndarray:
        """Count the views that show each class, by what is predicted: (K,) int64."""
        views = np.zeros(num_classes, np.int64)
        for check in self.checks:
            shown = check.counts.sums()
            views += (shown > 0) & (shown >= SHOWN * check.checked)
        return views


def has_objects(report: Mapping[str, Any]) -> bool:
    """Whether a Gaussian belongs to a class that is not the background, by what `report.json` holds."""
    return any(entry["gaussians"] for entry in report["classes"] if entry["id"])


def frame_of(report: Mapping[str, Any], asked: str = "DATASET --scene SCENE") -> list[str]:
    """Say in sentences without their stops why views may not see the scene as it is; `gsseg doctor` takes `asked`."""
    told, agreement = [far_off(report["scene"].get("rounding", 0.0))], report.get("frame", {}).get("agreement")
    if agreement:
        found = Agreement(**agreement)
        doctor = f"gsseg doctor {asked}"
        if found.telling:
            advice = f"the two may be in different frames; try --align, or {doctor}"
        else:
            advice = f"look at the pictures; with photos of the views in images/, {doctor} tells"
        doubted = found.doubt and (found.agrees is False or not found.misplaced)
        told.append(found.nearness or (f"{found.doubt}: {advice}" if doubted else ""))
        told.append(found.misplaced and f"{found.misplaced}; {PIXELS}, and cameras that fit the scene")
        if masks := report["frame"].get("masks"):
            drawn = Agreement(**masks)
            what = f"{drawn.misplaced}; {PIXELS}" if drawn.misplaced else "are masks of other views, or turned?"
            if drawn.agrees is False:
                told.append(f"{drawn.doubt}, but like the photos: {what}")
            elif drawn.misplaced:
                told.append(what)
    return [sentence for sentence in told if sentence]


def grey_ids_of(report: Mapping[str, Any]) -> str:
    """Say in a sentence without its stop that ids look like shades of grey, and what to write; "" if they do not."""
    unnamed = [entry for entry in report["classes"] if entry["id"] and entry["name"] == class_name({}, entry["id"])]
    few = sum(entry["gaussians"] < _HARDLY_ANY for entry in unnamed)
    if few < _SHADES or few < len(unnamed) / 2:
        return ""
    return (
        f"{few} of the {len(unnamed)} ids in the masks got hardly a Gaussian: are they shades of grey, from masks that "
        "were blurred, or resized other than by nearest pixel? An id is a whole number, 1 and not 255 for one object; "
        "what lies between, a probability, is a soft mask (docs/masks.md)"
    )


def renamed_ids_of(report: Mapping[str, Any], written: Callable[[str], str] = clipped) -> str:
    """Say in a sentence without its stop which ids name objects that have another, and what to do; "" if none does."""
    return renamed_note(report["views"].get("renamed", ()), "--ids per-view", "--label-map", written)


def warnings_of(
    report: Mapping[str, Any], ious: np.ndarray | None, written: Callable[[str], str] = clipped
) -> list[str]:
    """Say in sentences what about a run should make its user look twice, what weighs most first.

    `report` is what `report.json` holds; `ious` (K,) are those of the classes with the masks, NaN where there is none;
    names are `written` so.
    """
    views, gaussians = report["views"], report["gaussians"]
    warnings = [] if has_objects(report) else [f"No Gaussian is part of an object: {NO_OBJECTS}."]
    if views["used"] < FEW_VIEWS:
        warnings.append(
            f"Learnt from {counted(views['used'], 'view')} only. With fewer than {FEW_VIEWS}, "
            "errors in the masks cannot be detected."
        )
    if views["rejected"]:
        reasons = ", ".join(f"{count} {why}" for why, count in views["rejected"].items())
        warnings.append(f"{counted(sum(views['rejected'].values()), 'view')} could not be used: {reasons}.")
    for told in (*frame_of(report), grey_ids_of(report) or renamed_ids_of(report, written)):
        if told:
            warnings.append(f"{told[:1].upper()}{told[1:]}.")
    doubtful = [v for v in views.get("reliability", []) if v["reliability"] is not None and v["reliability"] < TRUSTED]
    if doubtful:
        whose = "masks disagree" if len(doubtful) > 1 else "masks disagrees"
        warnings.append(
            f"{len(doubtful)} of {len(views['reliability'])} {whose} with the other views in more than "
            f"{100 - round(100 * TRUSTED)} % of {'their' if len(doubtful) > 1 else 'its'} pixels: "
            f"{listed((view['name'] for view in doubtful), NOTED, written)}. Wrong ids, a wrong pose, or a mask "
            "of another image?"
        )
    names = dict(enumerate(entry["name"] for entry in report["classes"]))
    empty = {k: names[k] for k, entry in enumerate(report["classes"]) if entry["id"] and not entry["gaussians"]}
    if empty and report.get("ids"):
        warnings.append(
            f"{len(empty):,} of {counted(report['ids']['objects'], 'object')} that were found got no Gaussian, since "
            f"other views give what their masks show to other objects: {listed(empty.values(), NOTED, written)}."
        )
    elif empty:
        warnings.append(
            f"{counted(len(empty), 'class', 'classes')} got no Gaussian: {listed(empty.values(), NOTED, written)}."
        )
    if ious is not None:
        told_of = names.keys() - empty.keys()
        weak = [names[k] for k in np.argsort(ious).tolist() if k in told_of and ious[k] < KNOWN_CLASS]
        if weak:
            warnings.append(
                f"In {counted(len(weak), 'class', 'classes')}, masks and prediction overlap by less than half "
                f"(IoU below {KNOWN_CLASS:g}): {listed(weak, NOTED, written)}."
            )
    total = max(report["scene"]["gaussians"], 1)
    if gaussians["unobserved"] > 0.02 * total:
        warnings.append(
            f"{100 * gaussians['unobserved'] / total:.0f} % of the Gaussians are covered by no mask and have no "
            "neighbour that is; they have no class."
        )
    return warnings
