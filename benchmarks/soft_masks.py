"""Measure what soft and partial masks are worth, for docs/masks.md: the same information, said and not said.

Usage: python benchmarks/soft_masks.py [--data FOLDER] [--seeds N]

FOLDER holds the scenes (default: the environment variable GSSEG_DATA, else ../shared/data); those that are absent are
left out. Prints the table, in Markdown: mIoU of rendered label maps of the test views.

Soft masks are drawn by a segmenter that makes errors and knows how likely they are (`uncertain`): its probabilities
against their argmax. Partial masks have the classes that were looked for in each view, a third of them at random, told
or not: what was not looked for is in the mask's 0, and either that is taken for the background, or `supervised` says
what was looked for.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from machine import parser_of
from results import markdown, points, score, segmented
from scenes import Opened, open_scenes
from scipy.ndimage import distance_transform_edt
from scipy.special import ndtr

from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.data.view import View
from gsseg_core.learn.registry import make_learner

LEARNERS = ("em", "votes")
EDGES = (1.0, 3.0)
"""Standard deviation of an edge, in px, is drawn from this range for each object and view."""
LEAST_SURE = 0.5
"""The segmenter is at least so sure which class an object has; it is right so often as it is sure."""
LOOKED_FOR = 1 / 3


def main() -> None:
    """Measure and print."""
    parser = parser_of(__doc__)
    parser.add_argument("--seeds", default=2, type=int, help="draws of the masks, of which the mean is printed")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        rows = [row for bench in open_scenes(Path(folder), options.data) for row in measure(bench, options.seeds)]
    print(markdown(["scene", "masks", *LEARNERS], rows))


def measure(bench: Opened, seeds: int) -> Iterator[list[str]]:
    """Learn from all kinds of masks; one row of the table for each."""
    train, classes = bench.true.views("train"), [k for k in bench.true.class_names if k]
    wrong = {view.name: view for view in bench.wrong.views("train")}
    pairs = [doubted(train, bench.true.num_classes, np.random.default_rng(seed)) for seed in range(seeds)]
    rngs = [np.random.default_rng(seed) for seed in range(seeds)]
    drawn = [[(view, looked_for(classes, rng)) for view in train] for rng in rngs]
    kinds = {
        "true and complete": [train],
        "argmax of the probabilities": [hard for hard, _ in pairs],
        "**probabilities**": [soft for _, soft in pairs],
        "a third of the classes, the rest taken for background": [
            [View.from_arrays(view.camera, kept(view, ids)) for view, ids in draw] for draw in drawn
        ],
        "**a third of the classes, `supervised`**": [
            [View.from_arrays(view.camera, kept(view, ids), supervised=ids) for view, ids in draw] for draw in drawn
        ],
        "**a third of the classes, `supervised`**, of wrong masks": [
            [View.from_arrays(view.camera, kept(wrong[view.name], ids), supervised=ids) for view, ids in draw]
            for draw in drawn
        ],
    }
    for kind, draws in kinds.items():
        yield [bench.name, kind, *learn(bench, draws)]


def learn(bench: Opened, draws: Sequence[Sequence[View]]) -> list[str]:
    """Learn from each draw of the masks with each learner, and score in the test views: mean mIoU over the draws."""
    out = []
    for name in LEARNERS:
        scores = []
        for views in draws:
            learner = make_learner(name, bench.scene, bench.true.num_classes)
            learner.observe_all(views)
            result = segmented(learner.fit(), bench.true.class_names)
            scores.append(score(result, bench.scene, bench.true.views("test")).mean_iou)
        print(f"{bench.name}, {name}: {scores}", flush=True)
        out.append(points(float(np.mean(scores))))
    return out


def uncertain(
    view: View,
    num_classes: int,
    rng: np.random.Generator,
) -> np.ndarray:
    """Draw what a segmenter says that makes errors and knows how likely they are.

    How sure it is of an object, s, is uniform from `LEAST_SURE` to 1. With probability s it takes the object for what
    it is and names another class of the view as the alternative, else the other way round; either way it gives s to its
    first choice. Its outline is off by d px, normal around 0 with a deviation that it knows, so a pixel at a signed
    distance x inside the outline is in the object with the probability Phi(x / deviation).

    Returns
    -------
    (K, H, W) float32
        Probabilities; they sum to 1 where the mask is known, and are 0 elsewhere.
    """
    truth = view.read_labels()
    classes = np.unique(truth[truth != UNKNOWN])
    out = np.zeros((num_classes, *truth.shape), np.float32)
    for k in classes:
        inside = truth == k
        deviation, sure = rng.uniform(*EDGES), rng.uniform(LEAST_SURE, 1)
        distance = distance_transform_edt(inside) - distance_transform_edt(~inside) if len(classes) > 1 else np.inf
        here = ndtr((distance + rng.normal(0, deviation)) / deviation)
        other = rng.choice(classes[classes != k]) if len(classes) > 1 else k
        right = rng.random() < sure
        out[k] += here * (sure if right else 1 - sure)
        out[other] += here * (1 - sure if right else sure)
    total = out.sum(axis=0)
    out /= np.where(total > 0, total, 1)
    out[:, truth == UNKNOWN] = 0
    return out


def doubted(views: Sequence[View], num_classes: int, rng: np.random.Generator) -> tuple[list[View], list[View]]:
    """Draw uncertain masks: views with the most likely class of each pixel only, and with all probabilities."""
    hard, soft = [], []
    for view in views:
        chances = uncertain(view, num_classes, rng)
        labels = np.where(chances.any(axis=0), chances.argmax(axis=0), UNKNOWN)
        hard.append(View.from_arrays(view.camera, labels))
        soft.append(View.from_probabilities(view.camera, chances))
    return hard, soft


def looked_for(classes: Sequence[int], rng: np.random.Generator) -> list[int]:
    """Draw the classes that are looked for in a view."""
    return sorted(rng.choice(classes, max(1, round(LOOKED_FOR * len(classes))), replace=False).tolist())


def kept(view: View, ids: Sequence[int]) -> np.ndarray:
    """Keep some classes of a mask, and put 0 for all others, (H, W)."""
    labels = view.read_labels()
    return np.where(np.isin(labels, ids) | (labels == UNKNOWN), labels, 0)


if __name__ == "__main__":
    main()
