"""What each section of the report page tells; `sections.html.j2` has the macro that shows it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from gsseg_core.data.object_tree import ObjectTree
from gsseg_core.export.pictures import FAINT_INK, overlay, palette, shown_at
from gsseg_core.learn.mask_reliability import ranked_examples
from gsseg_core.report.findings import TRUSTED, Confusion, MaskChecks
from gsseg_core.report.pictures import PICTURE_PX, THUMBNAIL_PX, ViewImages, draw_triple, jpeg_uri, thumbnails
from gsseg_core.report.preview import look_from, make_preview, up_of
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import REMOVED, UNOBSERVED, Segmentation

LOOKS = 8  # views from which the preview can be looked at
POSTER_PX = 640  # longest side of the picture that is there until the preview is
MOST_THUMBNAILS = 200  # classes with a picture, those with the most Gaussians: the page should stay small
MANY = 15  # more classes than this are listed in small rows, so that 40 fit on a screen
BINS = 25
MATRIX_CLASSES = 24  # the matrix shows so many of the classes that are confused most
PAIRS = 10
WORST = 8

_NO_CLASS = {UNOBSERVED: "in no mask", REMOVED: "taken out"}

Content = Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class PageInputs:
    """What the report page is made from."""

    report: Mapping[str, Any]  # what `report.json` holds
    scene: GaussianScene  # what was segmented
    segmentation: Segmentation  # what came out
    checked: MaskChecks  # masks beside predictions of them
    images: ViewImages  # what was seen from the views

    @cached_property
    def colors(self) -> np.ndarray:
        """Colours of the classes, (K, 3) uint8."""
        return palette(self.segmentation.num_classes)

    @cached_property
    def confusion(self) -> Confusion | None:
        """What the masks' pixels were predicted to be; None where no mask was checked."""
        return self.checked.confusion() if self.checked.checks else None

    @cached_property
    def ious(self) -> np.ndarray | None:
        """IoU of each class with the masks, (K,), NaN for a class that is nowhere; None where no mask was checked."""
        return None if self.confusion is None else self.confusion.ious(self.segmentation.num_classes)

    @cached_property
    def nodes(self) -> list[tuple[int, str, int]]:
        """Number, name and Gaussians of each class, and after them of its parts and wholes."""
        tree, names, counts = self.segmentation.tree, self.segmentation.class_names, self.segmentation.counts()
        classes = [(k, name, int(counts[k])) for k, name in names.items()]
        if tree is None:
            return classes
        others = tree.describe(names, tree.sizes(self.segmentation.labels))
        return classes + [(one["id"], one["name"], one["gaussians"]) for one in others]

    @property
    def reliability(self) -> list[Mapping[str, Any]]:
        """What `report.json` says of the reliability of views, the worst first; empty where that is not known."""
        return self.report["views"].get("reliability") or []


def preview(run: PageInputs) -> Content:
    """Gaussians to look at in 3D, what to colour and hide, and where to look from."""
    scene, segmentation, views, tree = run.scene, run.segmentation, run.checked.views, run.segmentation.tree
    num_classes = first = segmentation.num_classes  # To count them takes as long as to list them.
    colors, levels = run.colors, list[dict[str, Any]]()
    if tree is not None and len(tree.granularities) > 1:
        first, colors = len(tree), palette(len(tree))
        levels = [_level(tree, granularity) for granularity in tree.granularities]
    shown = make_preview(scene, segmentation, parts=bool(levels))
    # The more classes a view shows, the better it is to begin with.
    ranked = sorted(
        run.checked.checks,
        key=lambda check: (-np.count_nonzero(check.counts.sums()), -np.nan_to_num(check.reliability)),
    )
    cameras = [views[check.name].camera for check in ranked[:LOOKS]]
    poster = None
    if ranked:
        view = views[ranked[0].name]
        seen, predicted = shown_at(POSTER_PX, run.images.of(view), ranked[0].completed(view.read_labels()))
        poster = overlay(seen, predicted, run.colors)
    legend = [
        {"label": k, "name": name, "color": colors[k].tolist(), "count": count, "now": k < num_classes}
        for k, name, count in run.nodes
    ]
    for i, (label, name) in enumerate(_NO_CLASS.items()):
        count = int((segmentation.labels == label).sum())
        legend.append({"label": first + i, "name": name, "color": FAINT_INK, "count": count, "now": True})
    return {
        "data": {
            **shown.header(),
            "cameras": look_from(cameras, shown),
            "up": up_of(view.camera for view in views.values()),
            "colors": [*colors.tolist(), FAINT_INK],
            "removed": first + 1,
            "levels": levels,
        },
        "records": shown.as_text(),
        "legend": [entry for entry in legend if entry["count"]],
        "many": MANY,
        "objects": next((i for i, level in enumerate(levels) if level["name"] == "objects"), None),
        "cameras": [camera.name for camera in cameras],
        "poster": jpeg_uri(poster, POSTER_PX) if poster is not None else "",
        "extent": f"{len(shown.records):,} of {len(scene):,} Gaussians" if shown.left_out else "All Gaussians",
    }


