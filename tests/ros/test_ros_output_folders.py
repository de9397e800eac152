"""Folders that the node writes into lie below its root, whoever moves them meanwhile, and hold exports only."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from gsseg_core.errors import PathNotAllowedError, PathTakenError, WriteError
from gsseg_core.files.run_folder import staged_run
from gsseg_ros.node.output_folders import pinned_folder, require_own_folder, staged_export


def test_a_folder_that_is_swapped_while_it_is_written_to_does_not_lead_out(tmp_path: Path) -> None:
    root = tmp_path / "root"
    root.mkdir()
    folder, outside = root / "new" / "folder", tmp_path / "elsewhere"
    outside.mkdir()
    with pinned_folder(folder, root) as pinned:
        folder.rename(root / "moved")
        folder.symlink_to(outside)
        (pinned / "file").write_text("written")
    assert (root / "moved" / "file").read_text() == "written"
    assert not list(outside.iterdir())
    with pytest.raises(WriteError, match=f"{folder}: cannot be written"), pinned_folder(folder, root):
        pass


def test_errors_name_the_folder_as_it_was_asked_for(tmp_path: Path) -> None:
    root = tmp_path / "root"
    root.mkdir()
    with pytest.raises(WriteError) as caught, pinned_folder(root / "new", root) as pinned:
        raise WriteError(f"{pinned / 'file'}: cannot be written (No space left on device)")
    assert str(caught.value) == f"{root}/new/file: cannot be written (No space left on device)"
    with pytest.raises(PathNotAllowedError, match="does not lie below"), pinned_folder(tmp_path, root):
        pass


def test_a_folder_that_was_made_for_what_then_failed_goes_again_with_those_above_it(tmp_path: Path) -> None:
    root, there = tmp_path / "root", tmp_path / "root" / "there"
    there.mkdir(parents=True)
    for folder in (there, there / "deep" / "er"):
        with pytest.raises(WriteError), staged_export(folder, root) as run:
            raise WriteError(f"{run.folder}: cannot be written (No space left on device)")
    assert list(root.rglob("*")) == [there]
    with pytest.raises(WriteError), pinned_folder(there / "deep" / "er", root) as pinned:
        (pinned / "mine").write_text("written")
        raise WriteError("later")
    assert (there / "deep" / "er" / "mine").read_text() == "written"


def test_a_folder_for_exports_only_must_be_new_empty_or_an_export(tmp_path: Path) -> None:
    for _ in range(2):
        require_own_folder(tmp_path / "new", "segment")
        with staged_run(tmp_path / "new", "segment") as run:
            (run.folder / "report.json").write_text(run.id)
    (tmp_path / "data").mkdir()
    require_own_folder(tmp_path / "data", "segment")
    (tmp_path / "data" / "scene.ply").write_text("mine")
    with pytest.raises(PathTakenError, match=r"data: holds 'scene\.ply', and no results of gsseg segment"):
        require_own_folder(tmp_path / "data", "segment")
    with pytest.raises(PathTakenError, match="is not a folder"):
        require_own_folder(tmp_path / "data" / "scene.ply", "segment")


def test_a_folder_that_somebody_fills_while_an_export_is_computed_is_refused(tmp_path: Path) -> None:
    require_own_folder(tmp_path / "new", "segment")
    (tmp_path / "new").mkdir()
    (tmp_path / "new" / "thesis.tex").write_text("mine")
    with (
        pytest.raises(PathTakenError, match=f"{tmp_path}/new: holds 'thesis.tex'"),
        staged_export(tmp_path / "new", tmp_path),
    ):
        pytest.fail("nothing is to be written")
    assert os.listdir(tmp_path / "new") == ["thesis.tex"]


def test_a_first_export_that_was_killed_within_its_move_is_finished_by_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, killed, replace = tmp_path / "new", tmp_path / "as it was killed", os.replace

    def replace_and_look(source: Path, target: Path) -> None:
        monkeypatch.undo()
        replace(source, target)
        shutil.copytree(folder, killed)

    with staged_export(folder, tmp_path) as run:
        (run.folder / "labels.npz").write_text("first")
        (run.folder / "report.json").write_text("first")
        monkeypatch.setattr(os, "replace", replace_and_look)
    assert not (killed / ".gsseg-run.json").exists() and (killed / "labels.npz").exists()
    require_own_folder(killed, "segment")
    with staged_export(killed, tmp_path) as run:
        (run.folder / "report.json").write_text("second")
    assert {path.name for path in killed.iterdir()} == {".gsseg-run.json", "report.json"}
    assert (killed / "report.json").read_text() == "second"


def test_a_scene_that_is_a_file_of_an_earlier_export_is_not_replaced_by_the_next(tmp_path: Path) -> None:
    with staged_export(tmp_path / "new", tmp_path) as run:
        (run.folder / "cup.ply").write_text("a cup")
    scene = tmp_path / "new" / "cup.ply"
    says = f"{scene}: is read .* all other results in {tmp_path}/new; expected"
    with pytest.raises(PathTakenError, match=says), staged_export(tmp_path / "new", tmp_path, scene):
        pytest.fail("nothing is to be written")
    with pytest.raises(PathTakenError, match=says):  # What the node asks before the work.
        require_own_folder(tmp_path / "new", "segment", scene)
    assert scene.read_text() == "a cup"
    with staged_export(tmp_path / "other", tmp_path, scene) as run:
        (run.folder / "cup.ply").write_text("another")


def test_a_folder_whose_name_is_too_long_for_the_disk_is_one_clear_error(tmp_path: Path) -> None:
    with pytest.raises(WriteError, match="name too long"):
        require_own_folder(tmp_path / ("x" * 300), "segment")
