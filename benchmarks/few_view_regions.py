"""Tell what it brings, where views are few, that regions of a mask lose a label that the other views contradict.

    python benchmarks/few_view_regions.py        # real scenes in $GSSEG_DATA, default ../shared/data; half an hour

Where each object is in few views, other views see its far side through gaps, and speak against the one that shows it.
Learnt is from 8, 16 and 32 train views, with `CLAIMED` of `gsseg_core/learn/em/rejected_regions.py` as it is and with
other values; 1 rejects nothing. Every seventh train view of a real scene is held out and scored; of two made-up rooms,
whose walls are far from the cameras, the test views are. Printed are means of mIoU over the kinds of masks.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from em_settings import setting
from machine import describe, parser_of
from regret import SCENES, Bench, open_bench
from results import markdown, points, score
from workloads import RoomSize, write_room

from gsseg_core.data.dataset import Dataset
from gsseg_core.data.view import spread
from gsseg_core.learn.em import rejected_regions
from gsseg_core.learn.em.em_learner import EMLearner
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import Segmentation

ROOMS = {
    "room of 20 classes": (RoomSize(120_000, 60, 20, 480, 360, tests=10, sh_degree=1), 11),
    "room of 30 classes": (RoomSize(60_000, 25, 30, 400, 300, tests=10, sh_degree=1), 12),
}
"""Sizes and seeds."""

KINDS = ("true", "as given", "bad frames", "clutter", "jittered poses")
VIEWS = (8, 16, 32)
CLAIMED = (0.1, rejected_regions.CLAIMED, 0.4, 1.0)


def main() -> None:
    """Measure and print."""
    options = parser_of(__doc__).parse_args()
    print(describe())
    with tempfile.TemporaryDirectory() as folder:
        lines = []
        for bench in benches(Path(folder), options.data):
            for count in VIEWS:
                means = np.mean([measure(bench, kind, count) for kind in KINDS], axis=0)
                lines.append([bench.name, str(count), *(points(float(mean)) for mean in means)])
                print(*lines[-1], sep=", ", flush=True)
    print(markdown(["scene", "views", *(f"CLAIMED {value:g}" for value in CLAIMED)], lines))


def benches(folder: Path, data: Path) -> Iterator[Bench]:
    """Open the scenes of `regret.py`, and build the rooms in a folder."""
    for name in SCENES:
        yield open_bench(name, folder / name, data, test=False)
    for name, (size, seed) in ROOMS.items():
        room = write_room(folder / name, size, wrong=True, seed=seed)
        true, given = Dataset(room), Dataset(room, "labels_noisy").views("train")
        yield Bench(name, GaussianScene.load(room / "scene.ply"), true, true.views("train"), given, true.views("test"))


def measure(bench: Bench, kind: str, count: int) -> list[float]:
    """Learn from some views with each value of `CLAIMED`: mIoU."""
    learner = EMLearner(bench.scene, bench.data.num_classes)
    learner.observe_all(spread(list(bench.views(kind)), count))
    mious = []
    for value in CLAIMED:
        with setting("CLAIMED", value):
            result = Segmentation.from_codes(bench.scene, learner.fit().codes_, bench.data.class_names)
        mious.append(score(result, bench.scene, bench.truth).mean_iou)
    return mious


if __name__ == "__main__":
    main()
