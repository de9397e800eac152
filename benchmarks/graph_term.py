"""Measure what the graph does to label maps and to confidence, from few views and many, with true and wrong masks.

Usage: python benchmarks/graph_term.py [--data FOLDER] [--out results_out/graph_term.md]

Views are spread evenly over the train views, of which every seventh is held out and scored; test views are not looked
at. A quarter of the objects of the wrong masks are missed or carry another's id, and edges are off by up to 3 px. The
share of their labelled pixels that views leave unknown to each other is what the command goes by (`UNKNOWN_SHARE` in
`gsseg_core.refine.label_propagation`); beside it stands the share of Gaussians seen with less than 1 px.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from few_views import Bench, split, titled
from machine import REPOSITORY, parser_of
from reliability_diagrams import ReliabilityDiagram
from results import markdown, write_page
from scenes import NO_BACKGROUND, open_scenes
from wrong_masks import WrongMasks, corrupt

from gsseg_core.data.view import View
from gsseg_core.learn.calibrate import calibrate
from gsseg_core.learn.em.em_learner import EMLearner
from gsseg_core.metrics import Evaluation
from gsseg_core.refine.label_propagation import UNKNOWN_SHARE, GraphSettings, propagate
from gsseg_core.segmentation import Segmentation
from gsseg_core.spatial.neighbour_graph import graph_of
from gsseg_core.warm_up import warm_up

COUNTS = (4, 8, 16, 32)
SEED = 5
COLUMNS = [
    "scene", "masks", "views", "seen < 1 px", "left unknown", "used", "mIoU without", "with", "ECE without", "with"
]  # fmt: skip


def main() -> int:
    """Measure and write."""
    parser = parser_of(__doc__)
    parser.add_argument("--out", default=REPOSITORY / "results_out/graph_term.md", type=Path, help="table to write")
    options = parser.parse_args()
    warm_up()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name, scene, true, _ in open_scenes(Path(folder), options.data):
            rows += compare(split(titled(name), scene, true, {}, True), None if name in NO_BACKGROUND else 0)
    write_page(options.out, markdown(COLUMNS, rows) + "\n")
    return 0


def compare(bench: Bench, missed_label: int | None) -> Iterator[list[str]]:
    """Learn from so many views, and score with the graph and without."""
    rng, errors = np.random.default_rng(SEED), WrongMasks(missed_label=missed_label)
    wrong = [View.from_arrays(view.camera, corrupt(view.read_labels(), rng, errors)) for view in bench.train]
    for count in [*(count for count in COUNTS if count < len(bench.train)), len(bench.train)]:
        chosen = np.linspace(0, len(bench.train) - 1, count).round().astype(int)
        for masks, views in (("true", bench.train), ("wrong", wrong)):
            row = [bench.name, masks, str(count), *score(bench, [views[i] for i in chosen])]
            print(*row, sep=", ", flush=True)
            yield row


def score(bench: Bench, views: Sequence[View]) -> list[str]:
    """Cells of one row: how scarce evidence is, how much views leave unknown, mIoU and ECE."""
    learner = EMLearner(bench.scene, bench.num_classes)
    learner.observe_all(views)
    codes = learner.fit().codes_
    calibration, evidence = calibrate(learner), learner.evidence()
    iou, ece = [], []
    for tried in (codes, propagate(graph_of(bench.scene), codes, evidence)):
        result = Segmentation.from_codes(bench.scene, tried, {}, evidence=evidence).calibrated(calibration.temperature)
        evaluation, diagram = Evaluation(), ReliabilityDiagram()
        for operator, truth in bench.scored:
            found, known = result.render(operator), truth >= 0
            evaluation.add(truth, found.labels)
            diagram.add(found.confidence[known], (found.labels == truth)[known])
        iou.append(f"{evaluation.mean_iou:.4f}")
        ece.append(f"{diagram.ece:.4f}")
    share = float((evidence < GraphSettings().strength).mean())
    used = "yes" if calibration.unknown > UNKNOWN_SHARE else "no"
    return [f"{share:.3f}", f"{calibration.unknown:.4f}", used, *iou, *ece]


if __name__ == "__main__":
    sys.exit(main())
