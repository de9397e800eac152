"""Formats of scenes and cameras: one that is added in its table is read, and messages and `gsseg doctor` list it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from small_scenes import balls_on_a_table

from gsseg_core.cli.main import main
from gsseg_core.data.camera_files import read_cameras
from gsseg_core.data.camera_formats.table import CAMERA_FORMATS, CameraFormat
from gsseg_core.errors import CameraFileError, SceneFileError
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.scene_formats import SCENE_FORMATS, SceneFormat
from gsseg_core.scene.vertices import ReadScene


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
    with pytest.raises(SceneFileError, match=r"is a folder: type .*room.toy"):
        GaussianScene.load(tmp_path)
    main(["doctor"])
    assert "toys" in (told := doctor.readouterr().out) and ".toy" in told
