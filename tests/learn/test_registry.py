"""A learner is one file and one line: what is in the table is offered everywhere."""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from doc_blocks import blocks_of
from small_scenes import NUM_CLASSES, balls_on_a_table, clean_views, write_dataset

from gsseg_core.cli.arguments import build_parser
from gsseg_core.errors import SettingsError
from gsseg_core.learn.learner import Learner
from gsseg_core.learn.registry import LEARNERS, Entry, check_learner, distributed_learners, make_learner
from gsseg_core.learn.vote_learner import VoteLearner
from gsseg_core.pipeline import segment

SCENE, _ = balls_on_a_table()


class ToyLearner(VoteLearner):
    """Believes votes, and has its masks checked."""

    checks_masks = True


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch) -> None:
    module = ModuleType("a_file_of_its_own")
    module.ToyLearner = ToyLearner  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setitem(LEARNERS, "toy", Entry("a_file_of_its_own:ToyLearner"))


@pytest.mark.parametrize("place", [place for entry in LEARNERS.values() for place in entry if place])
def test_classes_in_the_table_are_learners(place: str) -> None:
    module, name = place.split(":")
    assert issubclass(getattr(importlib.import_module(module), name), Learner)


def test_a_learner_in_the_table_is_made_by_its_name(toy: None) -> None:
    assert type(make_learner("toy", SCENE, NUM_CLASSES, max_steps=3, seed=1, memory_budget=0)) is ToyLearner


def test_the_learner_that_contributing_adds_learns_from_views() -> None:
    (block,) = [block for block in blocks_of("CONTRIBUTING.md") if block.title.endswith("sharp_learner.py")]
    names: dict[str, Any] = {}
    exec(block.code, names)
    sharp, votes = names["SharpLearner"](SCENE, NUM_CLASSES), VoteLearner(SCENE, NUM_CLASSES)
    for learner in (sharp, votes):
        learner.observe_all(clean_views(3))
        learner.fit()
    np.testing.assert_array_equal(sharp.codes_.argmax(axis=1), votes.codes_.argmax(axis=1))
    np.testing.assert_array_equal(sharp.observed_, votes.observed_)
    assert (sharp.codes_.max(axis=1) >= votes.codes_.max(axis=1) - 1e-6).all()


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("em", "max_steps is 0; expected a whole number, 1 or more"),
        ("gradient", "epochs is 0, rate 0.05, final_rate 0.005; expected at least one epoch"),
    ],
)
def test_no_steps_at_all_are_refused_and_not_taken_for_as_many_as_usual(name: str, said: str) -> None:
    with pytest.raises(SettingsError, match=said):
        make_learner(name, SCENE, NUM_CLASSES, max_steps=0)


def test_a_learner_in_the_table_is_in_the_help(toy: None, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="0"):
        build_parser().parse_args(["segment", "--help"])
    assert f"{{{','.join(LEARNERS)}}}" in "".join(capsys.readouterr().out.split())


def test_a_learner_in_the_table_is_in_the_errors(toy: None) -> None:
    with pytest.raises(SettingsError, match="learner is 'none'; expected one of em, votes, gradient, toy"):
        make_learner("none", SCENE, NUM_CLASSES)
    with pytest.raises(SettingsError, match=r"learner toy takes one view after .*expected one of em, votes"):
        check_learner("toy", "tcp://127.0.0.1:8786")
    assert distributed_learners() == ["em", "votes"]


def test_a_learner_in_the_table_segments_and_is_reported(toy: None, tmp_path: Path) -> None:
    data, out = write_dataset(tmp_path / "data"), tmp_path / "out"
    report = segment(data / "scene.ply", data, out, learner="toy")
    assert report == json.loads((out / "report.json").read_text())
    assert report["settings"]["learner"] == "toy" and report["calibration"]["held_out"]
    assert len(report["views"]["reliability"]) == report["views"]["used"] > 0
