"""Tell what it would bring to judge every region of a mask by what the other views say there.

    python benchmarks/segments.py        # on $GSSEG_DATA, default ../shared/data, and on the demo scene

EM's error models say what a view calls each class, wherever in the image. An error that sits in one place, such as a
blob of clutter, or one object under another's id, is a region of the mask: connected pixels of one label. Here a region
is taken for wrong if, by the votes of all other views, less than a share of it is of its label; its pixels become
unknown before EM begins. Printed are mIoU in the test views with all regions, and without those, for several shares.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from machine import DATA, describe
from robustness import EM, Bench, learn, open_benches
from scipy import ndimage

from gsseg_core.dataset import View, spread
from gsseg_core.em import counted_by_others
from gsseg_core.masks import UNKNOWN
from gsseg_core.meaning import Meaning
from gsseg_core.operator import make_operator
from gsseg_core.rows import Rows
from gsseg_core.view_errors import corrupt_views, errors_at
from gsseg_core.votes import VoteLearner
from gsseg_core.warm_up import warm_up

SHARES = (0.05, 0.1, 0.2)
KINDS = {
    "clutter": (0.25, 1.0),
    "swapped pairs": (0.5,),
    "wrong ids": (0.5,),
    "bad frames": (0.5,),
    "missed objects": (0.5, 0.75),
    "moved edges": (0.5,),
}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the real scenes")
    options = parser.parse_args()
    print(describe())
    warm_up()
    with tempfile.TemporaryDirectory() as folder:
        for bench in open_benches(Path(folder), options.data / "replica_apartment", False):
            print("\n" + "".join(f"{what:>26}" for what in (bench.name, "all regions", *map(str, SHARES))))
            for what, views in masks(bench).items():
                judged = [without_wrong(bench, views, share) for share in SHARES]
                scores = [learn(bench, some, [EM])[EM].miou for some in (views, *judged)]
                left = [""] + [f" ({100 * unknown_share(some):.1f} % out)" for some in judged]
                told = [f"{score:.4f}{out}" for score, out in zip(scores, left, strict=True)]
                print("".join(f"{cell:>26}" for cell in (what, *told)), flush=True)


def masks(bench: Bench) -> dict[str, Sequence[View]]:
    """Give views with true masks, with realistic errors, and with errors of one kind."""
    some = spread(bench.train, bench.curve_views)
    sets = {"true masks": bench.train, "a quarter wrong": bench.given or corrupt_views(bench.train, 0, bench.realistic)}
    for kind, strengths in KINDS.items():
        for strength in strengths:
            errors = errors_at(kind, strength, missed_label=bench.missed_label)
            sets[f"{kind} {strength:g}"] = corrupt_views(some, 0, *errors)
    return sets


def without_wrong(bench: Bench, views: Sequence[View], least: float) -> list[View]:
    """Make pixels unknown that lie in regions of which less than a share is, to the other views, of their label."""
    learner = VoteLearner(bench.scene, bench.data.num_classes)
    learner.observe_all(views)
    votes, kept = Rows.of(learner.state().votes), []
    for view in views:
        labels = view.read_labels()
        regions, classes = regions_of(labels)
        agreed = agreement(bench, votes, view, regions, classes)
        doubtful = np.append(agreed < least, False)  # the last one is for pixels that are unknown anyway
        kept.append(View.from_arrays(view.camera, np.where(doubtful[regions], UNKNOWN, labels)))
    return kept


def regions_of(
    labels: np.ndarray,  # (H, W)
) -> tuple[np.ndarray, np.ndarray]:
    """Give the regions of a mask numbers, (H, W), UNKNOWN where it is; and give the label of each, (R,)."""
    regions, classes = np.full(labels.shape, UNKNOWN, np.int32), []
    for label in np.unique(labels[labels >= 0]).tolist():
        parts, count = ndimage.label(labels == label)
        regions[parts > 0] = parts[parts > 0] - 1 + len(classes)
        classes += [label] * count
    return regions, np.array(classes, np.int32)


def agreement(bench: Bench, votes: Rows, view: View, regions: np.ndarray, classes: np.ndarray) -> np.ndarray:
    """Find which share of each region is of its label by the votes of the others, (R,); 1 where nobody else votes."""
    observation = make_operator(bench.scene, view.camera).observe(regions, Meaning(classes))
    counts = counted_by_others(votes, observation, np.ones(bench.data.num_classes, bool))
    total = counts.sum(axis=0)
    return np.divide(counts[classes, np.arange(len(classes))], total, out=np.ones(len(classes)), where=total > 0)


def unknown_share(views: Sequence[View]) -> float:
    """Share of the pixels of views without a label."""
    return float(np.mean([(view.read_labels() < 0).mean() for view in views]))


if __name__ == "__main__":
    main()
