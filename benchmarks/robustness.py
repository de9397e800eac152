"""Measure what docs/robustness.md shows, and write it: how wrong masks and poses may be, and what is noticed of it.

Usage: python benchmarks/robustness.py [--quick] [--data FOLDER] [--out docs/robustness.md]

FOLDER holds `replica_apartment/` (default: the environment variable GSSEG_DATA, else ../shared/data); without it, only
the demo scene is measured. Plots go to `pictures/` beside the document, pictures of the real scene to `results_out/`,
outside version control. About 25 minutes on two cores; `--quick` takes five, with fewer views and strengths, and writes
to `results_out/` alone.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jobs import hard_votes
from machine import REPOSITORY, parser_of
from moving_occluder import DepthOf, depth_of_demo, depth_of_scene, gated, occlude
from PIL import Image
from plots import Axis, draw_panels
from results import machine, markdown, points, score, segmented, write_page
from robustness_text import BAR, CURVES, HEADER, OCCLUDER, RELIABILITY
from scenes import APARTMENT, DEMO, open_scenes
from view_errors import STRONGEST, PoseErrors, corrupt_views, errors_at, typical_depth
from wrong_masks import WrongMasks

from gsseg_core.data.dataset import Dataset
from gsseg_core.data.view import View, spread
from gsseg_core.export.view_pictures import draw_worst_views
from gsseg_core.files.atomic import write_atomically
from gsseg_core.learn.em.em_learner import EMLearner, EMSettings
from gsseg_core.learn.learner import Learner
from gsseg_core.learn.mask_reliability import MaskChecker
from gsseg_core.learn.registry import make_learner
from gsseg_core.report.pictures import ViewImages
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import Segmentation
from gsseg_core.warm_up import warm_up

EM, PLAIN, GRADIENT, VOTES, HARD = "em", "em without error model", "gradient", "votes", "FlashSplat's rule"
STILL = "em, outlines left where they are"
LEARNERS = (EM, PLAIN, GRADIENT, VOTES, HARD)
SETTINGS = {PLAIN: EMSettings(errors=False), STILL: EMSettings(edge_px=0)}
STRENGTHS = (0.25, 0.5, 0.75, 1.0)
BAD_SHARE = 0.2
REALISTIC = WrongMasks()


@dataclass(frozen=True)
class Bench:
    """A scene to measure on.

    Attributes
    ----------
    name : str
        What it is called in tables.
    scene : GaussianScene
        N Gaussians.
    data : Dataset
        Names and number of the classes.
    train, test : list of View
        With true masks.
    curve_views : int
        How many of the train views the curves learn from.
    strengths, gradient_strengths : sequence of float
        Where the curves have points, and where the gradient learner, which is slow, has some.
    missed_label : int or None
        What is written where an object was missed, as in `WrongMasks`.
    given : list of View
        The train views with wrong masks that came with the scene, if any.
    """

    name: str
    scene: GaussianScene
    data: Dataset
    train: list[View]
    test: list[View]
    curve_views: int
    strengths: Sequence[float] = STRENGTHS
    gradient_strengths: Sequence[float] = STRENGTHS
    missed_label: int | None = 0
    given: Sequence[View] = ()

    @property
    def realistic(self) -> WrongMasks:
        """A quarter of the objects wrong in every view, edges off by up to 3 px."""
        return replace(REALISTIC, missed_label=self.missed_label)


def main() -> int:
    """Measure and write."""
    parser = parser_of(__doc__)
    parser.add_argument("--out", type=Path, help="document to write")
    parser.add_argument("--quick", action="store_true", help="fewer views and strengths, to see that all works")
    options = parser.parse_args()
    aside = REPOSITORY / "results_out"
    out = options.out or (aside / "robustness.md" if options.quick else REPOSITORY / "docs/robustness.md")
    start = time.perf_counter()
    warm_up()
    with tempfile.TemporaryDirectory() as folder:
        benches = list(open_benches(Path(folder), options.data, options.quick))
        bar, cost = measure_bar(benches)
        sections = [bar, measure_curves(benches, out.parent / "pictures", aside)]
        sections.append(measure_reliability(benches, out.parent / "pictures", aside))
        sections.append(measure_occluder(benches))
    minutes = (time.perf_counter() - start) / 60
    header = HEADER.format(cost=cost, machine=machine(), minutes=f"{minutes:.0f}", quick=" --quick" * options.quick)
    write_page(out, "\n".join([header, *sections]))
    return 0


def open_benches(folder: Path, data: Path, quick: bool) -> Iterator[Bench]:
    """Build the demo scene in a folder; open the real one, if it is there."""
    fewer = (0.5, 1.0)
    for name, scene, true, wrong in open_scenes(folder, data, [APARTMENT]):
        train, given, test = true.views("train"), wrong.views("train"), true.views("test")
        if name == DEMO and quick:
            yield Bench("demo scene", scene, true, train[::3], test, len(train), fewer, fewer[1:])
        elif name == DEMO:
            yield Bench("demo scene", scene, true, train, test, len(train))
        elif quick:
            yield Bench("real scene", scene, true, train[::5], test, 21, fewer[1:], (), None, given[::5])
        else:
            yield Bench("real scene", scene, true, train, test, 53, STRENGTHS, fewer, None, given)


def learn(bench: Bench, views: Sequence[View], names: Sequence[str] = LEARNERS) -> dict[str, float]:
    """Learn from views with each of these learners: mIoU of rendered label maps of the test views."""
    mious = {}
    for name in names:
        learner = taught(name, bench, views)
        codes = hard_votes(learner.codes_, 0.0) if name == HARD else learner.codes_
        names, evidence = bench.data.class_names, learner.evidence()
        result = Segmentation.from_codes(bench.scene, codes, names, evidence=evidence)
        mious[name] = score(result, bench.scene, bench.test).mean_iou
    return mious


def taught(name: str, bench: Bench, views: Sequence[View], num_classes: int | None = None) -> Learner:
    """Return a learner that has learnt from views, of the classes of the scene unless told how many."""
    learner: Learner
    num_classes = num_classes or bench.data.num_classes
    if name in SETTINGS:
        learner = EMLearner(bench.scene, num_classes, SETTINGS[name])
    else:
        learner = make_learner("votes" if name == HARD else name, bench.scene, num_classes)
    learner.observe_all(views)
    return learner.fit()


def right_share(views: Sequence[View], truth: Sequence[View]) -> list[float]:
    """Share of the right pixels in the mask of each view."""
    return [float((a.read_labels() == b.read_labels()).mean()) for a, b in zip(views, truth, strict=True)]


def tell(bench: Bench, what: str, mious: Mapping[str, float]) -> None:
    """Print what has just been measured."""
    print(f"{bench.name}, {what}: " + ", ".join(f"{name} {miou:.4f}" for name, miou in mious.items()), flush=True)


# The bar


def measure_bar(benches: Sequence[Bench]) -> tuple[str, str]:
    """Measure what realistic errors cost each learner, then each error alone: a section, and what `em` loses."""
    rows, alone, most = [], [], []
    for bench in benches:
        clean = learn(bench, bench.train, (*LEARNERS, STILL))
        tell(bench, "true masks", clean)
        drawn = {f"drawn, seed {seed}": corrupt_views(bench.train, seed, bench.realistic) for seed in (0, 1)}
        sets = {"as they came": bench.given, **drawn} if bench.given else drawn
        first, worst = next(iter(sets)), 1.0
        for title, views in sets.items():
            some = LEARNERS if title == first else (EM, PLAIN, VOTES, HARD)
            wrong = learn(bench, views, (*some, STILL))
            tell(bench, f"wrong masks {title}", wrong)
            for name, miou in wrong.items():
                figures = points(clean[name]), points(miou), lost(clean[name], miou)
                rows.append([f"{bench.name}, {title}", name, *figures])
            worst = min(worst, wrong[EM])
        most.append(f"up to {lost(clean[EM], worst)}{' points of mIoU' * (not most)} in the {bench.name}")
        alone += [[bench.name, *row] for row in measure_parts(bench, clean)]
    header = ["masks", "learner", "true masks: mIoU", "wrong masks: mIoU", "points lost"]
    parts = ["scene", "error", "right pixels", EM, "points lost", STILL, PLAIN, VOTES]
    return BAR.format(table=markdown(header, rows), parts=markdown(parts, alone)), ", ".join(most)


def lost(clean: float, wrong: float) -> str:
    """Tell how many points of mIoU wrong masks cost; no -0.0."""
    return f"{round(100 * (clean - wrong), 1) + 0.0:.1f}"


def measure_parts(bench: Bench, clean: Mapping[str, float]) -> Iterator[list[str]]:
    """Measure each part of the realistic errors alone."""
    whole = bench.realistic
    none = replace(whole, missed=0.0, swapped=0.0, edge_px=0)
    parts = {
        f"{100 * whole.missed:.0f} % missed": replace(none, missed=whole.missed),
        f"{100 * whole.swapped:.0f} % with a wrong id": replace(none, swapped=whole.swapped),
        f"{100 * (whole.missed + whole.swapped):.0f} % in swapped pairs": replace(
            none, exchanged=whole.missed + whole.swapped
        ),
        f"edges off by up to {whole.edge_px} px": replace(none, edge_px=whole.edge_px),
    }
    for title, errors in parts.items():
        views = corrupt_views(bench.train, 0, errors)
        mious = learn(bench, views, (EM, STILL, PLAIN, VOTES))
        tell(bench, title, mious)
        others = (points(mious[name]) for name in (STILL, PLAIN, VOTES))
        share = float(np.mean(right_share(views, bench.train)))
        yield [title, points(share), points(mious[EM]), lost(clean[EM], mious[EM]), *others]


# Curves


def measure_curves(benches: Sequence[Bench], pictures: Path, aside: Path) -> str:
    """Measure mIoU against each kind and strength of error, with all learners; plot and tabulate it."""
    texts = []
    for bench in benches:
        train = spread(bench.train, bench.curve_views)
        depth = typical_depth(bench.scene, [view.camera for view in train])
        clean = learn(bench, train)
        tell(bench, "curves, true masks", clean)
        rows = [curve_row("no errors", 0.0, 1.0, clean)]
        curves: dict[str, dict[str, list[tuple[float, float]]]] = {}
        for kind in STRONGEST:
            curves[kind] = {name: [(0.0, miou)] for name, miou in clean.items()}
            for strength in bench.strengths:
                errors = errors_at(kind, strength, missed_label=bench.missed_label, depth=depth)
                views = corrupt_views(train, 0, *errors)
                names = [name for name in LEARNERS if name != GRADIENT or strength in bench.gradient_strengths]
                mious = learn(bench, views, names)
                tell(bench, f"{kind} {strength:g}", mious)
                rows.append(curve_row(kind, strength, float(np.mean(right_share(views, train))), mious))
                for name, miou in mious.items():
                    curves[kind][name].append((strength, miou))
        plot = f"robustness_{bench.name.split()[0]}.svg"
        draw_panels(pictures / plot, curves, Axis("strength", 0, 1, 0.25), Axis("mIoU", 0, 1, 0.25))
        aside.mkdir(exist_ok=True)
        (aside / f"robustness_{bench.name.split()[0]}.json").write_text(json.dumps({"mIoU": curves}))
        table = markdown(["error", "strength", "right pixels", *LEARNERS], rows)
        title = bench.name.capitalize()
        texts.append(CURVES.format(title=title, views=len(train), tests=len(bench.test), plot=plot, table=table))
    kinds = markdown(["error", "strength 1"], [[kind, meaning] for kind, meaning in STRONGEST.items()])
    return f"## mIoU by kind and strength of error\n\n{kinds}\n\n" + "\n".join(texts)


def curve_row(kind: str, strength: float, right: float, mious: Mapping[str, float]) -> list[str]:
    """One line of the table."""
    scores = [points(mious[name]) if name in mious else "" for name in LEARNERS]
    return [kind, f"{strength:g}", points(right), *scores]


# Reliability


def measure_reliability(benches: Sequence[Bench], pictures: Path, aside: Path) -> str:
    """Compare the reliability of views with their true share of right pixels, where some frames are bad."""
    from scipy.stats import spearmanr  # Half a second, for this table alone.

    rows = []
    plots: dict[str, dict[str, list[tuple[float, float]]]] = {}
    for bench in benches:
        views = with_bad_frames(bench, 0)
        learner = taught(EM, bench, views)
        assert isinstance(learner, EMLearner)
        checks = MaskChecker(learner).check_all()
        told = np.array([check.reliability for check in checks])
        true = np.array(right_share(views, bench.train))
        many = round(BAD_SHARE * len(views))
        found = len(set(np.argsort(told)[:many]) & set(np.argsort(true)[:many]))
        error = told - true
        rows.append([
            bench.name, str(len(views)), f"{spearmanr(told, true).statistic:.3f}", f"{found} of {many}",
            f"{100 * error.mean():+.1f}", f"{100 * abs(error).mean():.1f}", f"{100 * abs(error).max():.1f}",
        ])  # fmt: skip
        print(f"{bench.name}, reliability: {rows[-1]}", flush=True)
        plots[bench.name] = {"views": list(zip(true.tolist(), told.tolist(), strict=True))}
        # The real scene may be looked at, but not handed on.
        folder = pictures if bench.name.startswith("demo") else aside
        images = ViewImages(learner.scene)
        save_small(folder / "worst_views.png", draw_worst_views(images.rendered, learner.views, checks, 2))
    share = Axis("true share of right pixels", 0, 1, 0.25)
    draw_panels(pictures / "reliability.svg", plots, share, replace(share, name="reliability"), lines=False)
    header = ["scene", "views", "rank correlation", "worst found", "bias", "mean error", "largest error"]
    return RELIABILITY.format(table=markdown(header, rows))


def with_bad_frames(bench: Bench, seed: int) -> list[View]:
    """Corrupt all views a little, up to what is realistic, and a fifth of them badly, each in its own way."""
    rng = np.random.default_rng(seed)
    bad = set(rng.choice(len(bench.train), round(BAD_SHARE * len(bench.train)), replace=False).tolist())
    views = []
    for i, view in enumerate(bench.train):
        little, much, kind = rng.random(), rng.uniform(0.5, 1.0), rng.integers(4)
        whole = bench.realistic
        errors = replace(
            whole, missed=little * whole.missed, swapped=little * whole.swapped, edge_px=round(little * whole.edge_px)
        )
        worse = [{"exchanged": much}, {"bad_frame": 1.0}, {"missed": much, "swapped": 0.0}, {"shift_px": 60 * much}]
        errors = replace(errors, **worse[kind]) if i in bad else errors
        views += corrupt_views([view], int(rng.integers(1 << 31)), errors, PoseErrors())
    return views


# Somebody in front


def measure_occluder(benches: Sequence[Bench]) -> str:
    """Measure what somebody costs who stands before the scene in every view, with depth gating and without."""
    rows = []
    for bench in benches:
        depth_of: DepthOf = depth_of_demo if bench.name.startswith("demo") else depth_of_scene(bench.scene)
        person = bench.data.num_classes
        occluded = occlude(bench.train, person, depth_of, seed=0)
        views, hidden, lost_share = gated(bench.scene, occluded)
        sets = {"without": bench.train, "with": [one.view for one in occluded], "gated": views}
        names = {**bench.data.class_names, person: "person"}
        covered = f"{100 * np.mean([one.person.mean() for one in occluded]):.0f} %"
        for name in (EM, VOTES):
            scores = {}
            for title, seen in sets.items():
                learner = taught(name, bench, seen, person + 1)
                result = segmented(learner, names)
                # Over the classes of the scene, to which the person does not belong.
                scores[title] = float(np.nanmean(score(result, bench.scene, bench.test).iou[:person]))
            print(f"{bench.name}, somebody in front: {name} {scores}", flush=True)
            losses = [f"{100 * (scores['without'] - scores[title]):.1f}" for title in ("with", "gated")]
            figures = [f"{100 * share:.1f} %" for share in (hidden, lost_share)]
            rows.append([
                bench.name, name, points(scores["without"]), points(scores["with"]), losses[0],
                points(scores["gated"]), losses[1], covered, *figures,
            ])  # fmt: skip
    header = ["scene", "learner", "nobody: mIoU", "somebody", "points lost", "gated by depth", "points lost"]
    return OCCLUDER.format(table=markdown([*header, "in front", "of that unknown", "of the rest"], rows))


def save_small(path: Path, image: np.ndarray) -> None:
    """Write a picture with as many colours as a document needs."""
    with write_atomically(path) as temporary:
        Image.fromarray(image).quantize(96, dither=Image.Dither.NONE).save(temporary, format="PNG", optimize=True)


if __name__ == "__main__":
    sys.exit(main())
