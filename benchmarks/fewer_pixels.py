"""What learning from fewer pixels costs and saves: `gsseg segment --quality`, for docs/memory.md.

    python benchmarks/fewer_pixels.py SCENE...      # folders of the shared data, on train views that are held out
    python benchmarks/fewer_pixels.py --made FOLDER # a garden and a room with views of 1600 x 1064, on their test views

Prints, for true and for wrong masks, the mIoU of label maps and the seconds of CPU of preparing views and learning.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from workloads import MASKS, RoomSize, write_room

from gsseg_core.data.dataset import Dataset
from gsseg_core.data.view import QUALITIES, View
from gsseg_core.learn.em.em_learner import EMLearner
from gsseg_core.metrics import Evaluation
from gsseg_core.raster.backends import make_operator
from gsseg_core.scene.gaussian_scene import GaussianScene

EVERY = 7  # of the train views is held out
MADE = {"garden": True, "room": False}


def score(
    scene: GaussianScene, learn: list[View], truth: list[View], num_classes: int, step: int
) -> tuple[float, float]:
    """Learn from every step-th pixel; give mIoU of label maps of whole views, and seconds of CPU."""
    learner, start = EMLearner(scene, num_classes), time.process_time()
    learner.observe_all([view.smaller(step) for view in learn])
    learner.fit()
    seconds, evaluation = time.process_time() - start, Evaluation()
    for view in truth:
        codes = make_operator(scene, view.camera).render(learner.codes_)
        evaluation.add(view.read_labels(), codes.argmax(axis=-1).astype(np.int32), view.name)
    return evaluation.mean_iou, seconds


def held_out(root: Path, labels: str) -> tuple[list[View], list[View]]:
    """Choose views to learn from, and others of the train views with true masks."""
    train, truth = (Dataset(root, folder).numbered().views("train") for folder in (labels, "labels"))
    return [view for i, view in enumerate(train) if i % EVERY != EVERY // 2], truth[EVERY // 2 :: EVERY]


def cases(options: argparse.Namespace) -> Iterator[tuple[Path, str, list[View], list[View]]]:
    """List each dataset with each kind of masks, views to learn from, and views to score."""
    for root in options.scenes:
        for labels in MASKS:
            yield root, labels, *held_out(root, labels)
    if options.made is None:
        return
    for name, outdoors in MADE.items():
        root = options.made / name
        if not (root / "split.json").exists():
            write_room(root, RoomSize(600_000, 32, 20, 1600, 1064, tests=4, outdoors=outdoors), wrong=True)
        for labels in MASKS:
            yield root, labels, Dataset(root, labels).numbered().views("train"), Dataset(root).numbered().views("test")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", type=Path)
    parser.add_argument("--made", type=Path)
    options = parser.parse_args()
    print("| scene | masks |", " | ".join(QUALITIES), "|")
    for root, labels, learn, truth in cases(options):
        scene, names = GaussianScene.load(root / "scene.ply"), Dataset(root, labels).numbered().class_names
        found = [score(scene, learn, truth, max(names) + 1, step) for step in QUALITIES.values()]
        cells = (f"{100 * mean_iou:.1f} ({seconds:.0f} s)" for mean_iou, seconds in found)
        print(f"| {root.name} | {MASKS[labels]} |", " | ".join(cells), "|", flush=True)


if __name__ == "__main__":
    main()
