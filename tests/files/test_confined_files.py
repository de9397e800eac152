"""Files that must lie below a folder: links that lead out are refused, also those that are made at the last moment."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from small_scenes import write_dataset

from gsseg_core.data.dataset import Dataset
from gsseg_core.errors import CameraFileError, PathNotAllowedError
from gsseg_core.files import input_files
from gsseg_core.files.input_files import open_input
from gsseg_core.scene.gaussian_scene import GaussianScene


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A folder with a dataset in it that has every kind of file; what is beside it is out of bounds."""
    root = tmp_path / "root"
    labels = write_dataset(root / "data") / "labels"
    shape = np.asarray(Image.open(labels / "view1.png")).shape
    for stem in ("view1", "view2"):
        (labels / f"{stem}.png").unlink()
    np.savez(labels / "view1.npz", probabilities=np.full((1, *shape), 0.5, np.float32), classes=[1])
    (labels / "view2").mkdir()
    Image.fromarray(np.full(shape, 255, np.uint8)).save(labels / "view2" / "1.png")
    (labels / "supervises.json").write_text(json.dumps({"view0": [1, 2, 3]}))
    return root


def read_everything(folder: Path, within: Path | None) -> None:
    for view in Dataset(folder, within=within).views("all"):
        if view.has_mask:
            view.read_seen()


def moved_out(path: Path, root: Path) -> None:
    """Move a file or folder out of bounds, and leave a link to it."""
    outside = root.parent / f"outside_{path.name}"
    path.rename(outside)
    path.symlink_to(outside)


@pytest.mark.parametrize(
    "name",
    [
        "cameras.json", "classes.json", "split.json", "labels/supervises.json", "labels/view0.png", "labels/view1.npz",
        "labels/view2", "labels/view2/1.png", "labels",
    ],
)  # fmt: skip
def test_a_link_in_a_dataset_that_leads_out_is_refused_only_where_there_are_bounds(root: Path, name: str) -> None:
    data = root / "data"
    read_everything(data, within=root)
    moved_out(data / name, root)
    read_everything(data, within=None)
    with pytest.raises(PathNotAllowedError, match=f"{name}: leads out of {root}; expected what lies below it"):
        read_everything(data, within=root)


def test_a_link_that_stays_inside_is_followed(root: Path) -> None:
    (root / "data" / "labels").rename(root / "masks")
    (root / "data" / "labels").symlink_to(root / "masks")
    read_everything(root / "data", within=root)


def test_a_scene_is_kept_below_the_folder(root: Path) -> None:
    scene = root / "data" / "scene.ply"
    assert GaussianScene.load(scene, root).path == scene
    moved_out(scene, root)
    assert len(GaussianScene.load(scene)) == 626
    with pytest.raises(PathNotAllowedError, match=r"scene\.ply: leads out of"):
        GaussianScene.load(scene, root)


def test_a_fifo_in_a_dataset_is_an_error_and_is_not_waited_for(root: Path) -> None:
    (root / "data" / "cameras.json").unlink()
    os.mkfifo(root / "fifo")
    (root / "data" / "cameras.json").symlink_to(root / "fifo")
    with pytest.raises(PathNotAllowedError):
        open_input(root / "data" / "cameras.json", root / "data")
    with pytest.raises(OSError, match="is a named pipe"):
        open_input(root / "fifo", root)
    with pytest.raises(CameraFileError, match="is a named pipe; expected a regular file"):
        Dataset(root / "data", within=root)


def test_a_link_that_is_swapped_after_the_check_does_not_lead_out(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, secret = root / "note.txt", root.parent / "secret.txt"
    path.write_text("mine")
    secret.write_text("secret")
    check = input_files.require_below

    def check_and_swap(*arguments: object) -> None:
        check(*arguments)  # type: ignore[arg-type]
        path.unlink()
        path.symlink_to(secret)

    monkeypatch.setattr(input_files, "require_below", check_and_swap)
    with open_input(path, root) as file:
        assert file.read() == b"mine"
