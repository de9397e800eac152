"""Measure the regret of `em`: mIoU that another learner, or `em` without one of its steps, would have reached instead.

    python benchmarks/regret.py                        # learn without every seventh train view, score on these
    python benchmarks/regret.py --test                 # learn from all train views, score on the test views
    python benchmarks/regret.py --scenes demo shelf --kinds true "jittered poses" --again em

Settings are chosen by the first; the second is for the table, which goes to `docs/regret.md`. What was measured is kept
in `results_out/regret.json`, so a run that was interrupted goes on; `--again` measures some learners anew. Half an hour
for each on two cores. Real scenes lie in $GSSEG_DATA, default ../shared/data.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jobs import hard_votes
from machine import REPOSITORY, parser_of
from results import machine, markdown, score, write_page
from scenes import DEMO, GARDEN, NO_BACKGROUND, REAL, held_out, open_scene
from view_errors import corrupt_views, errors_at, typical_depth
from wrong_masks import WrongMasks

from gsseg_core.data.dataset import Dataset
from gsseg_core.data.view import View
from gsseg_core.files.json_files import write_json
from gsseg_core.learn.em.em_learner import EMLearner, EMSettings
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import Segmentation

SCENES = (DEMO, GARDEN, *REAL)
STRENGTHS = {"clutter": 0.5, "bad frames": 0.4, "shifted masks": 0.4, "jittered poses": 0.4}
KINDS = ("true", "as given", "own draw", *STRENGTHS)
EM, UNMOVED, PLAIN, MATRICES = "em", "em, masks as they came", "plain em", "matrices alone"
VOTES = ("votes", "hard votes")
ALIGNED = ", moved"
NEVER = 1e-9  # so low a share rejects nothing, and regions are still split as they are for other shares
BAR = 0.3  # points that regret should not exceed


@dataclass(frozen=True)
class Bench:
    """A scene with the views to learn from, which have true masks, those that came wrong, and those to score on."""

    name: str
    scene: GaussianScene
    data: Dataset
    train: Sequence[View]
    given: Sequence[View]
    truth: Sequence[View]

    def views(self, kind: str) -> Sequence[View]:
        """Return the views to learn from with one kind of errors."""
        missed = None if self.name in NO_BACKGROUND else 0
        if kind == "true":
            return self.train
        if kind == "as given":
            return self.given
        if kind == "own draw":
            return corrupt_views(self.train, 10, WrongMasks(missed_label=missed))
        depth = typical_depth(self.scene, [view.camera for view in self.train])
        return corrupt_views(self.train, 0, *errors_at(kind, STRENGTHS[kind], missed_label=missed, depth=depth))


def main() -> int:
    """Measure what is asked for, print it, and write the table if it is whole."""
    parser = parser_of(__doc__)
    parser.add_argument("--scenes", nargs="+", default=SCENES, choices=SCENES)
    parser.add_argument("--kinds", nargs="+", default=KINDS, choices=KINDS)
    parser.add_argument("--again", nargs="+", default=(), help="learners to measure anew")
    parser.add_argument("--test", action="store_true", help="learn from all train views, and score on the test views")
    parser.add_argument("--kept", default=REPOSITORY / "results_out/regret.json", type=Path)
    options = parser.parse_args()
    measured = json.loads(options.kept.read_text()) if options.kept.exists() else {}
    split = "test" if options.test else "held out"
    for name in options.scenes:
        with tempfile.TemporaryDirectory() as folder:
            bench = open_bench(name, Path(folder), options.data, options.test)
            for kind in options.kinds:
                row = measured.setdefault(split, {}).setdefault(name, {}).setdefault(kind, {})
                for learner, codes in learnt(bench, bench.views(kind), set(row) - set(options.again)):
                    result = Segmentation.from_codes(bench.scene, codes, bench.data.class_names)
                    row[learner] = round(100 * score(result, bench.scene, bench.truth).mean_iou, 2)
                    options.kept.parent.mkdir(exist_ok=True)
                    write_json(options.kept, measured)
                print(f"{name}, {kind}: regret {regret(row):.2f} " + json.dumps(row), flush=True)
    if options.test and all(set(measured["test"].get(name, {})) == set(KINDS) for name in SCENES):
        write_table(measured["test"], REPOSITORY / "docs/regret.md")
    return 0


def open_bench(name: str, folder: Path, data: Path, test: bool) -> Bench:
    """Open a scene, one of our own built in a folder, with the views to learn from and to score on."""
    _, scene, true, wrong = open_scene(name, folder, data)
    train, given, scored = true.views("train"), wrong.views("train"), true.views("test")
    if not test:
        (train, scored), (given, _) = held_out(train), held_out(given)
    return Bench(name, scene, true, train, given, scored)


def learnt(bench: Bench, views: Sequence[View], known: set[str]) -> Iterator[tuple[str, np.ndarray]]:
    """Learn with each learner that is not known yet; those that see the same masks share the prepared views."""
    for edge_px in (0, EMSettings.edge_px):
        moved = ALIGNED if edge_px else ""
        settings = {
            f"{PLAIN}{moved}": EMSettings(errors=False, edge_px=edge_px),
            f"{MATRICES}{moved}": EMSettings(edge_px=edge_px, least_agreement=NEVER),
            EM if edge_px else UNMOVED: EMSettings(edge_px=edge_px),
        }
        if {*(name + moved for name in VOTES), *settings} <= known:
            continue
        learner = EMLearner(bench.scene, bench.data.num_classes, EMSettings(edge_px=edge_px))
        learner.observe_all(views)
        votes = learner.vote_codes()
        for name, codes in zip(VOTES, (votes, hard_votes(votes, 0.0)), strict=True):
            if name + moved not in known:
                yield name + moved, codes
        for name, setting in settings.items():
            if name not in known:
                learner.settings = setting
                yield name, learner.fit().codes_


def regret(row: dict[str, float]) -> float:
    """Points that the best of all learners has more than `em`."""
    return max(row.values()) - row[EM]


def write_table(measured: dict[str, dict[str, dict[str, float]]], path: Path) -> None:
    """Write the table of all scenes and kinds."""
    others = [f"{name}{moved}" for name in (*VOTES, PLAIN, MATRICES) for moved in ("", ALIGNED)] + [UNMOVED]
    rows = [
        [scene, kind, f"{row[EM]:.2f}", f"{regret(row):.2f}", *(f"{row[name]:.2f}" for name in others)]
        for scene in SCENES
        for kind, row in measured[scene].items()
    ]
    worst = max((regret(row), scene, kind) for scene, kinds in measured.items() for kind, row in kinds.items())
    above = sum(regret(row) > BAR for kinds in measured.values() for row in kinds.values())
    table = markdown(["scene", "masks", EM, "regret", *others], rows)
    where = f"{worst[0]:.2f} ({worst[1]}, {worst[2]}); {above} of {len(rows)} are above {BAR}"
    strengths = ", ".join(f"{strength} ({kind})" for kind, strength in STRENGTHS.items())
    write_page(path, HEADER.format(machine=machine(), table=table, worst=where, strengths=strengths))


HEADER = """# Regret

