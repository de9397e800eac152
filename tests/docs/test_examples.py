"""Examples that need no running ROS: the notebook, masks from photos, a bag without a node."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from doc_blocks import blocks_of
from patience import PATIENCE
from PIL import Image
from scipy.spatial.transform import Rotation
from small_scenes import NAMES, write_dataset

from gsseg_core.cli.main import main
from gsseg_core.data.dataset import Dataset
from gsseg_core.data.label_images import read_mask
from gsseg_core.data.view import View
from gsseg_core.demo import table_scene
from gsseg_core.files.json_files import write_json
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import Segmentation

REPOSITORY = Path(__file__).parents[2]
NOTEBOOK = REPOSITORY / "examples/from_ply_to_objects.ipynb"


def run_example(name: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, str(REPOSITORY / "examples" / name), *map(str, arguments)],
        env={**os.environ, "PYTHONPATH": str(REPOSITORY)}, text=True, capture_output=True,
        timeout=PATIENCE, check=False,
    )  # fmt: skip


def test_every_example_is_listed() -> None:
    listing = (REPOSITORY / "examples/README.md").read_text()
    for path in (REPOSITORY / "examples").iterdir():
        assert path.suffix not in (".py", ".ipynb") or f"({path.name})" in listing, path.name


def test_the_program_of_the_readme_gives_what_the_command_gives(
    tmp_path: Path, demo_run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "DATASET").symlink_to(demo_run / "scene")
    (tmp_path / "scene.ply").symlink_to(demo_run / "scene/scene.ply")
    monkeypatch.chdir(tmp_path)
    (program,) = (block.code for block in blocks_of("README.md") if block.language == "python")
    names: dict[str, object] = {}
    exec(program, names)
    result, scene = names["result"], names["scene"]
    assert isinstance(result, Segmentation) and isinstance(scene, GaussianScene)
    command = Segmentation.load(demo_run / "segmented/segmentation.npz", scene)
    np.testing.assert_array_equal(result.labels, command.labels)
    np.testing.assert_array_equal(result.probabilities, command.probabilities)
    np.testing.assert_array_equal(result.confidence, command.confidence)


def copy_with_fewer_views(demo_run: Path, folder: Path, every: int) -> list[str]:
    """Copy the demo's scene as a dataset with every so manieth of its training views, and name these."""
    shutil.copytree(demo_run / "scene", folder)
    split = json.loads((folder / "split.json").read_text())
    (folder / "split.json").write_text(json.dumps({**split, "train": split["train"][::every]}))
    names: list[str] = split["train"][::every]
    return names


