"""Tell what it brings that regions of a mask lose a label that the other views contradict, and from which share on.

    python benchmarks/regions.py        # on $GSSEG_DATA, default ../shared/data, and on the demo scene

Printed are mIoU in the test views and the seconds that `fit` takes, for several values of `EMSettings.least_agreement`;
with 0 all regions keep theirs. Wrong masks are drawn from several seeds: what becomes of a few small objects is a
matter of luck, and one draw tells little.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from machine import describe, parser_of
from results import score, segmented
from robustness import Bench, open_benches
from view_errors import corrupt_views, errors_at

from gsseg_core.data.view import View, spread
from gsseg_core.learn.em.em_learner import EMLearner, EMSettings
from gsseg_core.warm_up import warm_up

SHARES = (0.0, 0.02, 0.05, 0.1, 0.2)
SEEDS = range(8)
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
    options = parser_of(__doc__).parse_args()
    print(describe())
    warm_up()
    with tempfile.TemporaryDirectory() as folder:
        for bench in open_benches(Path(folder), options.data, False):
            print("\n" + f"{bench.name:>26}" + "".join(f"{share:>18g}" for share in SHARES))
            drawn = []
            for what, views in masks(bench):
                runs = [learn(bench, views, share) for share in SHARES]
                print(f"{what:>26}" + "".join(f"{miou:>10.4f} ({seconds:.1f} s)" for miou, seconds in runs), flush=True)
                if what.startswith("a quarter wrong"):
                    drawn.append([miou for miou, _ in runs])
            means = "".join(f"{mean:>10.4f}{'':8}" for mean in np.mean(drawn, axis=0))
            print(f"{'mean of a quarter wrong':>26}{means}", flush=True)


def masks(bench: Bench) -> Iterator[tuple[str, Sequence[View]]]:
    """Give views with true masks, with realistic errors, and with errors of one kind."""
    yield "true masks", bench.train
    if bench.given:
        yield "a quarter wrong, as given", bench.given
    for seed in SEEDS:
        yield f"a quarter wrong, seed {seed}", corrupt_views(bench.train, seed, bench.realistic)
    some = spread(bench.train, bench.curve_views)
    for kind, strengths in KINDS.items():
        for strength in strengths:
            errors = errors_at(kind, strength, missed_label=bench.missed_label)
            yield f"{kind} {strength:g}", corrupt_views(some, 0, *errors)


def learn(bench: Bench, views: Sequence[View], share: float) -> tuple[float, float]:
    """Learn from views, and return mIoU in the test views and the seconds of `fit`."""
    learner = EMLearner(bench.scene, bench.data.num_classes, EMSettings(least_agreement=share))
    learner.observe_all(views)
    start = time.perf_counter()
    learner.fit()
    seconds = time.perf_counter() - start
    return score(segmented(learner, bench.data.class_names), bench.scene, bench.test).mean_iou, seconds


if __name__ == "__main__":
    main()