Made by `python benchmarks/regret.py --test`. Machine: {machine}.

A step of a learner that helps with wrong masks may hurt with right ones. The regret of `em` is the difference between
the best of all other learners, and of `em` without some of its steps, and `em` itself: in points of mIoU (rendered
label maps of the test views against true masks, without refinement), 0 where `em` is the best. At worst it is {worst}.

- Learners: *votes*, *hard votes* (FlashSplat's rule), *plain em* (without error models), *matrices alone* (`em` with
  error models, but without rejected regions); each from masks as they came, and from masks that are moved to edges of
  the scene as in `em` ([method.md](method.md)). The last column is `em` with rejected regions and masks as they came.
- Masks: true; as given (those that lie beside the scene: 15 % of objects missed in every view, 10 % under another id,
  edges off by up to 3 px); an own draw of the same errors; and, drawn from true ones, one kind of error alone at the
  strength {strengths} ([robustness.md](robustness.md)).
- Scenes: the demo; a garden (`benchmarks/garden.py`), whose objects have soft outlines; one real floor,
  `replica_apartment`; three lifelike synthetic ones. When a mask is moved was chosen on train views of all six
  (`CLEAR`, `EACH_CLEAR` and `ALL_CLEAR` in `gsseg_core/learn/em/boundary_alignment.py`).

{table}
"""

if __name__ == "__main__":
    sys.exit(main())
