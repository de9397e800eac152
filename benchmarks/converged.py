"""Tell what it would save EM to leave Gaussians alone that have converged.

    python benchmarks/converged.py        # on $GSSEG_DATA, default ../shared/data, and on a made-up room

A step rasterises what each view sees, tile by tile. A tile could be skipped if none of its Gaussians has moved since:
its sums would be those of the step before. So what counts is not how many Gaussians still move but which part of the
blocks of sixteen pixels that a step makes lies in tiles where one of them does. Told for each step but the last one of
the default settings, for several changes of a probability that count as moving.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jobs import small_room
from machine import describe, parser_of
from workloads import REAL, RoomSize

from gsseg_core.data.dataset import Dataset
from gsseg_core.data.view import View, spread
from gsseg_core.learn.em.em_learner import EMLearner, EMSettings
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.warm_up import warm_up

MOVES = (1e-3, 1e-2)


def main() -> None:
    """Measure and print."""
    parser = parser_of(__doc__)
    parser.add_argument("--gaussians", type=int, default=1_000_000, help="of the room")
    parser.add_argument("--views", type=int, default=20, help="views of the room")
    options = parser.parse_args()
    print(describe())
    warm_up()
    if (options.data / REAL[0]).is_dir():
        scene = GaussianScene.load(options.data / REAL[0] / "scene.ply")
        for masks in ("labels", "labels_noisy"):
            data = Dataset(options.data / REAL[0], masks)
            follow(f"{REAL[0]}, {masks}", scene, data.views("train"), data.num_classes)
    else:
        print(f"skipped: no {options.data / REAL[0]}")
    room, views, _ = small_room(RoomSize(options.gaussians, options.views, 10, 640, 480))
    follow("room", room, views, 10)


def follow(name: str, scene: GaussianScene, views: list[View], num_classes: int) -> None:
    """Print what moves in each step: Gaussians, and the work in tiles that hold one."""
    learner = EMLearner(scene, num_classes)
    learner.observe_all(views)
    steps, before = len(learner.fit().history_), None
    print(f"{name}: steps {learner.rounds_}; moving by more than {' or '.join(map(str, MOVES))}:")
    for step in range(1, steps + 1):
        learner.settings = replace(EMSettings(), max_steps=step)
        codes = learner.fit().codes_
        if before is not None:
            moved = np.abs(codes - before).max(axis=1)
            told = [f"{(moved > m)[learner.observed_].mean():.2f}, {work(learner, moved > m):.2f}" for m in MOVES]
            print(f"  step {step}: Gaussians, work {' or '.join(told)}", flush=True)
        before = codes


def work(
    learner: EMLearner,
    moved: np.ndarray,  # (N,) bool
) -> float:
    """Share of the rows of pixels that lie in a tile with a Gaussian that has moved, over some of the views."""
    rows = kept = 0
    for view in spread(list(learner.views.values()), 10):
        observation = learner.observation(view.name)
        start, records = observation._tiles.start, observation._records
        count = np.concatenate([[0], np.cumsum(moved[observation.ids[observation._tiles.entries]])])
        rows += records.sum()
        kept += records[count[start[1:]] > count[start[:-1]]].sum()
    return float(kept / rows)


if __name__ == "__main__":
    main()
