"""Masks as automatic generators make them, drawn in many ways: how far the level that views tell is from the best one.

Usage: python benchmarks/part_draws.py [--data FOLDER] [--draws 27|9] [--seed 0] [--scene NAME] [--out FILE]

Every draw has ids of each view's own. An object is split along its colours into 1 to at most 2, 4 or 8 parts, in each
view anew, background and walls into one more; 0, 15 or 30 % of the neighbouring pairs are merged, objects with objects
or background with background; 0, 10 or 30 % of the masks are missing; edges are off by 1 or 2 px. Nine draws leave the
share of missing masks at 10 %. `--scene replica_apartment` is the real apartment, whose ids, shared by objects that are
far apart, are told apart as in bench_ids.py.

Objects are found in the train views but every seventh, with the level that the views tell and with fixed ones. Votes
under their numbers are rendered in the views that were left out, and matched one to one with the true objects, the
background left out.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from bench_ids import Masks, instances, labels_of, neighbours, object_ious, rng
from machine import REPOSITORY, parser_of
from results import markdown, points, write_page
from scenes import APARTMENT, held_out
from scipy.cluster.vq import kmeans2
from scipy.ndimage import gaussian_filter
from skimage.color import rgb2lab
from skimage.morphology import dilation, disk, erosion

from gsseg_core.data.dataset import Dataset
from gsseg_core.data.label_images import UNKNOWN
from gsseg_core.data.view import View
from gsseg_core.objects.association import AssociationSettings, associate
from gsseg_core.objects.lifted_segments import Lifted
from gsseg_core.raster.backends import make_operator
from gsseg_core.raster.observation import Observation
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import Segmentation

SCENES = {"shelf": 0, "kitchen_table": 0, "workbench": 2}
"""The last class that is not an object: what is behind them, and what they stand on."""

LEVELS = (0.1, 0.15, 0.2, 0.3, 0.4, 0.5)
LEAST_PX = 120
"""Pixels of a part."""


@dataclass(frozen=True)
class PartMasks:
    """One way in which a generator makes masks."""

    parts: int = 4  # at most, of one object
    merged: float = 0.15  # share of the neighbouring pairs
    missing: float = 0.1  # share of the masks
    edge_px: int = 2  # by which the edges of a mask are off at most, at least 1


def draws(number: int) -> list[PartMasks]:
    """All combinations, or those with 10 % of the masks missing."""
    missing = (0.0, 0.1, 0.3) if number > 9 else (0.1,)
    return [PartMasks(*values) for values in itertools.product((2, 4, 8), (0.0, 0.15, 0.3), missing)]


def drawn(
    labels: np.ndarray,  # (H, W)
    photo: np.ndarray,  # (H, W, 3) uint8
    last: int,
    random: np.random.Generator,
    settings: PartMasks,
) -> np.ndarray:
    """Draw the masks of one view, (H, W) int32; classes up to `last` are background."""
    lab = gaussian_filter(rgb2lab(photo), (2, 2, 0))
    parts, owner = np.full(labels.shape, UNKNOWN, np.int32), list[int]()
    for k in np.unique(labels[labels >= 0]).tolist():
        most = int(random.integers(1, settings.parts + 1)) + (k <= last)
        for inside in _split(labels == k, lab, most, random):
            parts[inside] = len(owner)
            owner.append(k)
    parts = _with_merged(parts, np.array(owner) <= last, random, settings.merged)
    out = np.full(labels.shape, UNKNOWN, np.int32)
    present = np.unique(parts[parts >= 0])
    for number, part in enumerate(random.permutation(present).tolist(), start=1):
        missing, outward = random.random(2) < (settings.missing, 0.5)
        if not missing:
            change = dilation if outward else erosion
            out[change(parts == part, disk(int(random.integers(1, settings.edge_px + 1))))] = number
    return out


def _split(inside: np.ndarray, lab: np.ndarray, most: int, random: np.random.Generator) -> list[np.ndarray]:
    rows, columns = np.nonzero(inside)
    count = min(most, max(len(rows) // LEAST_PX, 1))
    if count == 1:
        return [inside]
    place = np.stack([rows, columns], axis=1) * (10 / np.sqrt(len(rows)))
    part = kmeans2(np.concatenate([lab[rows, columns], place], axis=1), count, minit="++", rng=random)[1]
    out = []
    for k in range(count):
        chosen = np.zeros_like(inside)
        chosen[rows[part == k], columns[part == k]] = True
        out.append(chosen)
    return out


def _with_merged(parts: np.ndarray, background: np.ndarray, random: np.random.Generator, share: float) -> np.ndarray:
    pairs = neighbours(parts)
    pairs = pairs[(pairs >= 0).all(axis=1)]
    pairs = pairs[background[pairs[:, 0]] == background[pairs[:, 1]]]
    table = np.arange(len(background) + 1)
    table[-1] = UNKNOWN
    for a, b in pairs[random.random(len(pairs)) < share].tolist():
        table[table == table[b]] = table[a]
    merged: np.ndarray = table[parts].astype(np.int32)
    return merged


class Trial:
    """A scene with one draw of its masks, lifted once."""

    def __init__(
        self, scene: GaussianScene, views: Sequence[View], tests: Sequence[View], true: Masks, last: int
    ) -> None:  # fmt: skip
        self.scene, self.tests = scene, tests
        self.truth = {
            view.name: np.where(true[view.name] <= last, np.minimum(true[view.name], 0), true[view.name])
            for view in tests
        }
        self.num_objects = len(np.unique(np.concatenate([labels[labels > 0] for labels in self.truth.values()])))
        self.observations, self.lifted = dict[str, Observation](), dict[str, Lifted]()
        for view in views:
            operator, labels = make_operator(scene, view.camera), view.read_labels()
            self.observations[view.name] = observation = operator.observe(labels)
            self.lifted[view.name] = Lifted.of(observation.by_label()).bordered(scene, operator, labels)

    def score(self, settings: AssociationSettings) -> tuple[float, int, float]:
        """IoU of the objects one to one, how many were found, and the level."""
        objects, level = associate(self.lifted, settings)
        votes = np.zeros((len(self.scene), max(int(each.max()) for each in objects.values()) + 1), np.float32)
        for name, observation in self.observations.items():
            number = np.full(int(observation.classes.max()) + 1, UNKNOWN)
            number[self.lifted[name].ids] = objects[name]
            column = number[observation.classes][observation.labels]
            shown = column != UNKNOWN
            np.add.at(votes, (observation.gaussians[shown], column[shown]), observation.votes()[shown])
        codes = votes / np.maximum(votes.sum(axis=1, keepdims=True), 1e-9)
        result = Segmentation.from_codes(self.scene, codes, {})
        found = {view.name: result.render(make_operator(self.scene, view.camera)).labels for view in self.tests}
        ious, count = object_ious(self.truth, found)
        return float(ious.mean()), count, level


def _photo(view: View) -> np.ndarray:
    photo = view.read_photo()
    assert photo is not None
    return photo


def trials(
    folder: Path, ways: Sequence[PartMasks | None], seed: int
) -> Iterator[tuple[PartMasks | None, Trial]]:  # fmt: skip
    """Draw the masks of a scene in several ways; None takes those that came with it."""
    last, scene = SCENES.get(folder.name, 0), GaussianScene.load(folder / "scene.ply")
    dataset = Dataset(folder)
    train = dataset.views("train")
    true = instances(scene, dataset.views()) if folder.name == APARTMENT else labels_of(train)
    given = {view.name: view for view in Dataset(folder, "labels_parts").views("train")}
    kept, tests = held_out(train)
    more = f" {seed}" if seed else ""
    for way in ways:
        views = []
        for view in kept:
            labels = (
                replace(given[view.name], class_names=None).read_labels() if way is None
                else drawn(true[view.name], _photo(view), last, rng(f"{folder.name} {view.name} {way}{more}"), way)
            )  # fmt: skip
            views.append(View.from_arrays(view.camera, labels))
        yield way, Trial(scene, views, tests, true, last)


def main() -> int:
    """Measure, print and write."""
    parser = parser_of(__doc__)
    parser.add_argument("--draws", choices=(9, 27), default=9, type=int)
    parser.add_argument("--seed", default=0, type=int, help="of the draws; masks as given are left out but for 0")
    parser.add_argument("--scene", choices=(*SCENES, APARTMENT))
    parser.add_argument("--out", default=REPOSITORY / "results_out/part_draws.md", type=Path)
    options = parser.parse_args()
    ways, lines, behind = draws(options.draws), [], []
    for folder in (options.data / name for name in ([options.scene] if options.scene else SCENES)):
        if not folder.is_dir():
            print(f"{folder}: not there; set GSSEG_DATA or --data to the folder that holds it")
            continue
        given = [None] if options.seed == 0 and (folder / "labels_parts").is_dir() else []
        for way, trial in trials(folder, [*given, *ways], options.seed):
            told, found, level = trial.score(AssociationSettings())
            fixed = [trial.score(AssociationSettings(agreement=each))[0] for each in LEVELS]
            behind.append(max(fixed) - told)
            drawn_as = "as given" if way is None else f"{way.parts}; {way.merged:.0%}; {way.missing:.0%}"
            counts = f"{found} of {trial.num_objects}"
            lines.append([folder.name, drawn_as, counts, f"{level:.2f}", points(told), *map(points, fixed)])
            print(*lines[-1], sep=", ", flush=True)
    if not lines:
        return 0
    head = ["scene", "parts; merged; missing", "found", "level told", "IoU there", *(f"at {level}" for level in LEVELS)]
    mean, most = 100 * np.mean(behind), 100 * max(behind)
    said = f"Behind the best level of each: {mean:.1f} points on the mean, {most:.1f} at most."
    print(said)
    write_page(options.out, markdown(head, lines) + f"\n\n{said}\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
