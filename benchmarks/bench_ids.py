"""Masks whose ids hold only inside their own view: how well objects are found, on the real scene and the demo's.

Usage: python benchmarks/bench_ids.py [--data FOLDER] [--out results_out/ids.md] [--scene replica|demo|parts|tracks]

Every row finds the objects of the train views, learns them with `em`, and scores label maps of the test views against
true ids that it never saw: ARI, mIoU under the best one-to-one matching, and mIoU where each found object takes the
true id that it shares most pixels with. "True ids" are the same masks without the association.

The real scene's ids are numbers modulo 40: objects far apart share one. The rows "instances" have them told apart, by
the truth alone: pixels of an id, placed in space by the rendered depth, are one instance where they hang together.

"Parts" are the scenes that have `labels_parts/`: masks as automatic generators make them, objects split into up to four
parts in every view anew, neighbours merged, masks missing. There the background has ids, too, and is left out; only the
expected calibration error (ECE) counts it, all of it as one object.

"Tracks" are the same scenes with masks of whole objects, true and wrong, under the ids of a tracker that goes through
the views in order: what was out of sight comes back under a new id, and so does what was lost by chance.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from machine import REPOSITORY, parser_of
from matching import Contingency, renamed
from reliability_diagrams import ReliabilityDiagram
from results import markdown, points, segmented, write_page
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from gsseg_core.data.dataset import Dataset
from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.data.view import View
from gsseg_core.demo.table_scene import build_demo
from gsseg_core.learn.calibrate import calibrate
from gsseg_core.learn.em.em_learner import EMLearner
from gsseg_core.learn.temperature import tempered
from gsseg_core.metrics import Evaluation
from gsseg_core.objects.object_table import find_objects
from gsseg_core.raster.backends import make_operator
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import Segmentation
from gsseg_core.warm_up import warm_up

Masks = dict[str, np.ndarray]

WRONG = 0.2
"""Share of the objects of a view that are split in two, and of those that are merged with a neighbour."""

SHOWN = 200
"""Parts: pixels in all test views together from which on a found object counts as found."""

CELL, REACH, LEAST = 0.1, 0.31, 300
"""Instances: size of a cell and the gap between cells that hang together, in scene units, and fewest pixels of one."""

LOST = (0.0, 0.05, 0.2)
"""Tracks: probability that an object is lost from one view to the next, besides where it is out of sight."""

COLUMNS = ["masks", "ids", "objects", "true", "ARI", "mIoU one-to-one", "mIoU many-to-one", "find, s", "learn, s"]


class Case(NamedTuple):
    """One row: masks to learn from, and the truth of the test views."""

    masks: str
    ids: str
    labels: Masks
    truth: Masks
    find: bool


def main() -> int:
    """Measure and write."""
    parser = parser_of(__doc__)
    parser.add_argument("--out", default=REPOSITORY / "results_out/ids.md", type=Path)
    parser.add_argument("--scene", choices=("replica", "demo", "parts", "tracks"))
    options = parser.parse_args()
    warm_up()
    sections = []
    if options.scene in (None, "parts"):
        sections.append("## Parts and wholes\n\n" + parts(options.data))
    if options.scene in (None, "tracks"):
        sections.append("## Tracks that break\n\n" + tracks(options.data))
    if options.scene in (None, "demo"):
        with tempfile.TemporaryDirectory() as folder:
            sections.append("## Demo scene\n\n" + demo(Path(folder)))
    if options.scene in (None, "replica"):
        folder = options.data / "replica_apartment"
        if folder.is_dir():
            sections.append("## Replica apartment\n\n" + replica(folder))
        else:
            print(f"{folder}: not there; set GSSEG_DATA or --data to the folder that holds replica_apartment/")
    write_page(options.out, "\n\n".join(sections) + "\n")
    return 0


def demo(folder: Path) -> str:
    """Measure on the demo scene."""
    scene = build_demo(folder).scene
    true, wrong = Dataset(folder, "labels_true"), Dataset(folder)
    train = true.views("train")
    truth = labels_of(true.views("test"))
    return measure(scene, true, cases(labels_of(train), labels_of(wrong.views("train")), truth))


def replica(folder: Path) -> str:
    """Measure on the real scene, its ids as they are and with instances told apart."""
    scene, data = GaussianScene.load(folder / "scene.ply"), Dataset(folder)
    train, test = data.views("train"), data.views("test")
    wrong = labels_of(Dataset(folder, "labels_noisy").views("train"))
    rows = cases(labels_of(train), wrong, labels_of(test))
    every = instances(scene, data.views())
    apart = cases({v.name: every[v.name] for v in train}, None, {v.name: every[v.name] for v in test}, "instances")
    return measure(scene, data, apart + rows)


def parts(data: Path) -> str:
    """Measure on the scenes whose masks show parts in one view and wholes in the next."""
    lines = []
    for folder in sorted(path.parent for path in data.glob("*/labels_parts")):
        scene, truth = GaussianScene.load(folder / "scene.ply"), Dataset(folder)
        views = [replace(view, class_names=None) for view in Dataset(folder, "labels_parts").views("train")]
        tests = truth.views("test")
        learner, seconds = learnt(scene, views, True)
        result = segmented(learner, {}).calibrated(calibrate(learner).temperature)
        found = label_maps(scene, result, tests)
        ious, objects = object_ious(labels_of(tests), found)
        lines.append([
            folder.name, str(len(ious)), str(objects), points(float(ious.mean())), points(float(ious.min())),
            f"{reliability(scene, result, tests, found).ece:.4f}", *seconds,
        ])  # fmt: skip
        print(*lines[-1], sep=", ", flush=True)
    return markdown(["scene", "objects", "found", "IoU one-to-one", "least", "ECE", "find, s", "learn, s"], lines)


def tracks(data: Path) -> str:
    """Measure on masks of whole objects under the ids of a tracker: as classes, and with objects found in them."""
    lines = []
    for folder in sorted(path.parent for path in data.glob("*/labels_parts")):
        scene, tests = GaussianScene.load(folder / "scene.ply"), Dataset(folder).views("test")
        for (name, kind), lost in product((("labels", "true"), ("labels_noisy", "wrong")), LOST):
            train = Dataset(folder, name).views("train")
            masks = tracked(labels_of(train), lost)
            views = [View.from_arrays(view.camera, masks[view.name]) for view in train]
            ids = max(int(labels.max()) for labels in masks.values())
            row = [folder.name, kind, f"{lost:.0%}", str(ids)]
            for find in (False, True):
                learner, _ = learnt(scene, views, find)
                ious, objects = object_ious(labels_of(tests), label_maps(scene, segmented(learner, {}), tests))
                row += [points(float(ious.mean())), str(objects)]
            lines.append([*row, str(len(ious))])
            print(*lines[-1], sep=", ", flush=True)
    columns = ["scene", "masks", "lost", "ids", "global: IoU", "objects", "per-view: IoU", "objects", "true"]
    return markdown(columns, lines)


def tracked(masks: Masks, lost: float) -> Masks:
    """Give objects the numbers of a tracker that goes through the views in the order of their names, and loses some."""
    random, now, count, found = np.random.default_rng(0), dict[int, int](), 0, {}
    for name, labels in sorted(masks.items()):
        before, now = now, {}
        for k in np.unique(labels[labels > 0]).tolist():
            kept = k in before and random.random() >= lost
            count += not kept
            now[k] = before[k] if kept else count
        found[name] = renamed(labels, {0: 0, UNKNOWN: UNKNOWN, **now})
    return found


def reliability(scene: GaussianScene, result: Segmentation, tests: list[View], found: Masks) -> ReliabilityDiagram:
    """Hold the probability of what a pixel shows against the truth.

    The true background comes in parts, as every other object may: probabilities of found ids that share most pixels
    with one true id are summed.
    """
    names, out = overlaps(labels_of(tests), found).many_to_one(), ReliabilityDiagram()
    for view in tests:
        image = tempered(result.blend(make_operator(scene, view.camera)), result.temperature)
        of = np.array([names.get(k, UNKNOWN) for k in range(image.shape[2])])
        true = np.unique(of[of != UNKNOWN])
        summed, labels = np.stack([image[..., of == k].sum(axis=2) for k in true], axis=2), view.read_labels()
        known = labels != UNKNOWN
        out.add(summed.max(axis=2)[known], (true[summed.argmax(axis=2)] == labels)[known])
    return out


def object_ious(truth: Masks, found: Masks) -> tuple[np.ndarray, int]:
    """IoU of each true object with its match, best matching of all; and how many found ones show objects at all."""
    score = overlaps(truth, found)
    size = np.bincount(np.concatenate([labels[truth[name] != UNKNOWN] for name, labels in found.items()]))
    shown = [k for k, true in score.many_to_one().items() if true > 0 and size[k] > SHOWN]
    ious = evaluated(truth, found, score.one_to_one()).iou[1:]
    return ious[~np.isnan(ious)], len(shown)


def cases(true: Masks, wrong: Masks | None, truth: Masks, name: str = "true") -> list[Case]:
    """List the rows of one scene; `wrong` are its masks with errors."""
    split = scrambled({view: cut(merged(labels, rng(view)), rng(view)) for view, labels in true.items()})
    rows = [
        Case(name, "true", true, truth, False),
        Case(name, "shuffled", scrambled(true), truth, True),
        Case(f"{name}, {WRONG:.0%} split, {WRONG:.0%} merged", "shuffled", split, truth, True),
    ]
    if wrong is not None:
        rows.append(Case("wrong", "true", wrong, truth, False))
        rows.append(Case("wrong", "shuffled", scrambled(wrong), truth, True))
    return rows


def measure(scene: GaussianScene, data: Dataset, rows: list[Case]) -> str:
    """Find, learn and score every case."""
    lines = []
    for case in rows:
        views = [view for view in data.views("train") if view.name in case.labels]
        views = [View.from_arrays(view.camera, case.labels[view.name]) for view in views]
        learner, seconds = learnt(scene, views, case.find)
        found = label_maps(scene, segmented(learner, {}), data.views("test"))
        score = overlaps(case.truth, found)
        shown = len(np.unique(np.concatenate([labels.ravel() for labels in found.values()])))
        true = len(np.unique(np.concatenate([labels.ravel() for labels in case.truth.values()])))
        lines.append([
            case.masks, case.ids, str(shown), str(true), f"{score.ari:.4f}",
            points(mean_iou(case.truth, found, score.one_to_one())),
            points(mean_iou(case.truth, found, score.many_to_one())),
            *seconds,
        ])  # fmt: skip
        print(*lines[-1], sep=", ", flush=True)
    return markdown(COLUMNS, lines)


def learnt(scene: GaussianScene, views: list[View], find: bool) -> tuple[EMLearner, list[str]]:
    """Find objects if asked to, and learn them; the seconds of both come second."""
    start = time.perf_counter()
    if find:
        table = find_objects(scene, views)
        views = [table.relabelled(view) for view in views]
    middle = time.perf_counter()
    learner = EMLearner(scene, max(int(view.read_labels().max()) for view in views) + 1)
    learner.observe_all(views)
    learner.fit()
    end = time.perf_counter()
    return learner, [f"{middle - start:.1f}" if find else "", f"{end - middle:.1f}"]


def label_maps(scene: GaussianScene, result: Segmentation, views: list[View]) -> Masks:
    """Render label maps of views."""
    return {view.name: result.render(make_operator(scene, view.camera)).labels for view in views}


def overlaps(truth: Masks, found: Masks) -> Contingency:
    """Count the pixels of each pair of a true and a found id."""
    score = Contingency()
    for name, labels in truth.items():
        score.add(labels, found[name])
    return score


def mean_iou(truth: Masks, found: Masks, names: dict[int, int]) -> float:
    """Mean IoU over the true ids of the test views, with found ids given true ones."""
    return float(evaluated(truth, found, names).mean_iou)


def evaluated(truth: Masks, found: Masks, names: dict[int, int]) -> Evaluation:
    """Compare found ids, given true ones, with the truth."""
    evaluation = Evaluation()
    for name, labels in truth.items():
        evaluation.add(labels, renamed(found[name], names), name)
    return evaluation


def labels_of(views: list[View]) -> Masks:
    return {view.name: view.read_labels() for view in views}


def rng(name: str) -> np.random.Generator:
    """Make a generator of a view's own."""
    return np.random.default_rng(list(name.encode()))


