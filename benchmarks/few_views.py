"""Measure what docs/few_views.md shows, and write it: few labelled views; one object from a mask or two, or a click.

Usage: python benchmarks/few_views.py [--quick] [--held-out] [--data FOLDER] [--out docs/few_views.md]

FOLDER holds the scenes (default: the environment variable GSSEG_DATA, else ../shared/data); those that are absent are
left out. How many views must be labelled is measured on the demo scene and the apartment, single objects on all. Plots
go to `pictures/` beside the document. `--quick` has one draw of views and fewer counts; `--held-out` scores on every
seventh train view, kept out of learning, in place of the test views, as when the settings were chosen. Both write to
`results_out/` alone.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from bench_ids import instances, labels_of
from few_views_text import CURVES, HEADER, ONE_VIEW
from jobs import hard_votes
from machine import REPOSITORY, parser_of
from plots import Axis, draw_panels
from results import machine, markdown, points, write_page
from scenes import APARTMENT, DEMO, held_out, open_scenes
from scipy import ndimage

from gsseg_core.data.dataset import Dataset
from gsseg_core.data.view import View
from gsseg_core.learn.em.em_learner import EMLearner
from gsseg_core.metrics import Evaluation
from gsseg_core.objects.pick import Pick, pick_clicks, pick_mask, pick_masks
from gsseg_core.raster.backends import make_operator
from gsseg_core.raster.view_operator import ViewOperator
from gsseg_core.refine.label_propagation import GraphSettings, propagate
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import Segmentation
from gsseg_core.spatial.neighbour_graph import graph_of
from gsseg_core.warm_up import warm_up

CURVED = ("Demo scene", "Replica apartment")
COUNTS = (1, 2, 4, 8, 16, 32)
DRAWS = 3
LEAST = 300
"""Pixels that an object must have in the view in which it is shown."""

MOST = 40
"""Objects at most, taken evenly from all of them by their ids."""

VARIANTS = ("em", "em + graph", "votes", "votes + graph", "FlashSplat's rule", "FlashSplat's rule + graph")
WAYS = {
    "mask, lifted only": "the mask, what its view sees",
    "mask, graph": "the mask, and the graph for the rest",
    "click": "one click in its middle",
    "two masks": "two masks, the second of the view that is proposed",
    "two masks, random": "two masks, the second of a random view that shows the object",
}


@dataclass(frozen=True)
class Bench:
    """A scene to measure on; the views have true masks."""

    name: str
    scene: GaussianScene
    num_classes: int
    train: list[View]
    test: list[View]
    objects: Mapping[str, np.ndarray]  # masks (H, W) whose ids are single objects, by view

    @cached_property
    def scored(self) -> list[tuple[ViewOperator, np.ndarray]]:
        """Operators of the test views, which are used many times, and their true labels."""
        return [(make_operator(self.scene, view.camera), view.read_labels()) for view in self.test]


def main() -> int:
    """Measure and write."""
    parser = parser_of(__doc__)
    parser.add_argument("--out", type=Path, help="document to write")
    parser.add_argument("--quick", action="store_true", help="one draw of views, fewer counts")
    parser.add_argument("--held-out", action="store_true", help="score on held-out train views")
    options = parser.parse_args()
    aside = options.quick or options.held_out
    out = options.out or (REPOSITORY / "results_out/few_views.md" if aside else REPOSITORY / "docs/few_views.md")
    warm_up()
    start = time.perf_counter()
    draws, counts = (1, COUNTS[::2]) if options.quick else (DRAWS, COUNTS)
    with tempfile.TemporaryDirectory() as folder:
        benches = open_benches(Path(folder), options.data, options.held_out)
        one_view = "\n\n".join(f"{bench.name}:\n\n{pick_all(bench)}" for bench in benches)
        curves = {bench.name: measure_curve(bench, counts, draws) for bench in benches if bench.name in CURVED}
    draw_curves(out.parent / "pictures/few_views.svg", curves)
    counted = [bench for bench in benches if bench.name in curves]
    tables = "\n\n".join(f"{bench.name}:\n\n{curve_table(curves[bench.name], len(bench.train))}" for bench in counted)
    minutes = f"{(time.perf_counter() - start) / 60:.0f}"
    scored = "every seventh train view, kept out of learning" if options.held_out else "the test views"
    content = [
        HEADER.format(machine=machine(), minutes=minutes),
        CURVES.format(draws=draws, scored=scored, tables=tables),
        ONE_VIEW.format(scored=scored, tables=one_view, least=LEAST),
    ]
    write_page(out, "\n".join(content))
    return 0


def open_benches(folder: Path, real: Path, aside: bool) -> list[Bench]:
    """Make the demo scene and open the others, those that are there."""
    benches = []
    for name, scene, data, _ in open_scenes(folder, real):
        views = data.views()
        objects = instances(scene, views) if name == APARTMENT else labels_of(views)
        benches.append(split(titled(name), scene, data, objects, aside))
    return benches


def split(name: str, scene: GaussianScene, data: Dataset, objects: Mapping[str, np.ndarray], aside: bool) -> Bench:
    """Choose which views are scored: the test views, or some of the train views that are held out in their place."""
    train, test = data.views("train"), data.views("test")
    if aside:
        train, test = held_out(train)
    return Bench(name, scene, data.num_classes, train, test, objects)


def titled(name: str) -> str:
    """Name a scene as a heading does."""
    return "Demo scene" if name == DEMO else name.replace("_", " ").capitalize()


Curve = dict[str, dict[int, list[float]]]  # mIoU of each draw, by variant and number of views


def measure_curve(bench: Bench, counts: Sequence[int], draws: int) -> Curve:
    """Learn from so many views, drawn at random, and from all, and score."""
    curve: Curve = {variant: {} for variant in VARIANTS}
    for count in [*(count for count in counts if count < len(bench.train)), len(bench.train)]:
        for draw in range(draws if count < len(bench.train) else 1):
            chosen = np.sort(np.random.default_rng(draw).permutation(len(bench.train))[:count])
            learner = EMLearner(bench.scene, bench.num_classes)
            learner.observe_all([bench.train[i] for i in chosen])
            learner.fit()
            evidence = learner.evidence()
            votes = learner.vote_codes()
            for name, codes in zip(VARIANTS[::2], (learner.codes_, votes, hard_votes(votes, 0.0)), strict=True):
                spread = propagate(graph_of(bench.scene), codes, evidence)
                for variant, result in ((name, codes), (f"{name} + graph", spread)):
                    curve[variant].setdefault(count, []).append(score_codes(bench, result, evidence))
        print(bench.name, count, {v: points(float(np.mean(curve[v][count]))) for v in VARIANTS}, flush=True)
    return curve


def score_codes(bench: Bench, codes: np.ndarray, evidence: np.ndarray) -> float:
    """Mean IoU of label maps of the scored views, after KNN."""
    # Rendered label maps do not depend on the filter.
    result = Segmentation.from_codes(bench.scene, codes, {}, evidence=evidence)
    evaluation = Evaluation()
    for operator, truth in bench.scored:
        evaluation.add(truth, result.render(operator).labels)
    return float(evaluation.mean_iou)


def curve_table(curve: Curve, all_views: int) -> str:
    """Mean over the draws, and how far the worst and the best are apart."""
    rows = []
    for count in curve["em"]:
        cells = []
        for variant in VARIANTS:
            values = curve[variant][count]
            apart = f" ({min(values):.2f}-{max(values):.2f})" if len(values) > 1 else ""
            cells.append(points(float(np.mean(values))) + apart)
        rows.append([f"all {count}" if count == all_views else str(count), *cells])
    return markdown(["views", *VARIANTS], rows)


def draw_curves(path: Path, curves: Mapping[str, Curve]) -> None:
    """Plot mIoU against the number of views, one panel a scene."""
    shown = [variant for variant in VARIANTS if variant != "FlashSplat's rule + graph"]
    panels = {
        name: {v: [(float(np.log2(n)), float(np.mean(values))) for n, values in curve[v].items()] for v in shown}
        for name, curve in curves.items()
    }
    draw_panels(path, panels, Axis("log2 of the number of views", 0, 7, 1), Axis("mIoU", 0, 1, 0.2))


def pick_all(bench: Bench) -> str:
    """Show each object in one train view, pick it in every way, and score it in other views."""
    rows = []
    picks: dict[str, list[Pick]] = {way: [] for way in WAYS}
    wanted = [k for k in shown_objects(bench) if any((bench.objects[view.name] == k).any() for view in bench.test)]
    wanted = wanted[:: -(-len(wanted) // MOST)]
    for k in wanted:
        shown = {view.name: (bench.objects[view.name] == k).astype(np.int32) for view in bench.train}
        prompts = {view.name: View.from_arrays(view.camera, shown[view.name]) for view in bench.train}
        first = prompts[max(shown, key=lambda name: int(shown[name].sum()))]
        inside = ndimage.distance_transform_edt(np.pad(shown[first.name], 1))[1:-1, 1:-1]
        row, column = np.unravel_index(int(inside.argmax()), inside.shape)
        picks["mask, lifted only"].append(pick_mask(bench.scene, first, GraphSettings(strength=0)))
        picks["mask, graph"].append(pick_mask(bench.scene, first))
        picks["click"].append(pick_clicks(bench.scene, first.camera, [(int(row), int(column))]))
        others = [prompt for prompt in prompts.values() if prompt is not first]
        following = others[picks["mask, graph"][-1].next_view(bench.scene, [other.camera for other in others])]
        picks["two masks"].append(pick_masks(bench.scene, [first, following]))
        showing = [other for other in others if shown[other.name].any()] or others
        drawn = showing[np.random.default_rng(k).integers(len(showing))]
        picks["two masks, random"].append(pick_masks(bench.scene, [first, drawn]))
    for way, made in picks.items():
        ious = score_picks(bench, wanted, made)
        share = [float((ious >= least).mean()) for least in (0.5, 0.75, 0.9)]
        rows.append(
            [WAYS[way], points(float(ious.mean())), points(float(np.median(ious))), *(f"{s:.0%}" for s in share)]
        )
        print(bench.name, len(wanted), rows[-1], flush=True)
    header = [f"{len(wanted)} objects", "mean IoU", "median", "IoU at least 0.5", "0.75", "0.9"]
    return markdown(header, rows)


def shown_objects(bench: Bench) -> list[int]:
    """List the objects that some train view shows well; the background is none."""
    largest: dict[int, int] = {}
    for view in bench.train:
        for k, pixels in zip(*np.unique(bench.objects[view.name], return_counts=True), strict=True):
            largest[int(k)] = max(largest.get(int(k), 0), int(pixels))
    return sorted(k for k, pixels in largest.items() if k > 0 and pixels >= LEAST)


def score_picks(bench: Bench, wanted: Sequence[int], picks: Sequence[Pick]) -> np.ndarray:
    """IoU of each object over all scored views together: intersection and union are summed."""
    membership = np.stack([pick.membership for pick in picks], axis=1)
    both, either = np.zeros(len(wanted)), np.zeros(len(wanted))
    for view, (operator, _) in zip(bench.test, bench.scored, strict=True):
        seen = operator.render(membership) >= 0.5
        true = bench.objects[view.name][..., None] == np.array(wanted)
        both += (seen & true).sum(axis=(0, 1))
        either += (seen | true).sum(axis=(0, 1))
    return both / np.maximum(either, 1)


if __name__ == "__main__":
    sys.exit(main())
