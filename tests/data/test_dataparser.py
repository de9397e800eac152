"""nerfstudio's frames: cameras of transforms.json and of COLMAP land where nerfstudio trained its Gaussians."""

from __future__ import annotations

import math
from argparse import Namespace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_folders import POINT, entry_3dgs, transforms, write_colmap, write_json
from scipy.spatial.transform import Rotation

from gsseg_core.align.placing import place
from gsseg_core.cli.shared import note_frame
from gsseg_core.data.camera_files import frame_of_training, read_cameras
from gsseg_core.data.dataset import Dataset
from gsseg_core.errors import CameraFileError, PoseError
from gsseg_core.scene.gaussian_scene import GaussianScene

# What the dataparser did to poses of transforms.json, x -> 0.25 (TURN x + SHIFT); before that, x -> APPLIED x.
TURN, SHIFT = Rotation.from_euler("xyz", (20, -30, 40), degrees=True).as_matrix(), np.array([0.5, -1.0, 2.0])
SCALE = 0.25
APPLIED = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]])
COLMAP_APPLIED = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]])


def dataparser(applied: np.ndarray = APPLIED[:, :3], applied_scale: float = 1.0, **changes: Any) -> dict[str, Any]:
    """What nerfstudio writes: both, with what was applied before in them."""
    matrix = np.column_stack([TURN @ applied, SHIFT])
    return {"transform": matrix.tolist(), "scale": SCALE * applied_scale} | changes


def trained(point: np.ndarray) -> np.ndarray:
    """Where a point of the frame of transforms.json is when nerfstudio trains."""
    return np.asarray(SCALE * (TURN @ point + SHIFT))


def test_cameras_of_transforms_json_land_in_the_frame_of_training_whatever_was_applied_before(tmp_path: Path) -> None:
    write_json(tmp_path / "transforms.json", transforms(applied_transform=APPLIED.tolist(), applied_scale=2.0))
    write_json(tmp_path / "dataparser_transforms.json", dataparser(applied_scale=2.0))
    (camera,) = read_cameras(tmp_path)
    moved = frame_of_training(tmp_path, tmp_path / "dataparser_transforms.json")
    assert moved is not None
    seen, depth = moved.camera(camera).project([trained(np.array(POINT))])
    expected, before = camera.project([POINT])
    np.testing.assert_allclose(seen, expected)
    np.testing.assert_allclose(depth, SCALE * before)


@pytest.mark.parametrize("beside_colmap", [False, True])
def test_without_an_applied_transform_nerfstudios_own_default_is_undone(tmp_path: Path, beside_colmap: bool) -> None:
    write_json(tmp_path / "transforms.json", transforms())
    if beside_colmap:
        (tmp_path / "colmap/sparse/0").mkdir(parents=True)
    applied = COLMAP_APPLIED[:, :3] if beside_colmap else np.eye(3)
    write_json(tmp_path / "dp.json", dataparser(applied))
    moved = frame_of_training(tmp_path, tmp_path / "dp.json")
    assert moved is not None
    np.testing.assert_allclose(moved.points(np.array(POINT)), trained(np.array(POINT)))


def test_cameras_of_colmap_are_in_the_original_frame_so_that_nothing_is_undone(tmp_path: Path) -> None:
    write_colmap(tmp_path / "sparse/0")
    write_json(tmp_path / "dp.json", dataparser(COLMAP_APPLIED[:, :3]))
    moved = frame_of_training(tmp_path, tmp_path / "dp.json")
    assert moved is not None
    np.testing.assert_allclose(moved.points(np.array(POINT)), trained(COLMAP_APPLIED[:, :3] @ np.array(POINT)))


def one_gaussian(path: Path | None = None) -> GaussianScene:
    one = np.ones((1, 3))
    scene = GaussianScene.from_arrays(one, np.ones((1, 4)), one, np.ones(1), np.ones((1, 1, 3)))
    if path is not None:
        path.parent.mkdir(exist_ok=True)
        scene.save(path)
        return GaussianScene.load(path)
    return scene


@pytest.mark.parametrize("beside", ["scene", "dataset", "elsewhere"])
def test_the_file_is_found_beside_the_scene_or_in_the_dataset_and_else_where_it_is_named(
    tmp_path: Path, beside: str
) -> None:
    data = tmp_path / "data"
    data.mkdir()
    write_json(data / "transforms.json", transforms())
    scene = one_gaussian(tmp_path / "export/splat.ply")
    folder = {"scene": tmp_path / "export", "dataset": data, "elsewhere": tmp_path}[beside]
    write_json(folder / "dataparser_transforms.json", dataparser(np.eye(3)))
    given = folder / "dataparser_transforms.json" if beside == "elsewhere" else None
    assert place(scene, Dataset(data), dataparser=given).dataset.cameras[0].center == pytest.approx(
        trained(read_cameras(data)[0].center)
    )
    if given:
        assert place(scene, Dataset(data)).dataset.cameras[0].center == pytest.approx(read_cameras(data)[0].center)