def scrambled(masks: Masks) -> Masks:
    """Shuffle the ids of each view, 0 apart."""
    return {name: _relabelled(labels, rng(name).permutation) for name, labels in masks.items()}


def _relabelled(labels: np.ndarray, shuffle: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    table = np.arange(int(labels.max()) + 2)
    table[-1] = -1
    present = np.unique(labels[labels > 0])
    table[present] = shuffle(present)
    return table[labels].astype(np.int32)


def cut(labels: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Split some objects in two of equal size, along a line of random direction."""
    out, new = labels.copy(), int(labels.max()) + 1
    for k in np.unique(labels[labels > 0]):
        angle = random.uniform(0, np.pi)
        if random.random() < WRONG:
            rows, columns = np.nonzero(labels == k)
            along = rows * np.sin(angle) + columns * np.cos(angle)
            half = along > np.median(along)
            out[rows[half], columns[half]] = new
            new += 1
    return out


def merged(labels: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Merge some objects with one that they touch, each with one at most."""
    touching = neighbours(labels)
    touching = np.concatenate([touching, touching[:, ::-1]])
    touching = touching[(touching > 0).all(axis=1)]
    out, free = labels.copy(), np.ones(int(labels.max()) + 1, bool)
    for k in np.unique(labels[labels > 0]):
        # Each pair takes two objects.
        others = np.unique(touching[touching[:, 0] == k, 1])
        others = others[free[others]]
        if random.random() < WRONG / 2 and free[k] and len(others):
            other = random.choice(others)
            out[out == k] = other
            free[[k, other]] = False
    return out


def neighbours(labels: np.ndarray) -> np.ndarray:  # (H, W)
    """List the pairs of labels that lie side by side, the smaller first, (P, 2)."""
    sides = [(labels[1:], labels[:-1]), (labels[:, 1:], labels[:, :-1])]
    pairs = np.concatenate([np.stack([one.ravel(), two.ravel()], axis=1) for one, two in sides])
    unique: np.ndarray = np.unique(np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1), axis=0)
    return unique


def instances(scene: GaussianScene, views: list[View]) -> Masks:
    """Tell objects that share an id apart, by where their pixels lie in space."""
    labels = np.stack([view.read_labels() for view in views])
    places = np.stack([_places(scene, view) for view in views])
    out, many = np.zeros(labels.shape, np.int32), 0
    for k in np.unique(labels[labels > 0]):
        cells, cell, size = np.unique(
            np.floor(places[labels == k] / CELL).astype(int), axis=0, return_inverse=True, return_counts=True
        )
        pairs = cKDTree(cells * CELL).query_pairs(REACH, output_type="ndarray")
        links = sparse.coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(cells), len(cells)))
        part = connected_components(links, directed=False)[1]
        pixels = np.bincount(part, size)
        large = np.flatnonzero(pixels >= min(LEAST, pixels.max()))
        kept = np.flatnonzero(np.isin(part, large))
        # What is too small is noise of the depth, and goes to the nearest instance.
        nearest = kept[cKDTree(cells[kept]).query(cells)[1]]
        out[labels == k] = (many + 1 + np.searchsorted(large, part[nearest]))[cell.ravel()]
        many += len(large)
    return dict(zip([view.name for view in views], out, strict=True))


def _places(scene: GaussianScene, view: View) -> np.ndarray:
    """Point that each pixel shows, (H, W, 3), by the mean depth of the Gaussians that made it."""
    camera = view.camera
    rotation, shift = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    depth, left_over = make_operator(scene, camera).blend((scene.means @ rotation[2] + shift[2])[:, None])
    z = depth[..., 0] / np.maximum(1 - left_over, 1e-6)
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    local = np.stack([(x - camera.cx) / camera.fx * z, (y - camera.cy) / camera.fy * z, z], axis=-1)
    places: np.ndarray = (local - shift) @ rotation
    return places


if __name__ == "__main__":
    raise SystemExit(main())
