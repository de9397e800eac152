"""Ids of one object are found by what the other views say, and by no mask showing two of them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from small_scenes import (
    NUM_CLASSES,
    balls_on_a_table,
    clean_views,
    fed,
    lost_half_way,
    taught,
    write_dataset,
    wrong_views,
)

from gsseg_core.cli.main import main
from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.dataset import Dataset
from gsseg_core.data.label_images import write_mask
from gsseg_core.data.view import View
from gsseg_core.learn.em.em_learner import EMLearner
from gsseg_core.learn.mask_reliability import MaskChecker, ViewCheck
from gsseg_core.learn.renamed_ids import renamed_ids, renamed_report
from gsseg_core.live.session import LiveSession


def check(classes: list[int], counts: dict[tuple[int, int], int]) -> ViewCheck:
    """Counts by class predicted and place of the label."""
    table = np.zeros((8, len(classes)), np.int64)
    for cell, count in counts.items():
        table[cell] = count
    return ViewCheck("view", int(table.sum()), np.array(classes, np.int32), CSRRows.from_dense(table))


def renamed_in(session: LiveSession) -> list[dict[str, str]]:
    return [] if session.learnt is None else renamed_report(session.learnt.renamed, session.class_names)


def found_in(views: list[View]) -> dict[int, int]:
    return renamed_ids(MaskChecker(taught(EMLearner(balls_on_a_table()[0], 2 * NUM_CLASSES), views).fit()).check_all())


def test_objects_that_a_tracker_lost_half_way_have_two_ids_and_are_found_by_one_at_least() -> None:
    found = {frozenset(pair) for pair in found_in(lost_half_way(clean_views(12))).items()}
    assert len(found) >= 2 and found <= {frozenset((k, k + NUM_CLASSES)) for k in range(1, NUM_CLASSES)}


@pytest.mark.parametrize("views", [clean_views(8), wrong_views(12)], ids=["right", "missed and swapped"])
def test_ids_that_hold_in_all_views_are_never_found(views: list[View]) -> None:
    assert found_in(views) == {}


def test_what_one_mask_shows_together_is_two_objects() -> None:
    one, other = check([0, 1], {(0, 0): 50, (2, 1): 9, (1, 1): 4}), check([1], {(3, 0): 5, (2, 0): 9})
    apart = [one, other, check([2], {(2, 0): 1})]
    assert renamed_ids(apart) == {1: 2}
    together = check([1, 2, 3], {(1, 0): 1, (2, 1): 1, (3, 2): 1})
    assert renamed_ids([*apart, together]) == {}


def test_a_session_finds_them_by_the_masks_that_it_samples_and_asks_all_masks_what_they_show_together() -> None:
    views = lost_half_way(clean_views(40))
    session = fed(LiveSession(balls_on_a_table()[0]), views)
    assert renamed_in(session) == []
    session.learn("votes")
    assert renamed_in(session) == []
    session.learn("em")
    pairs = [{int(name[-2:]) for name in entry.values()} for entry in renamed_in(session)]
    assert len(pairs) >= 2 and all(pair in [{k, k + NUM_CLASSES} for k in range(1, NUM_CLASSES)] for pair in pairs)
    checks = [check([1], {(2, 0): 9}), check([1], {(2, 0): 9}), check([2], {(2, 0): 1})]
    assert renamed_ids(checks, [np.array([[-1, 1, 7]])]) == {1: 2}
    assert renamed_ids(checks, [np.array([[2, 1, 7]])]) == {}


def test_what_a_single_view_shows_or_the_background_takes_is_not_found() -> None:
    assert renamed_ids([check([1], {(2, 0): 9}), check([2], {(2, 0): 9})]) == {}
    assert renamed_ids([check([1], {(0, 0): 9}), check([1], {(0, 0): 9})]) == {}
    assert renamed_ids([check([-1], {(3, 0): 9}), check([], {})]) == {}


def test_the_command_says_which_ids_name_one_object_and_finds_objects_whatever_their_ids(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = write_dataset(tmp_path / "data")
    for view in lost_half_way(Dataset(data).views("train")):
        write_mask(data / "labels" / f"{view.name}.png", view.read_labels(), 8)
    (data / "classes.json").unlink()
    command = ["segment", f"{data}/scene.ply", "--data", str(data), "--quiet", "--out", f"{tmp_path}/out"]
    assert main(command) == 0
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "and no mask shows both: class_" in said and "--ids per" in said
    report = json.loads((tmp_path / "out/report.json").read_text())
    assert report["views"]["renamed"] and ", and no mask shows both" in (tmp_path / "out/report.html").read_text()
    assert main([*command, "--ids", "per-view"]) == 0 and capsys.readouterr().err == ""
    assert "renamed" not in json.loads((tmp_path / "out/report.json").read_text())["views"]
