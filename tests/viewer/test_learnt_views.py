"""What the viewer knows of the views: the masks that the run learnt from, in the classes that it learnt."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from per_view_ids import shuffled
from small_scenes import balls_on_a_table, write_dataset

from gsseg_core.cli.main import main
from gsseg_core.data.dataset import Dataset
from gsseg_core.data.label_images import UNKNOWN, write_mask
from gsseg_core.data.view import View
from gsseg_core.errors import LabelMapError, StateFileError
from gsseg_core.segmentation import Segmentation
from gsseg_core.viewer.learnt_views import LearntFrom

SCENE, TRUTH = balls_on_a_table()


@pytest.fixture
def data(tmp_path: Path) -> Path:
    return write_dataset(tmp_path / "data")


def segmented(data: Path, *options: str) -> Path:
    out = data.parent / "out"
    assert main(["segment", str(data / "scene.ply"), "--data", str(data), "--out", str(out), "--quiet", *options]) == 0
    return out


def shown_views(data: Path, monkeypatch: pytest.MonkeyPatch, *options: str) -> list[View]:
    """The views that `gsseg view` hands to the viewer, which is interrupted at once."""
    given: list[View] = []

    class Viewer:
        def __init__(self, model: Any, views: list[View], *rest: Any, **settings: Any) -> None:
            given.extend(views)

        def close(self) -> None:
            pass

        @property
        def url(self) -> str:
            raise KeyboardInterrupt

    monkeypatch.setattr("gsseg_core.viewer.viewer.Viewer", Viewer)
    assert main(["view", str(data / "scene.ply"), "--data", str(data), "--quiet", *options]) == 0
    return given


def test_masks_of_ids_of_each_views_own_are_shown_as_the_objects_that_they_were_found_to_be_or_not_at_all(
    data: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (data / "sam").mkdir()
    true = Dataset(data).views("train")
    for seed, view in enumerate(true):
        write_mask(data / "sam" / f"{view.name}.png", shuffled(view, seed).read_labels(), 16)
    out = segmented(data, "--labels", "sam", "--ids", "per-view")
    views = shown_views(data, monkeypatch, "--segmentation", str(out / "segmentation.npz"))
    assert [view.name for view in views] == [view.name for view in true]
    result = Segmentation.load(out / "segmentation.npz", SCENE)
    objects = [np.bincount(result.labels[(k == TRUTH) & (result.labels >= 0)]).argmax() for k in range(4)]
    for view, same in zip(views, true, strict=True):
        labels = view.read_labels()
        known = labels != UNKNOWN
        assert known.mean() > 0.9
        np.testing.assert_array_equal(labels[known], np.array(objects)[same.read_labels()[known]])
    (out / "segmentation.npz").rename(data / "saved.npz")
    assert shown_views(data, monkeypatch, "--segmentation", str(data / "saved.npz")) == []
    assert "no report.json beside" in capsys.readouterr().err


def test_masks_are_shown_in_the_classes_of_the_label_map_that_the_run_took(
    data: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (data.parent / "map.json").write_text('{"1": "thing", "2": "thing", "3": null}')
    monkeypatch.chdir(data.parent)
    out = segmented(data, "--label-map", "map.json")
    (view, *_) = shown_views(data, monkeypatch, "--segmentation", str(out / "segmentation.npz"))
    assert set(np.unique(view.read_labels())) == {UNKNOWN, 0, 1}
    (data.parent / "map.json").unlink()
    with pytest.raises(LabelMapError, match=r"map\.json: .*; .*report\.json says that the run took it"):
        LearntFrom.read(out / "report.json").dataset(str(data))


def test_it_is_said_where_no_view_has_a_mask(
    data: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = segmented(data)
    (data / "labels").rename(data / "others")
    assert not shown_views(data, monkeypatch, "--segmentation", str(out / "segmentation.npz"))
    assert f"found no mask of a train view in {data / 'labels'}" in capsys.readouterr().err


def test_reliability_is_read_from_a_report(tmp_path: Path) -> None:
    report = tmp_path / "report.json"
    assert LearntFrom.read(report) == LearntFrom()
    entries = [{"name": "a", "reliability": 0.5}, {"name": "b", "reliability": None}]
    report.write_text(json.dumps({"views": {"reliability": entries}}))
    assert LearntFrom.read(report) == LearntFrom(report, {"a": 0.5})
    for broken in ("[]", '{"views": {}, "settings": 7}', '{"views": {}, "settings": {"ids": "per-view"}}'):
        report.write_text(broken)
        with pytest.raises(StateFileError, match=r"report.json: no report of a run .*; expected the report.json of `"):
            LearntFrom.read(report)


@pytest.mark.parametrize(
    "settings",
    [
        {"labels": 5}, {"labels": None}, {"label_map": {"1": 2}},
        *({"ids": "per-view", "objects": ids} for ids in ({"1": -7}, {"99999999": 3}, {"1": 10**30})),
    ],
)  # fmt: skip
def test_a_report_whose_masks_are_no_path_or_whose_objects_are_no_labels_is_refused(
    tmp_path: Path, settings: dict[str, Any]
) -> None:
    report, ids = tmp_path / "report.json", {"views": {"view0": {"objects": settings.pop("objects", {})}}}
    report.write_text(json.dumps({"views": {}, "settings": settings, "ids": ids}))
    with pytest.raises(StateFileError, match=r"report.json: no report of a run .*; expected the report.json of `"):
        LearntFrom.read(report)
