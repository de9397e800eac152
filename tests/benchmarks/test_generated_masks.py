"""The benchmark of masks that a generator made: what it scores is what the truth says of them."""

from __future__ import annotations

import sys
from pathlib import Path

import generated_masks
import pytest
from mask_writers import sam_json
from small_scenes import write_dataset

from gsseg_core.data.dataset import Dataset


def test_masks_of_whole_objects_are_all_found_and_nothing_is_scored_that_has_no_masks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    data, masks = write_dataset(tmp_path / "data/balls"), tmp_path / "masks/balls"
    masks.mkdir(parents=True)
    (tmp_path / "masks/no such scene").mkdir()
    train = Dataset(data).views("train")
    sam_json(masks, {view.name: view.read_labels() for view in train[:3]}, {})
    arguments = ["generated_masks.py", str(tmp_path / "masks"), "--data", str(tmp_path / "data")]
    monkeypatch.setattr(sys, "argv", [*arguments, "--out", str(tmp_path / "out/masks.md")])
    assert generated_masks.main() == 0
    rows = [line.split(", ") for line in capsys.readouterr().out.splitlines()[:-1]]
    assert [row[:6] for row in rows] == [["balls", "3", "3", ids, "3", "3"] for ids in ("nested", "flat", "true")]
    best = [float(score) for row in rows for score in row[6:] if score]
    assert len(best) == 8 and min(best) > 0.7 and len(set(best[:3])) == 1
    assert (tmp_path / "out/masks.md").read_text().count("balls") == 3