def _level(tree: ObjectTree, granularity: float) -> dict[str, Any]:
    """Name a level, list the nodes that it shows, and for each node the one that stands for it."""
    table = tree.cut(granularity)
    shown = np.unique(table[tree.leaves[tree.leaves >= 0]])
    return {"name": tree.level_name(granularity), "shown": shown.tolist(), "nodes": table.tolist()}


def views_shown(run: PageInputs) -> Content | None:
    """Show some views three times: their mask, the prediction, and where the two differ."""
    confusions = {view["name"]: view["confusions"] for view in run.reliability}
    source = "what the other views predict" if run.checked.held_out else "what was learnt, from this view too"
    views = []
    for what, check in ranked_examples(run.checked.checks):
        triple = draw_triple(check, run.checked.views[check.name], run.images, run.colors)
        pictures = [jpeg_uri(image, PICTURE_PX) for image in triple]
        views.append((what, check, pictures, confusions.get(check.name, [])))
    return {"views": views, "captions": ("its mask", source, "red where the two differ")} if views else None


def classes(run: PageInputs) -> Content:
    """Size, confidence, agreement with the masks, and a picture of each class."""
    entries, checked, ious, tree = run.report["classes"], run.checked, run.ious, run.segmentation.tree
    largest = sorted(range(len(entries)), key=lambda k: -entries[k]["gaussians"])[:MOST_THUMBNAILS]
    found = thumbnails(largest, checked, run.images, run.colors)
    # Of a view that shows what no other does, nothing is predicted.
    num_views = sum(check.checked > 0 for check in checked.checks)
    views = checked.views_showing(len(run.colors)) if num_views else None
    rows = [
        {
            **entry,
            "color": run.colors[k].tolist(),
            "picture": (found[k][0], jpeg_uri(found[k][1], THUMBNAIL_PX)) if k in found else None,
            "views": None if views is None else int(views[k]),
            "iou": None if ious is None or np.isnan(ious[k]) else float(ious[k]),
            "whole": None if tree is None or (whole := tree.whole(k)) is None else run.nodes[whole][1],
            "parts": [] if tree is None else [run.nodes[part][1:] for part in tree.inside(k)],
        }
        for k, entry in enumerate(entries)
        # Masks need not show any background, and objects without a Gaussian are none.
        if entry["gaussians"] or (k and not run.report.get("ids"))
    ]
    return {"classes": rows, "many": MANY, "num_views": num_views, "held_out": checked.held_out}


def confusion(run: PageInputs) -> Content | None:
    """Matrix of the classes that are confused most, and the largest confusions."""
    if (found := run.confusion) is None or not len(found.pixels):
        return None
    names, shown = run.segmentation.class_names, found.most_confused(MATRIX_CLASSES)
    shares, total = found.shares(shown), max(int(found.pixels.sum()), 1)
    shares[shares < 0.002] = 0
    return {
        "names": [names[k] for k in shown.tolist()],
        "shares": shares.tolist(),
        "most": len(shown) if len(shown) < len(np.unique(found.predicted)) else None,
        "pairs": [(names[k], names[y], pixels, pixels / total) for k, y, pixels in found.largest(PAIRS)],
    }


def reliability(run: PageInputs) -> Content | None:
    """How far each view's mask can be trusted, the worst first."""
    views = run.reliability
    return {"worst": views[:WORST], "others": views[WORST:], "trusted": TRUSTED} if views else None


def confidence(run: PageInputs) -> Content:
    """How sure the labelled Gaussians are, apart by where their label comes from."""
    segmentation = run.segmentation
    labelled = segmentation.labels >= 0
    sure, clustered = segmentation.confidence[labelled], segmentation.clustered[labelled]
    counts = [np.histogram(sure[part], BINS, (0, 1))[0] for part in (~clustered, clustered)]
    return {
        "temperature": segmentation.temperature,
        "series": ["learnt", "from their neighbours"],
        "bins": np.transpose(counts).tolist(),
    }