def test_the_notebook_runs_from_its_first_cell_to_its_last_and_stores_no_output(
    tmp_path: Path, demo_run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def demo_that_is_there(folder: str) -> SimpleNamespace:
        copy_with_fewer_views(demo_run, Path(folder), 2)
        return SimpleNamespace(root=Path(folder))

    monkeypatch.setattr(table_scene, "build_demo", demo_that_is_there)
    notebook = json.loads(NOTEBOOK.read_text())
    assert notebook["nbformat"] == 4
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert cells and all(cell["outputs"] == [] and cell["execution_count"] is None for cell in cells)
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for cell in cells:
        exec(compile("".join(cell["source"]), cell["id"], "exec"), names)
    out = capsys.readouterr().out
    assert "10 classes" in out and "class of the pixel: " in out
    objects = sorted((tmp_path / "notebook_demo/objects").glob("*.ply"))
    assert len(objects) == 10 and len(GaussianScene.load(objects[1])) > 500


def test_masks_of_a_segmenter_that_knows_no_objects_are_segmented_per_view(tmp_path: Path, demo_run: Path) -> None:
    pytest.importorskip("skimage", reason="scikit-image is not installed")
    data = tmp_path / "data"
    names = copy_with_fewer_views(demo_run, data, 6)
    ran = run_example("masks_from_photos.py", data, "--scene", data / "scene.ply", "--out", "auto")
    assert ran.returncode == 0, ran.stderr
    assert [read_mask(data / f"auto/{stem}.png").bits for stem in names] == [16] * 5
    command = ["segment", f"{data}/scene.ply", "--data", str(data), "--labels", "auto", "--ids", "per-view"]
    assert main([*command, "--out", f"{tmp_path}/out", "--quiet"]) == 0
    with np.load(tmp_path / "out/segmentation.npz") as file:
        found = file["labels"]
    with np.load(data / "truth.npz") as file:
        truth = file["labels"]
    # Objects are printed, and areas of one colour are found: what is found as one is of one object for the most part.
    seen = (found > 0) & (truth > 0) & (truth < 9)
    shared = np.zeros((found.max() + 1, truth.max() + 1), np.int64)
    np.add.at(shared, (found[seen], truth[seen]), 1)
    assert shared.max(axis=1).sum() > 0.7 * shared.sum(), shared


def test_masks_from_photos_says_what_is_missing_without_photos(tmp_path: Path) -> None:
    pytest.importorskip("skimage", reason="scikit-image is not installed")
    ran = run_example("masks_from_photos.py", write_dataset(tmp_path / "data"))
    assert ran.returncode == 1
    assert ran.stderr.count("\n") == 1 and "no photo in images/; give --scene" in ran.stderr


@pytest.mark.parametrize("model", ["EQUIRECTANGULAR", "OPENCV"])
def test_masks_of_photos_that_a_lens_took_are_those_of_the_photos(model: str, tmp_path: Path) -> None:
    pytest.importorskip("skimage", reason="scikit-image is not installed")
    data = write_dataset(tmp_path / "data")
    for name in ("cameras.json", "split.json", "classes.json"):
        (data / name).unlink()
    (data / "images").mkdir()
    areas = np.kron(np.arange(8, dtype=np.uint8).reshape(2, 4) * 30, np.ones((32, 32), np.uint8))
    Image.fromarray(np.repeat(areas[..., None], 3, axis=2)).save(data / "images/photo.png")
    lens = {"w": 128, "h": 64, "fl_x": 60.0, "fl_y": 60.0, "cx": 64.0, "cy": 32.0, "k1": -0.1, "camera_model": model}
    write_json(
        data / "transforms.json", {**lens, "frames": [{"file_path": "photo", "transform_matrix": np.eye(4).tolist()}]}
    )
    ran = run_example("masks_from_photos.py", data)
    assert ran.stdout.startswith("photo: ") and ran.stdout.count("\n") == 1, ran.stderr
    assert all((view.read_labels() > 0).any() for view in Dataset(data, "auto").views("train"))
    ran = run_example("masks_from_photos.py", data, "--scene", data / "scene.ply", "--out", "rendered")
    assert ran.returncode == 1 and ran.stderr.count("\n") == 1 and "was taken through a lens" in ran.stderr


def write_bag(
    path: Path, views: list[View], distorted: int = -1, unturned: int = -1, topics: tuple[str, ...] = ()
) -> None:
    """A bag made without ROS; the message of `distorted` has a lens with distortion, and of `unturned` no rotation."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    types = {name.rpartition("/")[2]: store.types[name] for name in (
        "builtin_interfaces/msg/Time", "std_msgs/msg/Header", "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo",
        "sensor_msgs/msg/RegionOfInterest", "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/Pose",
        "geometry_msgs/msg/Point", "geometry_msgs/msg/Quaternion")}  # fmt: skip
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {
            name: writer.add_connection(topic, types[kind].__msgtype__, typestore=store)
            for topic, name, kind in zip(
                topics or ("/mask", "/camera_info", "/pose"), ("mask", "camera_info", "pose"),
                ("Image", "CameraInfo", "PoseStamped"), strict=True,
            )
        }  # fmt: skip
        for i, view in enumerate(views):
            header = types["Header"](types["Time"](100 + i, 5), "optical")
            labels, camera = view.read_labels(), view.camera
            height, width = labels.shape
            pixels = np.where(labels < 0, 255, labels).astype(np.uint8)
            padded = np.pad(pixels, ((0, 0), (0, 3))).ravel()  # A row may be longer than the image is wide.
            pose = np.linalg.inv(camera.world_to_camera)
            quaternion = (i != unturned) * Rotation.from_matrix(pose[:3, :3]).as_quat()
            d = np.array([0.1 if i == distorted else 0.0] * 5)
            messages = {
                "mask": types["Image"](header, height, width, "mono8", 0, width + 3, padded),
                "camera_info": types["CameraInfo"](
                    header, height, width, "plumb_bob", d, camera.K.ravel(), np.eye(3).ravel(), np.zeros(12), 0, 0,
                    types["RegionOfInterest"](0, 0, 0, 0, False),
                ),
                "pose": types["PoseStamped"](
                    header, types["Pose"](types["Point"](*pose[:3, 3]), types["Quaternion"](*quaternion))
                ),
            }  # fmt: skip
            for name, message in messages.items():
                data = store.serialize_cdr(message, message.__msgtype__)
                writer.write(connections[name], 10**9 * (100 + i), bytes(data))


def test_a_bag_becomes_objects_without_ros_as_its_dataset_does_by_the_command_line(tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason="rosbags is not installed")
    data = write_dataset(tmp_path / "data")
    write_bag(tmp_path / "bag", Dataset(data).views("train"))
    names = [name for label, name in NAMES.items() if label]
    ran = run_example(
        "bag_to_objects.py", data / "scene.ply", tmp_path / "bag", tmp_path / "out", "--class-names", *names
    )
    assert ran.returncode == 0, ran.stderr
    assert "learnt from 4 masks" in ran.stdout
    command = ["segment", f"{data}/scene.ply", "--data", str(data), "--out", f"{tmp_path}/told", "--quiet"]
    assert main(command) == 0
    expected = sorted((tmp_path / "told/classes").iterdir())
    assert [path.name for path in expected] == sorted(path.name for path in (tmp_path / "out").glob("*.ply"))
    for path in expected:
        mine, theirs = GaussianScene.load(tmp_path / "out" / path.name).means, GaussianScene.load(path).means
        # A pose as a quaternion has other last digits than as a matrix.
        assert abs(len(mine) - len(theirs)) <= 2 and len({*map(tuple, mine)} ^ {*map(tuple, theirs)}) <= 4


def test_a_bag_skips_what_cannot_be_used_and_names_a_topic_that_is_missing(tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason="rosbags is not installed")
    data = write_dataset(tmp_path / "data")
    views, scene = Dataset(data).views("train"), data / "scene.ply"
    write_bag(tmp_path / "bag", views, distorted=1, unturned=2)
    ran = run_example("bag_to_objects.py", scene, tmp_path / "bag", tmp_path / "out")
    assert "learnt from 2 masks" in ran.stdout and "skipped 1 masks: camera_info has distortion" in ran.stdout
    assert "skipped 1 masks: a pose has a quaternion of zeros" in ran.stdout
    write_bag(tmp_path / "raw", views[:1], distorted=0)
    ran = run_example("bag_to_objects.py", scene, tmp_path / "raw", tmp_path / "out")
    assert ran.returncode == 1 and ran.stderr.startswith("bag_to_objects: no view to learn from")
    assert ran.stdout.startswith("skipped 1 masks: camera_info has distortion")
    ran = run_example("bag_to_objects.py", scene, tmp_path / "bag", tmp_path / "out", "--mask", "/front/mask")
    assert ran.returncode == 1 and ran.stderr.count("\n") == 1
    assert "no topic /front/mask; topics in the bag: /camera_info, /mask, /pose" in ran.stderr
