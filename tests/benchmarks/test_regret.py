"""The program that measures regret: every learner once, none again that is known, and the worst regret named."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import regret
from regret import ALIGNED, EM, KINDS, SCENES, UNMOVED, Bench, learnt
from small_scenes import NAMES, NUM_CLASSES, balls_on_a_table, clean_views


def test_learners_that_are_known_are_not_asked_again() -> None:
    data: Any = SimpleNamespace(num_classes=NUM_CLASSES, class_names=NAMES)
    views = clean_views(3)
    bench = Bench("demo", balls_on_a_table()[0], data, views, views, views)
    names = [name for name, _ in learnt(bench, views, set())]
    assert len(names) == len(set(names)) == 10 and {EM, UNMOVED, f"votes{ALIGNED}"} <= set(names)
    assert [name for name, _ in learnt(bench, views, set(names) - {EM})] == [EM]


def test_the_table_names_the_worst_regret(tmp_path: Path) -> None:
    row = {name + moved: 90.0 for name in (*regret.VOTES, regret.PLAIN, regret.MATRICES) for moved in ("", ALIGNED)}
    row |= {EM: 91.0, UNMOVED: 90.5}
    measured = {scene: {kind: dict(row) for kind in KINDS} for scene in SCENES}
    measured["shelf"]["clutter"]["votes"] = 91.25
    assert regret.regret(row) == 0
    regret.write_table(measured, tmp_path / "regret.md")
    text = (tmp_path / "regret.md").read_text()
    assert "0.25 (shelf, clutter)" in text and text.count("\n| ") == len(SCENES) * len(KINDS) + 2
