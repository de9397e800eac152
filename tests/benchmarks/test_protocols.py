"""NVOS, SPIn-NeRF and LERF-Mask: small copies of their layouts are read, run and scored as docs/evaluation.md says."""

from __future__ import annotations

import json
from pathlib import Path

import evaluate_protocol
import numpy as np
import pytest
import small_scenes
from protocol_layouts import CAMERAS, save, true_segmentation, write_lerf, write_nvos, write_spin
from protocols import Task, lerf_mask, nvos, score_task, spin_nerf

from gsseg_core.data.camera_files import read_cameras
from gsseg_core.errors import CameraFileError, MaskFormatError, MaskSizeError


@pytest.fixture
def data(tmp_path: Path) -> Path:
    return small_scenes.write_dataset(tmp_path / "data")


def run(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> list[list[str]]:
    """Cells of the table that the program prints."""
    assert evaluate_protocol.main(arguments) == 0
    lines = capsys.readouterr().out.splitlines()[2:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def test_nvos_is_scored_in_its_target_view_at_the_size_of_its_mask(
    tmp_path: Path, data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = write_nvos(tmp_path / "nvos")
    task = nvos(root, "fern", read_cameras(data))
    assert task.reference is not None
    assert set(np.unique(task.reference.read_labels())) == {-1, 0, 1}
    assert [(view.name, view.camera.width) for view in task.targets] == [("view2", 2 * small_scenes.WIDTH)]
    table = run(["nvos", str(data / "scene.ply"), "--data", str(data), "--masks", str(root), "--name", "fern"], capsys)
    assert table[0][:2] == ["fern", "1"]
    assert float(table[0][2]) > 0.6


@pytest.mark.parametrize("names", [[f"view{i}" for i in range(6)], [f"image{i:03d}" for i in range(6)]])
def test_spin_nerf_is_scored_in_all_views_by_name_or_by_order(
    tmp_path: Path, data: Path, capsys: pytest.CaptureFixture[str], names: list[str]
) -> None:
    folder = write_spin(tmp_path / "fern", names)
    task = spin_nerf(folder, read_cameras(data))
    assert [view.name for view in task.targets] == [camera.name for camera in CAMERAS]
    assert task.reference is task.targets[0]
    table = run(["spin-nerf", str(data / "scene.ply"), "--data", str(data), "--masks", str(folder)], capsys)
    assert table[0][:2] == ["fern", "6"]
    assert float(table[0][2]) > 0.6


def test_spin_nerf_masks_of_some_views_are_paired_by_a_file(tmp_path: Path, data: Path) -> None:
    folder, cameras = write_spin(tmp_path / "orchids", ["a", "b"]), read_cameras(data)
    with pytest.raises(CameraFileError, match=r"2 of 2 masks have no camera.*pairs\.json"):
        spin_nerf(folder, cameras)
    (folder / "pairs.json").write_text(json.dumps({"a": "view0", "b": "view1"}))
    assert [view.name for view in spin_nerf(folder, cameras).targets] == ["view0", "view1"]


@pytest.mark.parametrize("numbered", [True, False])
def test_lerf_mask_is_scored_by_the_name_of_the_class(
    tmp_path: Path, data: Path, capsys: pytest.CaptureFixture[str], numbered: bool
) -> None:
    write_lerf(data, numbered)
    tasks = lerf_mask(data, read_cameras(data))
    assert [(task.name, [view.name for view in task.targets]) for task in tasks] == [("red ball", ["view2", "view5"])]
    true_segmentation().save(tmp_path / "segmentation.npz")
    arguments = ["lerf-mask", str(data / "scene.ply"), "--data", str(data)]
    table = run([*arguments, "--segmentation", str(tmp_path / "segmentation.npz")], capsys)
    assert table[0][:2] == ["red ball", "2"]
    assert float(table[0][2]) > 0.95
    assert evaluate_protocol.main(arguments) == 2
    assert "--segmentation" in capsys.readouterr().err


def test_scores_are_those_of_the_definitions() -> None:
    truths = [np.zeros((10, 10), np.int32) for _ in range(2)]
    truths[0][:5], truths[1][:1] = 1, 1
    views = [small_scenes.View.from_arrays(small_scenes.look_at(f"{i}", np.array([0, 1.0, 3]), 10, 10), truth)
             for i, truth in enumerate(truths)]  # fmt: skip
    prediction = np.zeros((10, 10), bool)
    prediction[:2] = True
    scores = score_task(Task("thing", None, views), lambda camera: prediction)
    assert scores.iou == pytest.approx((20 / 50 + 10 / 20) / 2)
    assert scores.pooled_iou == pytest.approx(30 / 70)
    assert scores.accuracy == pytest.approx((70 + 90) / 200)
    perfect = iter(truths)
    assert score_task(Task("thing", None, views), lambda camera: next(perfect) > 0)[:4] == (1, 1, 1, 1)


def test_a_layout_that_is_not_whole_is_refused(tmp_path: Path, data: Path) -> None:
    cameras = read_cameras(data)
    root = write_nvos(tmp_path / "nvos")
    (root / "scribbles/fern/neg_0.png").unlink()
    with pytest.raises(MaskFormatError, match=r"found 0 files \*neg\*"):
        nvos(root, "fern", cameras)
    with pytest.raises(MaskFormatError, match="found no masks"):
        spin_nerf(tmp_path, cameras)
    with pytest.raises(MaskFormatError, match="found no masks"):
        lerf_mask(data, cameras)
    save(tmp_path / "wide/view0.png", np.ones((10, 50)))
    with pytest.raises(MaskSizeError, match="50 x 10"):
        spin_nerf(tmp_path / "wide", cameras)
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken/view0.png").write_text("no image")
    with pytest.raises(MaskFormatError, match="broken image"):
        spin_nerf(tmp_path / "broken", cameras)
