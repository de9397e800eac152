"""The program that measures robustness: valid plots, bad frames that are bad, learners compared on equal terms."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import robustness
from moving_occluder import depth_of_scene, gated, occlude
from plots import Axis, draw_panels
from robustness import EM, HARD, LEARNERS, PLAIN, VOTES, Bench, learn, right_share, with_bad_frames
from small_scenes import NAMES, NUM_CLASSES, balls_on_a_table, clean_views

SVG = "{http://www.w3.org/2000/svg}"


def bench(**settings: Any) -> Bench:
    data: Any = SimpleNamespace(num_classes=NUM_CLASSES, class_names=NAMES)
    train, test = clean_views(6), clean_views(2, "test", 0.3)
    return Bench("demo scene", balls_on_a_table()[0], data, train, test, 4, (1.0,), (), **settings)


def test_plot_has_a_panel_for_each_title_and_a_line_for_each_series(tmp_path: Path) -> None:
    series = {"a & b": [(0.0, 1.0), (1.0, 0.5)], "c": [(0.0, 0.2)]}
    axis = Axis("share", 0, 1, 0.5)
    draw_panels(tmp_path / "plot.svg", {"one": series, "two": series}, axis, axis)
    root = ElementTree.parse(tmp_path / "plot.svg").getroot()
    texts = [text.text for text in root.iter(f"{SVG}text")]
    assert {"one", "two", "a & b", "c", "share", "0.5"} <= set(texts)
    lines = [line.get("points") for line in root.iter(f"{SVG}polyline")]
    assert len(lines) == 4 and lines[0] == "0.0,0.0 250.0,75.0"
    assert len(list(root.iter(f"{SVG}circle"))) == 6


def test_points_beyond_an_axis_lie_on_its_end() -> None:
    axis = Axis("mIoU", 0.5, 1.0, 0.25)
    assert [axis.place(value) for value in (0.0, 0.5, 0.75, 1.0, 2.0)] == [0, 0, 0.5, 1, 1]
    assert axis.ticks == [0.5, 0.75, 1.0]


def test_a_fifth_of_the_frames_is_bad_and_the_same_each_time() -> None:
    small = bench()
    first, again = with_bad_frames(small, 0), with_bad_frames(small, 0)
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one.read_labels(), other.read_labels())
    assert [view.name for view in first] == [view.name for view in small.train]
    assert min(right_share(first, small.train)) < 0.95


def test_every_learner_but_the_slow_one_is_scored_on_the_same_small_scene() -> None:
    small = bench()
    mious = learn(small, small.train, [name for name in LEARNERS if name != "gradient"])
    assert list(mious) == [EM, PLAIN, VOTES, HARD]
    assert all(0.7 < miou <= 1 for miou in mious.values())


def test_curves_and_the_bar_become_text_and_pictures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robustness, "LEARNERS", (EM, PLAIN, VOTES, HARD))
    monkeypatch.setattr(robustness, "STRONGEST", {"holes": "many", "jittered poses": "far"})
    small = bench()
    curves = robustness.measure_curves([small], tmp_path, tmp_path / "aside")
    assert "| holes | 1 |" in curves and "| jittered poses | 1 | 1.000 |" in curves and "{" not in curves
    assert (tmp_path / "robustness_demo.svg").exists() and (tmp_path / "aside/robustness_demo.json").exists()
    bar, cost = robustness.measure_bar([small])
    em = [
        line.split("|")[-2].strip()
        for line in bar.splitlines()
        if line.startswith("| demo scene, drawn") and "| em |" in line
    ]
    assert cost == f"up to {max(em, key=float)} points of mIoU in the demo scene" and len(em) == 2
    assert "| demo scene, drawn, seed 1 | FlashSplat's rule |" in bar and "15 % missed" in bar and "{" not in bar
    reliability = robustness.measure_reliability([small], tmp_path, tmp_path)
    assert "of 1 |" in reliability and (tmp_path / "reliability.svg").exists()
    assert (tmp_path / "worst_views.png").stat().st_size > 1000


def test_somebody_in_front_is_compared_with_nobody_and_with_what_depth_leaves_of_the_views() -> None:
    small = bench()
    text = robustness.measure_occluder([small])
    rows = [[cell.strip() for cell in line.split("|")] for line in text.splitlines() if line.startswith("| demo scene")]
    assert [row[2] for row in rows] == [EM, VOTES] and "{" not in text
    occluded = occlude(small.train, NUM_CLASSES, depth_of_scene(small.scene), seed=0)
    views, hidden, lost = gated(small.scene, occluded)
    assert hidden > 0.9 and lost < 0.1
    for one, view, left in zip(occluded, small.train, views, strict=True):
        assert (one.view.read_labels() == NUM_CLASSES).sum() == one.person.sum() > 0
        np.testing.assert_array_equal(one.view.read_labels()[~one.person], view.read_labels()[~one.person])
        assert (left.read_labels() == NUM_CLASSES).sum() < 0.1 * one.person.sum()