def test_cameras_that_nerfstudio_does_not_train_from_stay_and_a_file_named_for_them_is_refused(tmp_path: Path) -> None:
    write_json(tmp_path / "cameras.json", [entry_3dgs()])
    write_json(tmp_path / "dataparser_transforms.json", dataparser())
    dataset = Dataset(tmp_path)
    assert place(one_gaussian(), dataset).dataset.cameras[0].center == pytest.approx(dataset.cameras[0].center)
    with pytest.raises(CameraFileError, match="does not describe the cameras"):
        place(one_gaussian(), dataset, dataparser=tmp_path / "dataparser_transforms.json")
    with pytest.raises(CameraFileError, match=r"no\.json: does not exist; expected nerfstudio's dataparser_transforms"):
        place(one_gaussian(), dataset, dataparser=tmp_path / "no.json")


@pytest.mark.parametrize(
    ("content", "error", "words"),
    [
        ([], CameraFileError, "holds a list; expected an object with 'transform'"),
        ({"scale": 1}, CameraFileError, "lacks 'transform'"),
        (dataparser(scale=0), CameraFileError, "'scale' is 0; expected a positive number"),
        (dataparser(scale=math.nan), CameraFileError, "'scale' is nan"),
        (dataparser(scale=math.inf), CameraFileError, "'scale' is inf"),
        (dataparser(scale="large"), CameraFileError, "'scale' is large; expected a number"),
        (dataparser(transform=[[1, 0], [0, 1]]), CameraFileError, "3 x 4 numbers or 4 x 4 numbers"),
        (dataparser(transform=(2 * np.eye(4)).tolist()), PoseError, "no rigid motion"),
        (dataparser(transform=np.diag([1, 1, -1, 1]).tolist()), PoseError, "no rigid motion"),
        (dataparser(transform=np.full((3, 4), math.nan).tolist()), PoseError, "NaN or too large"),
        (dataparser(transform=np.full((3, 4), 1e300).tolist()), PoseError, "NaN or too large"),
    ],
)
def test_a_broken_file_is_refused_with_one_clear_error(
    tmp_path: Path, content: object, error: type[Exception], words: str
) -> None:
    write_json(tmp_path / "transforms.json", transforms())
    write_json(tmp_path / "dp.json", content)
    with pytest.raises(error) as raised:
        frame_of_training(tmp_path, tmp_path / "dp.json")
    assert words in str(raised.value) and "dp.json" in str(raised.value) and "\n" not in str(raised.value)


def test_an_applied_transform_that_cannot_be_undone_is_refused(tmp_path: Path) -> None:
    write_json(tmp_path / "transforms.json", transforms(applied_transform=np.zeros((3, 4)).tolist()))
    write_json(tmp_path / "dp.json", dataparser())
    with pytest.raises(PoseError, match="'applied_transform' is not invertible"):
        frame_of_training(tmp_path, tmp_path / "dp.json")


def test_a_truncated_file_is_refused_wherever_it_ends(tmp_path: Path) -> None:
    write_json(tmp_path / "transforms.json", transforms())
    write_json(tmp_path / "dp.json", dataparser())
    content = (tmp_path / "dp.json").read_bytes().rstrip()
    for end in range(0, len(content), 7):
        (tmp_path / "dp.json").write_bytes(content[:end])
        with pytest.raises(CameraFileError):
            frame_of_training(tmp_path, tmp_path / "dp.json")


@pytest.mark.parametrize(
    ("scene", "named", "given", "notes"),
    [
        ("here", "away/dataparser_transforms.json", None, 1),
        ("away", "away/dataparser_transforms.json", None, 0),
        ("here", "away/dataparser_transforms.json", "file", 0),
        ("away", "other_folder/../away/dataparser_transforms.json", None, 0),
        ("away", "as_named_from_elsewhere/dataparser_transforms.json", None, 0),
        ("here", "of_another_name.json", None, 1),
        ("away", "of_another_name.json", None, 1),
    ],
)
def test_a_command_says_so_where_the_run_was_told_of_a_file_and_it_is_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], scene: str, named: str, given: str | None, notes: int
) -> None:
    for folder in ("away", "other_folder"):
        (tmp_path / folder).mkdir()
    for name in ("away/dataparser_transforms.json", "of_another_name.json"):
        write_json(tmp_path / name, {})
    file = tmp_path / named
    write_json(tmp_path / "report.json", {"frame": {"dataparser": str(file), "alignment": None}})
    paths = {"scene": tmp_path / scene / "scene.ply", "data": tmp_path, "segmentation": tmp_path / "segmentation.npz"}
    note_frame(Namespace(**paths, align=False, dataparser=given))
    assert capsys.readouterr().err.count(f"try --dataparser {file}") == notes
