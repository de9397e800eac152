"""Files for others: one PLY per object, all of one segmentation, and pictures."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from small_scenes import NAMES, NUM_CLASSES, balls_on_a_table, clean_views

from gsseg_core.errors import PathTakenError, WriteError
from gsseg_core.export import class_files as export
from gsseg_core.export.class_files import class_file_name, export_classes
from gsseg_core.export.pictures import legend, palette, save_png
from gsseg_core.export.summary import gaussian_counts
from gsseg_core.export.view_pictures import draw_views, view_file_name, write_overview, write_pictures
from gsseg_core.files.json_files import write_json
from gsseg_core.files.run_folder import RUN_FILE
from gsseg_core.refine.settings import PAPER, RefineSettings
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import REMOVED, Segmentation

SCENE, TRUTH = balls_on_a_table()
CODES = np.eye(NUM_CLASSES, dtype=np.float32)[TRUTH]
RESULT = Segmentation.from_codes(SCENE, CODES, NAMES, replace(PAPER, cluster=False, k=10))


def only(label: int) -> Segmentation:
    codes = np.eye(NUM_CLASSES, dtype=np.float32)[np.full(len(SCENE), label)]
    return Segmentation.from_codes(SCENE, codes, NAMES, RefineSettings())


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_an_export_never_replaces_the_scene_that_it_is_of(tmp_path: Path) -> None:
    path = export_classes(SCENE, RESULT, tmp_path)[1]
    before, ball = contents(tmp_path), GaussianScene.load(path)
    of_ball = Segmentation.from_codes(ball, np.eye(NUM_CLASSES, dtype=np.float32)[ball.vertices["label"]], NAMES)
    with pytest.raises(PathTakenError, match=r"1_red_ball\.ply: is read by gsseg classes, which would replace it"):
        export_classes(ball, of_ball, tmp_path)
    assert contents(tmp_path) == before


def visible(folder: Path) -> list[Path]:
    return [path for path in folder.iterdir() if path.name != RUN_FILE]


def test_every_class_is_a_valid_ply_of_exactly_its_gaussians(tmp_path: Path) -> None:
    paths = export_classes(SCENE, RESULT, tmp_path / "classes")
    assert {k: path.name for k, path in paths.items()} == {
        0: "0_background.ply", 1: "1_red_ball.ply", 2: "2_cup_mug.ply", 3: "3_box.ply",
    }  # fmt: skip
    assert sorted(paths.values()) == sorted(visible(tmp_path / "classes"))
    assert (RESULT.labels == -2).any()
    for k, path in paths.items():
        part, mine = GaussianScene.load(path), RESULT.labels == k
        assert part.vertices.dtype.names == (*(SCENE.vertices.dtype.names or ()), "label", "confidence")
        np.testing.assert_array_equal(part.vertices[list(SCENE.vertices.dtype.names or ())], SCENE.vertices[mine])
        assert (part.vertices["label"] == k).all()
        np.testing.assert_array_equal(part.vertices["confidence"], RESULT.confidence[mine])
    assert list(tmp_path.iterdir()) == [tmp_path / "classes"]


@pytest.mark.parametrize("scene_format", ["ply", "splat"])
def test_classes_of_a_scene_in_another_order_are_written_in_that_of_its_file(tmp_path: Path, scene_format: str) -> None:
    expected = contents_of(export_classes(SCENE, RESULT, tmp_path / "file", scene_format))
    order = np.random.default_rng(0).permutation(len(SCENE))
    scene, places = SCENE.subset(order), np.argsort(order)
    result = RESULT.in_order_of(scene.digest, order)
    (tmp_path / "other").mkdir()
    written = export.write_classes(scene, result, tmp_path / "other", "run", scene_format, {}, places)
    assert contents_of(written) == expected


def contents_of(paths: dict[int, Path]) -> dict[int, bytes]:
    """What the files of classes hold, but for the run that they name."""
    return {k: re.sub(rb"(?<=gsseg_run )\S+", b"", path.read_bytes()) for k, path in paths.items()}


def test_no_ply_of_an_earlier_export_remains(tmp_path: Path) -> None:
    folder = tmp_path / "classes"
    export_classes(SCENE, RESULT, folder)
    export_classes(SCENE, only(2), folder)
    assert [path.name for path in visible(folder)] == ["2_cup_mug.ply"]
    assert len(GaussianScene.load(folder / "2_cup_mug.ply")) == len(SCENE)


@pytest.mark.parametrize(
    "error", [WriteError("x: cannot be written"), KeyboardInterrupt()], ids=["disk full", "Ctrl-C"]
)
def test_a_failed_export_leaves_the_earlier_folder_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    folder = tmp_path / "classes"
    export_classes(SCENE, only(1), folder)
    before, write = contents(folder), export.write_parts
    written: list[Path] = []

    def fails_at_the_third(path: Path, *what: Any) -> None:
        written.append(path)
        if len(written) == 3:
            raise error
        write(path, *what)

    monkeypatch.setattr(export, "write_parts", fails_at_the_third)
    with pytest.raises(type(error)):
        export_classes(SCENE, RESULT, folder)
    assert contents(folder) == before and list(tmp_path.iterdir()) == [folder]


def test_files_of_others_in_the_folder_stay(tmp_path: Path) -> None:
    folder = tmp_path / "classes"
    folder.mkdir()
    for name in ("thesis.tex", "1_mine.ply", ".hidden"):
        (folder / name).write_text("years of work")
    export_classes(SCENE, RESULT, folder)
    export_classes(SCENE, only(2), folder)
    assert sorted(path.name for path in visible(folder)) == [".hidden", "1_mine.ply", "2_cup_mug.ply", "thesis.tex"]
    assert all((folder / name).read_text() == "years of work" for name in ("thesis.tex", "1_mine.ply", ".hidden"))


def test_names_that_are_taken_are_refused_and_nothing_is_written(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "3_box.ply").write_text("years of work")
    (tmp_path / "file").write_text("a file")
    with pytest.raises(PathTakenError, match=r"mine/3_box\.ply: was not written by gsseg"):
        export_classes(SCENE, RESULT, tmp_path / "mine")
    with pytest.raises(PathTakenError, match="file: is not a folder; expected"):
        export_classes(SCENE, RESULT, tmp_path / "file")
    with pytest.raises(WriteError, match="cannot be written"):
        export_classes(SCENE, RESULT, tmp_path / "file" / "classes")
    assert contents(tmp_path / "mine") == {"3_box.ply": b"years of work"}
    assert (tmp_path / "file").read_text() == "a file"


@pytest.mark.parametrize("name", ["a" * 300, "\x00", "\ud800", "a/b", "椅" * 120])
def test_every_name_of_a_view_gives_a_file_name_that_can_be_written(tmp_path: Path, name: str) -> None:
    file_name = view_file_name(name, "overlay_")
    (tmp_path / file_name).write_bytes(b"")
    assert file_name != view_file_name(name + "x", "overlay_") and view_file_name("view 7") == "view 7.png"


@pytest.mark.parametrize(
    ("name", "file_name"),
    [("chair", "7_chair.ply"), ("../../etc/passwd", "7_etc_passwd.ply"), ("a b\n\tc:*?", "7_a_b_c.ply"),
     ("..", "7_class.ply"), ("", "7_class.ply"), ("椅子", "7_class.ply"), ("x" * 400, f"7_{'x' * 100}.ply")],
)  # fmt: skip
def test_names_of_classes_become_safe_names_of_files(name: str, file_name: str) -> None:
    assert class_file_name(7, name) == file_name


def test_a_contact_sheet_of_very_many_views_is_about_as_wide_as_high(tmp_path: Path) -> None:
    sides = {}
    for count in (16, 100):
        write_overview(RESULT, [np.zeros((60, 80, 3), np.uint8)] * count, ["a"] * count, tmp_path, save_png)
        with Image.open(tmp_path / "contact_sheet.png") as sheet:
            sides[count] = sheet.size
    assert sides[16][0] == 4 * 92 + 12 and sides[100][0] == 10 * 92 + 12 and sides[100][1] < 1.2 * sides[100][0]


def test_pictures_are_an_overlay_per_view_a_contact_sheet_and_a_legend(tmp_path: Path) -> None:
    paths = write_pictures(RESULT, draw_views(SCENE, RESULT, clean_views(2)), tmp_path)
    assert [path.name for path in paths] == [
        "overlay_view0.png", "overlay_view1.png", "contact_sheet.png", "legend.png",
    ]  # fmt: skip
    for path in paths:
        with Image.open(path) as image:
            assert image.mode == "RGB"
            assert np.asarray(image).std() > 5
    with Image.open(paths[0]) as image:
        assert image.size == (64, 48)


def test_the_legend_of_a_vocabulary_has_the_classes_that_are_there(tmp_path: Path) -> None:
    shown = {k: RESULT.class_names[k] for k in np.flatnonzero(RESULT.counts()).tolist()}
    many = replace(RESULT, class_names={**RESULT.class_names, **{k: f"class {k}" for k in range(4, 20_000)}})
    write_pictures(many, [], tmp_path)
    with Image.open(tmp_path / "legend.png") as image:
        np.testing.assert_array_equal(np.asarray(image), legend(shown, palette(20_000), many.counts()))


def test_gaussians_labelled_by_their_neighbours_are_among_those_labelled() -> None:
    some = replace(RESULT, clustered=np.arange(len(SCENE)) % 2 == 0)
    removed = some.labels == REMOVED
    counts = gaussian_counts(some)
    assert (some.clustered & removed).any() and counts["removed"] == removed.sum()
    assert counts["from_neighbours"] == (some.clustered & (some.labels >= 0)).sum()


def test_a_report_that_cannot_be_written_leaves_the_earlier_one(tmp_path: Path) -> None:
    write_json(tmp_path / "report.json", {"a": 1})
    with pytest.raises(WriteError):
        write_json(tmp_path / "report.json" / "below.json", {"a": 2})
    assert json.loads((tmp_path / "report.json").read_text()) == {"a": 1}
