"""Formats of scenes and cameras: one that is added in its table is read, and messages and `gsseg doctor` list it."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from mask_writers import sam_json
from PIL import Image
from scene_files import some_scene, write_glb, write_gsplat, write_spz
from small_scenes import NAMES, NUM_CLASSES, balls_on_a_table, clean_views, taught, write_dataset

from gsseg_core.cli.main import main
from gsseg_core.data.camera_files import read_cameras
from gsseg_core.data.camera_formats.table import CAMERA_FORMATS, CameraFormat
from gsseg_core.errors import CameraFileError, SceneFileError
from gsseg_core.export.class_files import export_classes
from gsseg_core.learn.vote_learner import VoteLearner
from gsseg_core.refine.settings import RefineSettings
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.scene_formats import SCENE_FORMATS, SceneFormat
from gsseg_core.scene.vertices import ReadScene
from gsseg_core.segmentation import Segmentation


@pytest.fixture
def doctor(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> pytest.CaptureFixture[str]:
    """`gsseg doctor` without the kernels, which take long."""
    monkeypatch.setattr("gsseg_core.cli.doctor._kernels", lambda say: [])
    return capsys


def test_a_camera_format_is_one_line_in_the_table(
    tmp_path: Path, request: pytest.FixtureRequest, doctor: pytest.CaptureFixture[str]
) -> None:
    def read(path: Path, within: Path | None) -> list[Camera]:
        return [Camera(name, 8, 6, np.diag([10.0, 10, 1]), np.eye(4)) for name in path.read_text().split()]

    CAMERA_FORMATS.append(CameraFormat("toys", read, ("toy.cams",)))
    request.addfinalizer(CAMERA_FORMATS.pop)
    with pytest.raises(CameraFileError, match=r"looked for cameras.json \(3DGS\), .*, and toy.cams \(toys\)"):
        read_cameras(tmp_path)
    (tmp_path / "room").mkdir()
    (tmp_path / "room/toy.cams").write_text("one two")
    assert [camera.name for camera in read_cameras(tmp_path / "room")] == ["one", "two"]
    with pytest.raises(CameraFileError, match=f"found cameras in {tmp_path}/room: type --data"):
        read_cameras(tmp_path)
    main(["doctor"])
    assert "toys" in (told := doctor.readouterr().out) and "toy.cams" in told


def test_a_scene_format_is_one_line_in_the_table(
    tmp_path: Path, request: pytest.FixtureRequest, doctor: pytest.CaptureFixture[str]
) -> None:
    scene, _ = balls_on_a_table()

    def read(path: Path, within: Path | None) -> ReadScene:
        return ReadScene(scene.vertices[: int(path.read_text())])

    SCENE_FORMATS.append(SceneFormat("toys", read, (".toy",)))
    request.addfinalizer(SCENE_FORMATS.pop)
    (tmp_path / "room.toy").write_text("7")
    np.testing.assert_array_equal(GaussianScene.load(tmp_path / "room.toy").means, scene.means[:7])
    (tmp_path / "room.txt").write_text("7")
    with pytest.raises(SceneFileError, match=r"gsseg reads 3DGS PLY \(.ply\), .*, toys \(.toy\)"):
        GaussianScene.load(tmp_path / "room.txt")
    with pytest.raises(SceneFileError, match=r"found room.toy in"):
        GaussianScene.load(tmp_path / "rooom.toy")
    with pytest.raises(SceneFileError, match=r"cannot be read \(is a folder\); expected .*; type .*room.toy"):
        GaussianScene.load(tmp_path)
    main(["doctor"])
    assert "toys" in (told := doctor.readouterr().out) and ".toy" in told


def test_doctor_says_of_a_scene_its_format_and_what_of_it_is_lost(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_spz(3)(tmp_path / "scan.spz", some_scene(70, 2))
    assert main(["doctor", str(tmp_path / "scan.spz")]) == 0
    told = capsys.readouterr().out
    assert "SPZ, version 3" in told and "70 Gaussians, SH of degree 2" in told and "in the order of this file" in told
    assert next(known.keeps for known in SCENE_FORMATS if known.name == "SPZ") in told
    assert "Python" not in told
    (tmp_path / "scan.spz").write_bytes(b"NGSP")
    assert main(["doctor", str(tmp_path / "scan.spz")]) == 2
    assert "scan.spz: header: 4 bytes are there" in capsys.readouterr().err


def test_doctor_says_where_masks_are_what_their_ids_are_and_which_views_are_of_no_split(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    root = write_dataset(tmp_path / "data")
    (root / "split.json").write_text('{"train": ["view0", "view1"], "val": ["view2"], "test": ["view3"]}')
    (root / "labels").rename(root / "true")
    sam_json(root, {"view0": np.ones((96, 128), np.int32)}, {})
    (tmp_path / "sam").mkdir()
    (root / "view0.json").rename(tmp_path / "sam/view0.json")
    assert main(["doctor", str(root)]) == 0
    told = capsys.readouterr().out
    assert "2 to learn from, 1 to test, 3 for neither" in told
    assert "none in labels" in told and "found 6 masks of these names in true/: type --labels true" in told
    monkeypatch.chdir(tmp_path)
    assert main(["doctor", str(root), "--labels", "sam"]) == 0  # as a shell completes it
    assert "SAM JSON, ids per-view, 1 view" in capsys.readouterr().out
    (root / "classes.json").write_text('{"0": "background", "1": "a"}')
    assert main(["doctor", str(root), "--labels", "true"]) == 2 and "takes --ids per-view" in capsys.readouterr().err


def test_doctor_reads_all_masks_of_a_dataset_and_says_that_it_looked_at_no_scene(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = write_dataset(tmp_path / "data")
    assert main(["doctor", str(root)]) == 0
    told = capsys.readouterr().out
    assert "3DGS: 4 to learn from, 2 to test" in told and "of 6 views; all can be read" in told
    assert "scene    not looked at" in told and f"gsseg doctor {root} --scene SCENE" in told
    assert "neither" not in told and "format" not in told
    mask = root / "labels/view3.png"
    mask.write_bytes(mask.read_bytes()[:-30])
    assert main(["doctor", str(root)]) == 2
    assert f"{mask}: broken" in capsys.readouterr().err
    shutil.rmtree(mask.parent)
    assert main(["doctor", str(root)]) == 0
    assert "none in labels" in capsys.readouterr().out


def test_doctor_says_so_where_masks_name_no_object_as_those_of_0_and_255_do(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = write_dataset(tmp_path / "data")
    for path in (root / "labels").iterdir():
        Image.fromarray(np.uint8(255 * (np.array(Image.open(path)) > 0))).save(path)
    assert main(["doctor", str(root)]) == 0
    told = capsys.readouterr().out
    assert "of 6 views; none of them names an object" in told and "as 1 and not 255 for a single object" in told


def test_a_scene_of_another_format_is_segmented_as_its_ply_is(tmp_path: Path) -> None:
    scene, _ = balls_on_a_table()
    views, settings = clean_views(3), RefineSettings(cluster=False, filter=False)
    expected = taught(VoteLearner(scene, NUM_CLASSES), views).fit().codes_
    for name, write in {"glb": write_glb, "pt": write_gsplat, "spz": write_spz(3)}.items():
        write(tmp_path / f"scene.{name}", scene)
        read = GaussianScene.load(tmp_path / f"scene.{name}")
        codes = taught(VoteLearner(read, NUM_CLASSES), views).fit().codes_
        assert (codes.argmax(axis=1) == expected.argmax(axis=1)).mean() > (0.98 if name == "spz" else 0.999)
        result = Segmentation.from_codes(read, codes, NAMES, settings)
        written = export_classes(read, result, tmp_path / name)
        ball = GaussianScene.load(written[1])
        np.testing.assert_array_equal(ball.means, read.means[result.labels == 1])
        result.save(tmp_path / "segmentation.npz")
        arguments = ["--segmentation", f"{tmp_path}/segmentation.npz", "--class", "1", "--out", f"{tmp_path}/rest.ply"]
        assert main(["remove", f"{tmp_path}/scene.{name}", *arguments]) == 0
        np.testing.assert_array_equal(GaussianScene.load(tmp_path / "rest.ply").means, read.means[result.labels != 1])


def test_doctor_says_of_a_folder_without_cameras_what_lies_there_and_where_a_scene_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "capture").mkdir()
    (tmp_path / "capture/poses_bounds.npy").touch()
    assert main(["doctor", str(tmp_path / "capture")]) == 2
    told = capsys.readouterr().err
    assert "has no cameras; looked for cameras.json" in told and "found poses_bounds.npy" in told
    assert told.endswith("; no scene lies in it\n")
    write_dataset(tmp_path / "trained")
    (tmp_path / "trained/cameras.json").unlink()
    assert main(["doctor", str(tmp_path / "trained")]) == 2
    told = capsys.readouterr().err
    assert "has no cameras" in told and told.endswith(f"; type {tmp_path}/trained/scene.ply\n")
