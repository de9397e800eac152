"""Measure what docs/calibration.md shows, and write it: whether confidences mean what they say, and ways to get there.

Usage: python benchmarks/calibration.py [--data FOLDER] [--out docs/calibration.md]

FOLDER holds `replica_apartment/` (default: the environment variable GSSEG_DATA, else ../shared/data); without it, only
the demo scene is measured. Plots go to `pictures/` beside the document.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from calibration_text import HEADER, ROADS, SCORES
from jobs import hard_votes
from machine import REPOSITORY, parser_of
from plots import Axis, draw_panels
from reliability_diagrams import ReliabilityDiagram, risk_coverage
from results import machine, markdown, write_page
from scenes import APARTMENT, DEMO, held_out, open_scenes
from scipy.optimize import minimize_scalar

from gsseg_core.data.label_evidence import VOTE_UNIT
from gsseg_core.data.view import View, spread
from gsseg_core.learn.calibrate import calibrate
from gsseg_core.learn.em.em_learner import EMLearner, EMSettings
from gsseg_core.learn.learner import Learner
from gsseg_core.learn.mask_reliability import MaskChecker
from gsseg_core.learn.registry import make_learner
from gsseg_core.learn.temperature import (
    HIGHEST,
    LOWEST,
    OUTLIERS,
    VIEWS,
    Sample,
    fit_temperature,
    grid_of,
    sample_grid,
    tempered,
)
from gsseg_core.metrics import Evaluation
from gsseg_core.raster.backends import make_operator
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import Segmentation
from gsseg_core.warm_up import warm_up

EM, VOTES, HARD, GRADIENT = "em", "votes", "FlashSplat's rule", "gradient"
CLEAN, WRONG = "true masks", "wrong masks"


@dataclass(frozen=True)
class Bench:
    """A scene with the same train views under true and under wrong masks; test views have true ones."""

    name: str
    scene: GaussianScene
    class_names: dict[int, str]
    train: dict[str, list[View]]
    test: list[View]
    learners: Sequence[str]


@dataclass
class Taught:
    """Codes of one learner, and what it takes to calibrate them."""

    codes: np.ndarray
    samples: list[Sample]
    temperature: float


def main() -> int:
    """Measure and write."""
    parser = parser_of(__doc__)
    parser.add_argument("--out", default=REPOSITORY / "docs/calibration.md", type=Path, help="document to write")
    options = parser.parse_args()
    warm_up()
    with tempfile.TemporaryDirectory() as folder:
        benches = list(open_benches(Path(folder), options.data))
        roads = [row for bench in benches for row in compare_roads(bench)]
        scores = measure_test(benches, options.out.parent / "pictures")
    header = HEADER.format(machine=machine())
    ways = ["scene", "learner", "accuracy", "as blended", "masks taken as true", "through confusion", "best possible"]
    names = [
        "scene", "learner", "mIoU", "labels changed", "temperature", "ECE as blended", "ECE", "AURC as blended", "AURC",
        "ECE of Gaussians as learnt", "ECE of Gaussians",
    ]  # fmt: skip
    text = [header, SCORES.format(table=markdown(names, scores)), ROADS.format(table=markdown(ways, roads))]
    write_page(options.out, "\n".join(text))
    return 0


def open_benches(folder: Path, data: Path) -> Iterator[Bench]:
    """Build the demo scene in a folder; open the real one, if it is there."""
    for name, scene, true, wrong in open_scenes(folder, data, [APARTMENT]):
        train = {CLEAN: true.views("train"), WRONG: wrong.views("train")}
        learners = (EM, VOTES, HARD, *([GRADIENT] if name == DEMO else []))
        yield Bench(name.removeprefix("replica_"), scene, true.class_names, train, true.views("test"), learners)


def taught(bench: Bench, name: str, views: Sequence[View]) -> Taught:
    """Learn from views, and predict some of their masks from the others."""
    learner = make_learner(VOTES if name == HARD else name, bench.scene, max(bench.class_names) + 1)
    learner.observe_all(views)
    learner.fit()
    if name == GRADIENT:
        return Taught(learner.codes_, [], calibrate(learner).temperature)
    chosen = spread(list(learner.views.values()), VIEWS)
    samples = list(_held_out(learner, name, chosen))
    codes = hard_votes(learner.codes_, 0.0) if name == HARD else learner.codes_
    return Taught(codes, samples, fit_temperature(samples))


def _held_out(learner: Learner, name: str, views: Sequence[View]) -> Iterator[Sample]:
    checker = MaskChecker(learner) if name == EM else None
    for view in views:
        if checker is not None:
            yield checker.sample(view)
            continue
        codes = learner.vote_rows_without(view.name).dense(learner.num_classes)
        codes = hard_votes(codes, 0.0) if name == HARD else codes
        image, left_over = make_operator(learner.scene, view.camera).blend(codes)
        image[..., 0] += left_over * bool(codes[:, 0].any())
        yield sample_pixels(image, view.read_labels())


def sample_pixels(image: np.ndarray, labels: np.ndarray) -> Sample:  # (H, W, K), (H, W)
    """Take the pixels of a view that the temperature is fitted to."""
    grid = grid_of(*labels.shape)
    return sample_grid(grid.of(image), grid.of(labels))


def compare_roads(bench: Bench) -> Iterator[list[str]]:
    """Compare ways to choose the temperature, on train views that were held out, against their true masks."""
    _, held = held_out(bench.train[CLEAN])
    for masks, views in bench.train.items():
        for name in (EM, VOTES, HARD):
            learnt = taught(bench, name, held_out(views)[0])
            result = Segmentation.from_codes(bench.scene, learnt.codes, bench.class_names)
            images = [result.blend(make_operator(bench.scene, view.camera)) for view in held]
            truth = [view.read_labels() for view in held]
            known = [sample_pixels(image, labels) for image, labels in zip(images, truth, strict=True)]
            temperatures = [1.0, at_their_word(learnt.samples), learnt.temperature, at_their_word(known)]
            scored = [diagram(images, truth, temperature) for temperature in temperatures]
            right = np.mean([(image.argmax(axis=2) == y).mean() for image, y in zip(images, truth, strict=True)])
            cells = [f"{d.ece:.4f} (T = {t:.2f})" for d, t in zip(scored, temperatures, strict=True)]
            yield [f"{bench.name}, {masks}", name, f"{right:.4f}", *cells]
            print(f"{bench.name}, {masks}, {name}: {cells}", flush=True)


def at_their_word(samples: Sequence[Sample]) -> float:
    """Fit the temperature as if every label were the true class."""

    def loss(log_temperature: float) -> float:
        total = 0.0
        for shares, seen, _ in samples:
            told = tempered(shares, float(np.exp(log_temperature)))[np.arange(len(seen)), seen]
            total -= float(np.log((1 - OUTLIERS) * told + OUTLIERS / shares.shape[1]).sum())
        return total

    return float(np.exp(minimize_scalar(loss, bounds=np.log([LOWEST, HIGHEST]), method="bounded").x))


def diagram(images: Sequence[np.ndarray], truth: Sequence[np.ndarray], temperature: float) -> ReliabilityDiagram:
    """Hold confidences at a temperature against the truth, over all pixels of all views."""
    out = ReliabilityDiagram()
    for image, labels in zip(images, truth, strict=True):
        known = labels >= 0
        confidence = tempered(image, temperature).max(axis=2)
        out.add(confidence[known], (image.argmax(axis=2) == labels)[known])
    return out


def measure_test(benches: Sequence[Bench], pictures: Path) -> list[list[str]]:
    """Learn from all train views and score on the test views; draw reliability diagrams and risk-coverage curves."""
    rows = []
    reliability: dict[str, dict[str, list[tuple[float, float]]]] = {}
    risks: dict[str, dict[str, list[tuple[float, float]]]] = {}
    for bench in benches:
        true_codes, seen = best_truth(bench)
        for masks, views in bench.train.items():
            title = f"{bench.name}, {masks}"
            reliability[title], risks[title] = {"perfect": [(0.0, 0.0), (1.0, 1.0)]}, {}
            for name in bench.learners:
                learnt = taught(bench, name, views)
                raw = Segmentation.from_codes(bench.scene, learnt.codes, bench.class_names)
                result = raw.calibrated(learnt.temperature)
                row, (before, after), curve = score_test(bench, raw, result)
                gaussians = [gaussian_ece(one, true_codes, seen) for one in (raw, result)]
                rows.append([title, name, *row, *(f"{value:.4f}" for value in gaussians)])
                print(rows[-1], flush=True)
                if name in (EM, VOTES):
                    reliability[title] |= {f"{name} as blended": points(before), name: points(after)}
                risks[title][name] = curve
    unit = Axis("confidence", 0, 1, 0.25)
    draw_panels(pictures / "calibration.svg", reliability, unit, Axis("share right", 0, 1, 0.25), columns=2)
    coverage = Axis("coverage", 0, 1, 0.25)
    draw_panels(pictures / "risk_coverage.svg", risks, coverage, Axis("share wrong", 0, 0.08, 0.02), columns=2)
    return rows


def score_test(
    bench: Bench, raw: Segmentation, result: Segmentation
) -> tuple[list[str], tuple[ReliabilityDiagram, ReliabilityDiagram], list[tuple[float, float]]]:
    """Score rendered test views before and after calibration."""
    evaluation, changed = Evaluation(), 0
    diagrams = ReliabilityDiagram(), ReliabilityDiagram()
    sure: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    right: list[np.ndarray] = []
    for view in bench.test:
        operator, truth = make_operator(bench.scene, view.camera), view.read_labels()
        maps = raw.render(operator), result.render(operator)
        evaluation.add(truth, maps[1].labels, view.name)
        changed += int((maps[0].labels != maps[1].labels).sum())
        known = truth >= 0
        right.append((maps[1].labels == truth)[known])
        for one, total, kept in zip(maps, diagrams, sure, strict=True):
            total.add(one.confidence[known], right[-1])
            kept.append(one.confidence[known])
    curves = [risk_coverage(np.concatenate(one), np.concatenate(right)) for one in sure]
    row = [
        f"{evaluation.mean_iou:.4f}", str(changed), f"{result.temperature:.2f}",
        *(f"{one.ece:.4f}" for one in diagrams), *(f"{curve.area:.5f}" for curve in curves),
    ]  # fmt: skip
    places = np.linspace(0, len(curves[1].risk) - 1, 101).astype(int)[1:]
    return row, diagrams, [(float(curves[1].coverage[i]), float(curves[1].risk[i])) for i in places]


def points(diagram: ReliabilityDiagram) -> list[tuple[float, float]]:
    """List the bins of a diagram that hold one prediction in ten thousand or more."""
    filled = diagram.shares > 1e-4
    return list(zip(diagram.confidence[filled].tolist(), diagram.accuracy[filled].tolist(), strict=True))


def best_truth(bench: Bench) -> tuple[np.ndarray, np.ndarray]:
    """Learn codes (N, K) from the true masks of all views, test views too; and how many px see each Gaussian."""
    learner = EMLearner(bench.scene, max(bench.class_names) + 1, EMSettings(errors=False))
    learner.observe_all([*bench.train[CLEAN], *bench.test])
    return learner.fit().codes_, learner._votes.rows().sums() * VOTE_UNIT


def gaussian_ece(result: Segmentation, true_codes: np.ndarray, seen: np.ndarray) -> float:
    """ECE of the confidence of Gaussians, each weighted by the pixels that see it.

    A Gaussian is right if its most probable class is the strongest one of the codes from the true masks of all views.
    Those that no view saw have no truth and are left out, as are those of which the result says nothing.
    """
    known = true_codes.any(axis=1) & result.probabilities.any(axis=1)
    right = result.probabilities.argmax(axis=1) == true_codes.argmax(axis=1)
    out = ReliabilityDiagram()
    out.add(result.confidence[known], right[known], seen[known])
    return out.ece


if __name__ == "__main__":
    sys.exit(main())
