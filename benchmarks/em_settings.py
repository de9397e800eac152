"""Measure what other values of the settings of `em` would give, on train views that are held out from learning.

    python benchmarks/em_settings.py
    python benchmarks/em_settings.py --scenes demo shelf --kinds "as given"

Learns without every seventh train view of each scene and scores on these, as `benchmarks/regret.py` does. What was
measured is kept in `results_out/em_settings.json`, so a run that was interrupted goes on; once nothing is missing, the
table goes to `docs/em_settings.md`. An hour on two cores. Real scenes lie in $GSSEG_DATA, default ../shared/data.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from machine import REPOSITORY, parser_of
from regret import SCENES, Bench, open_bench
from results import machine, markdown, score, segmented, write_page

from gsseg_core.data.view import View
from gsseg_core.files.json_files import write_json
from gsseg_core.learn.em import boundary_alignment, rejected_regions
from gsseg_core.learn.em.em_learner import EMLearner, EMSettings

Group = dict[str, Sequence[float]]
"""Other values, by setting."""

AS_IS = "as it is"
LEARNING: Group = {
    "least_agreement": (0.025, 0.1),
    "majority": (2.0, 8.0),
    "tolerance": (0.00125, 0.005),
    "CLAIMED": (0.1, 0.4),
}
BOUNDARIES: Group = {
    "SHARPNESS": (2.0, 4.5),
    "SHORTEST": (1, 6),
    "TELLING": (1.5, 2.0),
    "EACH_CLEAR": (0.0, 2.0),
    "ALL_CLEAR": (12.0, 30.0),
}
KINDS = {
    "as given": (LEARNING, BOUNDARIES),
    "true": (LEARNING, BOUNDARIES),
    "own draw": (BOUNDARIES,),
    "clutter": (LEARNING,),
    "bad frames": (LEARNING,),
    "jittered poses": (BOUNDARIES,),
    "shifted masks": (BOUNDARIES,),
}
"""Masks to learn from, of `benchmarks/regret.py`, and the settings that matter to them."""


def main() -> int:
    """Measure what is asked for and not known yet, print it, and write the table if it is whole."""
    parser = parser_of(__doc__)
    parser.add_argument("--scenes", nargs="+", default=SCENES, choices=SCENES)
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=KINDS)
    parser.add_argument("--kept", default=REPOSITORY / "results_out/em_settings.json", type=Path)
    options = parser.parse_args()
    measured = json.loads(options.kept.read_text()) if options.kept.exists() else {}
    options.kept.parent.mkdir(exist_ok=True)
    for name in options.scenes:
        with tempfile.TemporaryDirectory() as folder:
            bench = open_bench(name, Path(folder), options.data, test=False)
            for kind in options.kinds:
                row = measured.setdefault(name, {}).setdefault(kind, {})
                for what, points in learnt(bench, bench.views(kind), KINDS[kind], set(row)):
                    row[what] = points
                    write_json(options.kept, measured)
                print(f"{name}, {kind}: " + json.dumps(row), flush=True)
    if all(set(measured.get(name, {})) == set(KINDS) for name in SCENES):
        write_page(REPOSITORY / "docs/em_settings.md", TEXT.format(machine=machine(), table=table(measured)))
    return 0


def values(groups: Sequence[Group]) -> Iterator[tuple[str, float]]:
    """Go through the settings of some groups, each with its other values."""
    for group in groups:
        for name, others in group.items():
            for value in others:
                yield name, value


def learnt(
    bench: Bench, views: Sequence[View], groups: Sequence[Group], known: set[str]
) -> Iterator[tuple[str, float]]:
    """Learn with each value of the settings of these groups that is not known yet: its name, and mIoU in points."""
    learner = None
    for name, value in [(AS_IS, 0.0), *values(groups)]:
        what = name if name == AS_IS else named(name, value)
        if what in known:
            continue
        with setting(name, value) as settings:
            # Boundaries are moved when views are observed; all else is asked for when these are learnt from.
            if learner is None or name in BOUNDARIES:
                learner = EMLearner(bench.scene, bench.data.num_classes, settings)
                learner.observe_all(views)
            learner.settings = settings
            result = segmented(learner.fit(), bench.data.class_names)
        yield what, round(100 * score(result, bench.scene, bench.truth).mean_iou, 3)


@contextmanager
def setting(name: str, value: float) -> Iterator[EMSettings]:
    """Give a setting another value: one of `EMSettings`, or a constant for as long as this lasts."""
    if name == AS_IS or hasattr(EMSettings, name):
        other: dict[str, Any] = {} if name == AS_IS else {name: value}
        yield EMSettings(**other)
        return
    module: Any = rejected_regions if name in LEARNING else boundary_alignment
    before = getattr(module, name)
    setattr(module, name, value)
    try:
        yield EMSettings()
    finally:
        setattr(module, name, before)


def named(name: str, value: float) -> str:
    """Name a value of a setting, as the table does."""
    return f"{name} {value:g}"


def table(measured: dict[str, dict[str, dict[str, float]]]) -> str:
    """Tabulate what each value gains, in points of mIoU: mean, worst and best over scenes and masks."""
    rows = []
    for what in [named(*other) for other in values((LEARNING, BOUNDARIES))]:
        gains = {
            f"{scene}, {kind}": row[what] - row[AS_IS]
            for scene, kinds in measured.items()
            for kind, row in kinds.items()
            if what in row
        }
        if gains:
            ends = [f"{gain:+.2f} ({case})" for case, gain in sorted(gains.items(), key=lambda one: one[1])]
            rows.append([what, f"{sum(gains.values()) / len(gains):+.3f}", ends[0], ends[-1], str(len(gains))])
    return markdown(["setting", "mean", "worst", "best", "cases"], rows)


TEXT = """# Settings of em

Made by `python benchmarks/em_settings.py`. Machine: {machine}.

The table shows how other values of its settings would change the mIoU of `em`, in points: mean, worst and best over six
scenes, each with several kinds of masks ([regret.md](regret.md) lists them). Every seventh train view was held out from
learning and scored against true masks; test views were not used. Settings from `SHARPNESS` on are in
`gsseg_core/learn/em/boundary_alignment.py`, `CLAIMED` is in `gsseg_core/learn/em/rejected_regions.py`, the others are
in `EMSettings`.

{table}
"""

if __name__ == "__main__":
    sys.exit(main())
