"""Objects from masks that an automatic generator really made, SAM's or one of its kind, on scenes whose truth is known.

Usage: python benchmarks/generated_masks.py MASKS [--data FOLDER] [--out results_out/generated_masks.md]

MASKS/SCENE/ has a JSON file per photo of SCENE, as SAM's automatic mask generator writes it; views without one are left
out. No masks come with gsseg: run a generator over the photos of the train views. Rows of each scene:

- *nested*: masks as they are read, each with the outermost one that it is a part of;
- *flat*: the same without what lies in what, smaller masks on top of larger ones;
- *true*: the same segments, each under the true id of most of its pixels. What finding objects could reach at most.

Scored are label maps of the test views against the true ids: mIoU under the best one-to-one matching, mIoU where each
found object takes the true id that it shares most pixels with, and of each true object the best IoU of any node of the
tree of parts and wholes, at whatever level.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from bench_ids import Masks, evaluated, label_maps, labels_of, object_ious, overlaps
from machine import REPOSITORY, parser_of
from results import markdown, points, segmented, write_page

from gsseg_core.data.dataset import Dataset
from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.data.view import View
from gsseg_core.learn.em.em_learner import EMLearner
from gsseg_core.objects.object_table import ObjectTable, find_objects
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import Segmentation
from gsseg_core.warm_up import warm_up

COLUMNS = ["scene", "views", "masks a view", "ids", "objects", "found", "one-to-one", "many-to-one", "best node"]


def main() -> int:
    """Measure and write."""
    parser = parser_of(__doc__)
    parser.add_argument("masks", type=Path, metavar="MASKS")
    parser.add_argument("--out", default=REPOSITORY / "results_out/generated_masks.md", type=Path)
    options = parser.parse_args()
    warm_up()
    lines = []
    for folder in sorted(path for path in options.masks.iterdir() if (options.data / path.name / "labels").is_dir()):
        for line in rows(options.data / folder.name, folder.resolve()):
            print(*line, sep=", ", flush=True)
            lines.append(line)
    write_page(options.out, markdown(COLUMNS, lines) + "\n")
    return 0


def rows(data: Path, masks: Path) -> Iterator[list[str]]:
    """Measure a scene."""
    scene, truth = GaussianScene.load(data / "scene.ply"), Dataset(data)
    views = [replace(v, class_names=None) for v in Dataset(data, masks).views("train") if v.has_mask]
    tests, count = truth.views("test"), np.mean([len(view.class_ids() - {0}) for view in views])
    flat = [View.from_arrays(view.camera, view.read_labels()) for view in views]
    for name, shown in (("nested", views), ("flat", flat)):
        table = find_objects(scene, shown)
        result = learnt(scene, [table.relabelled(view) for view in shown], table)
        nodes = best_nodes(scene, result, tests)
        yield [data.name, str(len(views)), f"{count:.0f}", name, *scores(scene, result, tests), points(nodes)]
    true = with_true_ids(views, labels_of(truth.views("train")))
    yield [data.name, str(len(views)), f"{count:.0f}", "true", *scores(scene, learnt(scene, true), tests), ""]


def with_true_ids(views: list[View], truth: Masks) -> list[View]:
    """Give each segment the true id of most of its pixels; unknown where there is none."""
    found = []
    for view in views:
        labels, true = view.read_labels(), truth[view.name]
        table = np.full(int(labels.max()) + 2, UNKNOWN, np.int32)
        table[0] = 0
        for k in np.unique(labels[(labels > 0) & (true != UNKNOWN)]):
            table[k] = np.bincount(true[(labels == k) & (true != UNKNOWN)]).argmax()
        found.append(View.from_arrays(view.camera, table[labels]))
    return found


def learnt(scene: GaussianScene, views: list[View], table: ObjectTable | None = None) -> Segmentation:
    """Learn with `em`; with the table of what was found, parts and wholes come, too."""
    learner = EMLearner(scene, max(view.largest_label for view in views) + 1)
    learner.observe_all(views)
    learner.fit()
    return segmented(learner, {}) if table is None else table.with_tree(segmented(learner, table.class_names))


def scores(scene: GaussianScene, result: Segmentation, tests: list[View]) -> list[str]:
    """Count true objects and found ones, and match them: one to one, and many to one."""
    truth, found = labels_of(tests), label_maps(scene, result, tests)
    ious, objects = object_ious(truth, found)
    many = evaluated(truth, found, overlaps(truth, found).many_to_one()).iou[1:]
    return [str(len(ious)), str(objects), points(float(ious.mean())), points(float(np.nanmean(many)))]


def best_nodes(scene: GaussianScene, result: Segmentation, tests: list[View]) -> float:
    """Mean over the true objects of the best IoU that any node of the tree has with each."""
    assert result.tree is not None
    true = np.concatenate([labels.ravel() for labels in labels_of(tests).values()])
    best = np.zeros(int(true.max()) + 1)
    for granularity in result.tree.granularities:
        maps = label_maps(scene, result.at(granularity), tests)
        found = np.concatenate([labels.ravel() for labels in maps.values()])
        both = np.zeros((len(best), int(found.max()) + 2), np.int64)
        np.add.at(both, (true[true >= 0], found[true >= 0]), 1)
        size = np.bincount(found[found >= 0], minlength=both.shape[1])
        union = both.sum(axis=1, keepdims=True) + size - both
        best = np.maximum(best, (both / np.maximum(union, 1))[:, :-1].max(axis=1))
    return float(best[1:][np.isin(np.arange(1, len(best)), true)].mean())


if __name__ == "__main__":
    raise SystemExit(main())
